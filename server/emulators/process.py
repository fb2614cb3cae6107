"""Emulators as processes of their own, and how one talks to them.

Each is `python -m server.emulators.<name> '<JSON>'`. It prints one line of JSON, which says where it can be reached,
and ends when its standard input does: with its starter gone, however that ended, it is gone too.
(`multiprocessing` cannot start them, because the worker that does is a daemon and may have no such children.)
"""

import json
import os
import secrets
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client, Connection, Listener
from typing import Any

from server.devices import DeviceError

STOP_S = 3.0


class Child:
    """One emulator process; `said` is the line it printed. Raises DeviceError where it does not come up."""

    def __init__(self, name: str, **told: Any) -> None:
        command = [sys.executable, "-m", f"server.emulators.{name}", json.dumps(told)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self.close()
            raise DeviceError("emulator.not_started", name=name)
        self.said: dict[str, Any] = json.loads(line)

    @property
    def pid(self) -> int:
        return self._process.pid

    def wait(self) -> None:
        """Until it ends by itself."""
        self._process.wait()

    def kill(self) -> None:
        """End it at once, as a crash would."""
        self._process.kill()
        self.close()

    def close(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def told() -> dict[str, Any]:
    """In an emulator: what its starter said. Ctrl+C is the starter's to handle."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "setpriority"):
        with suppress(PermissionError):  # a real servo does not wait for a busy computer
            os.setpriority(os.PRIO_PROCESS, 0, -10)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    given: dict[str, Any] = json.loads(sys.argv[1])
    return given


def live(said: Mapping[str, Any]) -> None:
    """In an emulator: say where it is, then live until the starter is gone."""
    print(json.dumps(said), flush=True)
    sys.stdin.read()


def serve(handler: object) -> dict[str, str]:
    """Answer calls of `Remote` with the public methods of `handler`, one connection a thread; where to call."""
    key = secrets.token_hex(16)
    listener = Listener(authkey=key.encode())

    def accept() -> None:
        while True:
            try:
                connection = listener.accept()
            except (OSError, EOFError, AuthenticationError):  # a caller that left at once, or has not the key
                continue
            threading.Thread(target=_answer, args=[connection, handler], daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    return {"address": str(listener.address), "key": key}


def _answer(connection: Connection, handler: object) -> None:
    while True:
        try:
            name, args, options = connection.recv()
        except (EOFError, OSError):
            return
        try:
            method: Callable[..., Any] = getattr(handler, name)
            answer: tuple[bool, Any] = True, method(*args, **options)
        except Exception as error:
            answer = False, f"{type(error).__name__}: {error}"
        try:
            connection.send(answer)
        except OSError:
            return


class Remote:
    """Calls the methods of an emulator's handler: `remote.fault("late", servo=1)`."""

    def __init__(self, said: Mapping[str, str]) -> None:
        self._lock = threading.Lock()
        self._connection = Client(said["address"], authkey=said["key"].encode())

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_"):
            raise AttributeError(name)

        def call(*args: Any, **options: Any) -> Any:
            with self._lock:
                self._connection.send((name, args, options))
                good, answer = self._connection.recv()
            if not good:
                raise RuntimeError(f"{name}: {answer}")
            return answer

        return call

    def close(self) -> None:
        self._connection.close()
