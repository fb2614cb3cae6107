"""Who may write: a one-time token where the server is reachable from outside, and no foreign page anywhere."""

import secrets
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection

from calib_core.problem import Problem

READS = {"GET", "HEAD", "OPTIONS"}
ALWAYS_ALLOWED = "/api/v1/rig/stop"  # the emergency stop is never locked


def new_token() -> str:
    return secrets.token_urlsafe(18)


def check_write(connection: HTTPConnection, token: str | None) -> None:
    """Raises Problem where a write comes from another site's page, or without the token this server asks for."""
    if connection.scope["type"] != "http" or connection.scope["method"] in READS:
        return
    if connection.scope["path"] == ALWAYS_ALLOWED:
        return
    origin = connection.headers.get("origin")
    if origin and urlsplit(origin).netloc != connection.headers.get("host"):
        raise Problem("auth.foreign_origin", origin=origin)
    if token is None:
        return
    scheme, _, given = connection.headers.get("authorization", "").partition(" ")
    if scheme.lower() != "bearer" or not secrets.compare_digest(given.strip().encode(), token.encode()):
        raise Problem("auth.token_needed")
