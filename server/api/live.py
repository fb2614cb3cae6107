"""The live page's websocket: one task a viewer, each at its own pace."""

import asyncio
from contextlib import suppress

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from calib_core.problem import Problem
from server import auth, problems, texts
from server.api.common import Services
from server.live import LiveRun

router = APIRouter()


@router.websocket("/runs/{run}/live")
async def live(socket: WebSocket, run: str) -> None:
    """Binary messages as `server.live` describes them, from the run so far to its end; then the socket is closed.

    A refusal closes it with 4000 and its HTTP status: 4404 is a run that there is not.
    """
    here: Services = socket.app.state.services
    lang = socket.query_params.get("lang") or texts.negotiate(socket.headers.get("accept-language"))
    await socket.accept()
    try:
        auth.check_origin(
            socket
        )  # the browser's own rules keep pages of other sites from our answers, not from sockets
        watched = here.supervisor.live.get(run) or _from_store(here, run)
    except Problem as problem:
        reason = texts.sentence(problem, lang).encode()[:120].decode(errors="ignore")
        await socket.close(4000 + problems.status_of(problem), reason)
        return
    with suppress(WebSocketDisconnect, RuntimeError):
        await _follow(socket, watched, lang)
        await socket.close()


async def _follow(socket: WebSocket, watched: LiveRun, lang: str) -> None:
    news = asyncio.Event()
    loop = asyncio.get_running_loop()
    leave = watched.watch(lambda: loop.call_soon_threadsafe(news.set))
    gone = asyncio.create_task(_left(socket))
    cursor: int | None = None
    try:
        while not gone.done():
            news.clear()
            ended = watched.ended
            new = watched.since(cursor, lang)
            if new is not None:
                message, cursor = new
                await socket.send_bytes(message)
            elif ended:
                return
            else:
                waiting = asyncio.create_task(news.wait())
                await asyncio.wait({waiting, gone}, return_when=asyncio.FIRST_COMPLETED)
                waiting.cancel()
    finally:
        leave()
        gone.cancel()


async def _left(socket: WebSocket) -> None:
    """Ends when the viewer does; what it says meanwhile is nothing to us."""
    with suppress(WebSocketDisconnect):
        while (await socket.receive())["type"] != "websocket.disconnect":
            pass


def _from_store(here: Services, run: str) -> LiveRun:
    """A run that ended before this server began, or long ago: its results and points, without plots."""
    row = here.store.runs.get(run)
    ended = LiveRun(run, {"certificate": row["certificate"], "message": row["message"]})
    ended.feed({"status": row["status"], "states": row["states"], "results": row["results"]})
    return ended
