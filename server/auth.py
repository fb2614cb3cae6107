"""Who may write: a one-time token where the server is reachable from outside, and no foreign page anywhere."""

import secrets
from urllib.parse import urlsplit

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from calib_core.problem import Problem
from server import problems

READS = {"GET", "HEAD", "OPTIONS"}
ALWAYS_ALLOWED = "/api/v1/rig/stop"  # the emergency stop is never locked


def new_token() -> str:
    return secrets.token_urlsafe(18)


class Guard:
    """In front of every route, so that a write that may not be is refused before its body is read."""

    def __init__(self, app: ASGIApp, token: str | None) -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            request = Request(scope)
            try:
                check_write(request, self._token)
            except Problem as problem:
                await problems.answer(request, problem)(scope, receive, send)
                return
        await self._app(scope, receive, send)


def check_write(request: Request, token: str | None) -> None:
    """Raises Problem where a write comes from another site's page, or without the token this server asks for."""
    if request.method in READS or request.url.path == ALWAYS_ALLOWED:
        return
    origin = request.headers.get("origin")
    if origin and urlsplit(origin).netloc != request.headers.get("host"):
        raise Problem("auth.foreign_origin", origin=origin)
    if token is None:
        return
    scheme, _, given = request.headers.get("authorization", "").partition(" ")
    if scheme.lower() != "bearer" or not secrets.compare_digest(given.strip().encode(), token.encode()):
        raise Problem("auth.token_needed")
