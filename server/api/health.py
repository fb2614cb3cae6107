"""Is the server there, and its worker?"""

import time
from typing import Literal

from fastapi import APIRouter
from pydantic import BaseModel

from server import __version__
from server.api.common import Here

router = APIRouter(tags=["health"])


class Health(BaseModel):
    status: Literal["ok"] = "ok"
    version: str = __version__
    worker: Literal["ready", "starting", "dead"]
    uptime_s: float


@router.get("/health")
async def health(here: Here) -> Health:
    return Health(worker=here.supervisor.status, uptime_s=round(time.monotonic() - here.started, 3))
