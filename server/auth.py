"""Who may write, and how much: a token where others can reach the server, no foreign page, bodies of a size."""

import secrets
from urllib.parse import urlsplit

from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from calib_core.problem import Problem
from calib_core.recording import MAX_BYTES
from server import problems

READS = {"GET", "HEAD", "OPTIONS"}
MAX_BATCH_BYTES = 20_000_000_000
ALWAYS_ALLOWED = "/api/v1/rig/stop"  # the emergency stop is never locked
LARGEST = {"/api/v1/recordings": MAX_BYTES + (1 << 16), "/api/v1/batches": MAX_BATCH_BYTES}
LARGEST_ELSEWHERE = 1 << 20


def new_token() -> str:
    return secrets.token_urlsafe(18)


class Guard:
    """In front of every route, so that a write that may not be is refused before its body is read."""

    def __init__(self, app: ASGIApp, token: str | None) -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        largest = LARGEST.get(request.url.path, LARGEST_ELSEWHERE)
        try:
            check_write(request, self._token)
            declared = request.headers.get("content-length", "0")
            if declared.isdigit() and int(declared) > largest:
                raise Problem("request.too_large")
        except Problem as problem:
            await problems.answer(request, problem)(scope, receive, send)
            return
        read = 0

        async def counted() -> Message:
            # A body need not say its length first.
            nonlocal read
            message = await receive()
            read += len(message.get("body", b""))
            if read > largest:
                raise HTTPException(413)
            return message

        await self._app(scope, counted, send)


def check_origin(connection: HTTPConnection) -> None:
    """Raises Problem where a browser says that a page from elsewhere asks."""
    origin = connection.headers.get("origin")
    if origin and urlsplit(origin).netloc != connection.headers.get("host"):
        raise Problem("auth.foreign_origin", origin=origin)


def check_write(request: Request, token: str | None) -> None:
    """Raises Problem where a write comes from another site's page, or without the token this server asks for."""
    if request.method in READS or request.url.path == ALWAYS_ALLOWED:
        return
    check_origin(request)
    if token is None:
        return
    scheme, _, given = request.headers.get("authorization", "").partition(" ")
    if scheme.lower() != "bearer" or not secrets.compare_digest(given.strip().encode(), token.encode()):
        raise Problem("auth.token_needed")
