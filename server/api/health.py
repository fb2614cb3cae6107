"""Is the server there, and its worker?"""

import time
from typing import Literal

from fastapi import APIRouter

from server import __version__
from server.api.common import Here
from server.api.models import Plain

router = APIRouter(tags=["health"])


class Health(Plain):
    status: Literal["ok"] = "ok"
    version: str = __version__
    worker: Literal["ready", "starting", "dead"]
    worker_pid: int | None
    uptime_s: float


@router.get("/health")
async def health(here: Here) -> Health:
    uptime = round(time.monotonic() - here.started, 3)
    return Health(worker=here.supervisor.status, worker_pid=here.supervisor.pid, uptime_s=uptime)
