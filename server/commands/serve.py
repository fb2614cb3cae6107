"""`gyrobench serve`: the server and its pages."""

import argparse
import gc
import socket
import sys
from collections.abc import Callable
from typing import Any

from calib_core.problem import Problem
from server.cli import data_option
from server.settings import LOOPBACK, Settings, checked_speed, data_dir

EXAMPLE = "gyrobench serve --port 8080 --data ./lab --rig 'twin:?seed=7' --speed 20"

SEND_BUFFER = 1 << 16


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: this computer only)")
    parser.add_argument("--port", type=int, default=8000, help="port to listen on; 0 takes a free one (default 8000)")
    data_option(parser)
    parser.add_argument(
        "--rig", default="twin:", help="twin:?seed=1, emulated:, dynamixel:PORT+nidaq:DEV (default twin:)"
    )
    parser.add_argument("--speed", help="bench seconds per second, or max; simulated rigs only (default 20 there)")


def main(args: argparse.Namespace) -> int:
    listener = listen(args.host, args.port)
    with listener:
        speed = checked_speed(args.speed, args.rig)
        gc.disable()  # the imports make nothing but lasting objects; looking through them costs a tenth of start-up
        import uvicorn

        from server import auth
        from server.app import create_app
        from server.store_effects import address_of

        rig = address_of(args.rig, args.data)
        token = None if args.host in LOOPBACK else auth.new_token()
        port = listener.getsockname()[1]
        app = create_app(Settings(data_dir(args.data), args.host, port, rig, speed, token))
        gc.freeze()
        gc.enable()
        config = uvicorn.Config(
            app,
            http="h11",
            ws=_websockets,  # type: ignore[arg-type]
            ws_per_message_deflate=False,
            log_level="warning",
            access_log=False,
            timeout_graceful_shutdown=1,
        )
        server = uvicorn.Server(config)
        _after_startup(server, lambda: announce(args.host, port, token))
        server.run(sockets=[listener])
    return 0


def listen(host: str, port: int) -> socket.socket:
    """A bound socket; raises Problem where the port is taken or the address is not this computer's."""
    if not 0 <= port <= 65535:
        raise Problem("serve.port_out_of_range", port=port)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio sends small packets at once only where the protocol is named; unnamed, each answer waits 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        if sys.platform != "win32":  # there it would let two servers share the port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # A live viewer who stalls is felt after a few frames, and gets the newest, not a minute of old ones, later.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        listener.bind((host, port))
        listener.listen(256)
        return listener
    except OSError as error:
        listener.close()
        code = "serve.port_in_use" if error.errno in _IN_USE else "serve.cannot_listen"
        raise Problem(code, host=host, port=port, next=port + 1, reason=error.strerror or str(error)) from error


_IN_USE = {98, 48, 10048, 10013}  # EADDRINUSE on Linux, macOS and Windows, and Windows' WSAEACCES for a port held alone


def announce(host: str, port: int, token: str | None) -> None:
    shown = "127.0.0.1" if host in ("0.0.0.0", "::") else host
    address = f"http://[{shown}]:{port}" if ":" in shown else f"http://{shown}:{port}"
    print(f"Gyrobench: {address}/" + (f"#token={token}" if token else ""), flush=True)
    if token:
        print(f"This server can be reached from other computers; every change needs this token: {token}", flush=True)
    print("Ctrl+C stops it and leaves the motors safe.", flush=True)


def _after_startup(server: Any, then: Callable[[], None]) -> None:
    startup = server.startup

    async def announced(sockets: list[socket.socket] | None = None) -> None:
        await startup(sockets=sockets)
        then()

    server.startup = announced


def _websockets(*args: Any, **kwargs: Any) -> Any:
    # Imported with the first live page: 40 ms that start-up need not pay.
    from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

    return WebSocketsSansIOProtocol(*args, **kwargs)
