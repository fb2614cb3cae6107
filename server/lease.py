"""Who holds the rig: a short lease that its holder renews, and that the emergency stop never asks for."""

import secrets
import threading
import time
from datetime import UTC, datetime, timedelta

from calib_core.problem import Problem

LEASE_S = 90.0


class Lease:
    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._holder, self._token, self._until = "", "", 0.0

    def take(self, holder: str, token: str | None) -> dict[str, str]:
        """Takes or renews the lease; raises Problem while somebody else has it."""
        with self._lock:
            self._check(token)
            if not self._token or not self._on() or token != self._token:
                self._token = secrets.token_urlsafe(12)
            self._holder, self._until = holder, time.monotonic() + LEASE_S
            return {"token": self._token, "expires_at": self._expires_at()}

    def give_back(self, token: str | None) -> None:
        with self._lock:
            self._check(token)
            self._holder, self._token, self._until = "", "", 0.0

    def check(self, token: str | None) -> None:
        """Raises Problem where another holds the rig; a rig that nobody holds is free to all."""
        with self._lock:
            self._check(token)

    def shown(self) -> dict[str, str] | None:
        with self._lock:
            return {"holder": self._holder, "expires_at": self._expires_at()} if self._on() else None

    def _check(self, token: str | None) -> None:
        if self._on() and not secrets.compare_digest((token or "").encode(), self._token.encode()):
            raise Problem("rig.leased", holder=self._holder, until=self._expires_at())

    def _on(self) -> bool:
        return bool(self._token) and time.monotonic() < self._until

    def _expires_at(self) -> str:
        left = timedelta(seconds=self._until - time.monotonic())
        return (datetime.now(UTC) + left).isoformat(timespec="seconds").replace("+00:00", "Z")
