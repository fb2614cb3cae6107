"""Viewers of a live run: how late a frame comes to each, with some of them stalled.

The server's own routes over real sockets, its process fed as the worker feeds it: 20 frames a second of 100 Hz rows of
two axes. Viewers are another process; both read one clock, and a frame carries the time at which it was fed.
"""

import asyncio
import multiprocessing
import os
import socket
import struct
import tempfile
import threading
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from server.bench import Row

FRAMES_HZ = 20
ROWS = 100 // FRAMES_HZ
STALLED = 10
COLUMNS = ("time_s", "gyro_dps", "encoder_dps")
RUN = "bench"


def run(*, quick: bool) -> list[Row]:
    viewers, seconds = (100, 5.0) if quick else (400, 20.0)
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    with tempfile.TemporaryDirectory() as data:
        server = context.Process(target=serve, args=(Path(data), theirs, seconds), daemon=True)
        server.start()
        port = ours.recv()
        late, frames = asyncio.run(watch(port, viewers, seconds, ours))
        cpu_s = ours.recv()
        server.join(10.0)
    load = f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores" if hasattr(os, "getloadavg") else ""
    told = f"{viewers} viewers, {STALLED} of them stalled, {frames} frames; {load}"
    return [
        Row("Live frame to its viewer, p99", 1e3 * float(np.quantile(late, 0.99)), "ms", 100.0, ours=told),
        Row("Live frame to its viewer, median", 1e3 * float(np.median(late)), "ms"),
        Row("Server, of one core", 100.0 * cpu_s / seconds, "%"),
    ]


def serve(data: Path, parent: Connection, seconds: float) -> None:
    """The application without a bench, and one live run that is fed for so long once the viewers are there."""
    import uvicorn

    from server.app import create_app
    from server.commands.serve import _websockets, listen
    from server.live import LiveRun
    from server.settings import Settings

    app = create_app(Settings(data))
    live = LiveRun(RUN, {"status": "running", "message": None})
    app.state.services.supervisor.live = {RUN: live}
    listener = listen("127.0.0.1", 0)
    config = uvicorn.Config(
        app, http="h11", ws=_websockets, lifespan="off", ws_per_message_deflate=False, log_level="error"  # type: ignore[arg-type]
    )  # fmt: skip
    threading.Thread(target=uvicorn.Server(config).run, args=([listener],), daemon=True).start()
    parent.send(listener.getsockname()[1])
    parent.recv()
    spent = time.process_time()
    began = time.monotonic()
    for k in range(int(seconds * FRAMES_HZ)):
        time.sleep(max(0.0, began + k / FRAMES_HZ - time.monotonic()))
        rows = np.arange(ROWS) / 100.0 + k / FRAMES_HZ
        live.feed({"fed": time.monotonic()}, {f"{axis}.{name}": rows for axis in "xz" for name in COLUMNS})
    parent.send(time.process_time() - spent)
    parent.recv()


async def watch(port: int, viewers: int, seconds: float, server: Connection) -> tuple[Any, int]:
    """Seconds from feeding to receiving of all frames that those who read received, and how many those were."""
    from websockets.asyncio.client import connect

    from server.live import decode

    late: list[float] = []

    async def view(address: str) -> None:
        async with connect(address, max_size=None, compression=None) as socket:
            async for data in socket:
                assert isinstance(data, bytes)
                fed = decode(data)[0].get("fed")
                if fed is not None:
                    late.append(time.monotonic() - fed)

    stalled = [await asyncio.to_thread(stall, port) for _ in range(STALLED)]
    tasks = [
        asyncio.create_task(view(f"ws://127.0.0.1:{port}/api/v1/runs/{RUN}/live")) for _ in range(viewers - STALLED)
    ]
    await asyncio.sleep(0.02 * viewers)  # each has had its first message
    server.send("begin")
    await asyncio.sleep(seconds + 1.0)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    for one in stalled:
        with suppress(OSError):
            one.close()
    server.send("end")
    return np.array(late), len(late)


def stall(port: int) -> socket.socket:
    """A viewer that asks and then never reads, with as little room for what comes as the system allows."""
    one = socket.socket()
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    one.connect(("127.0.0.1", port))
    asked = (
        f"GET /api/v1/runs/{RUN}/live HTTP/1.1", f"Host: 127.0.0.1:{port}", "Upgrade: websocket",
        "Connection: Upgrade", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13", "\r\n",
    )  # fmt: skip
    one.sendall("\r\n".join(asked).encode())
    return one
