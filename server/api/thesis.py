"""The thesis' tables, recomputed, and the certified numbers there are."""

from typing import Any

from fastapi import APIRouter

from calib_core.certificate import FIELDS
from server import compute
from server.api import models
from server.api.common import Here

router = APIRouter(tags=["thesis"])


@router.get("/thesis", summary="The thesis' tables recomputed from its readings, beside what it printed")
async def thesis(here: Here) -> models.Answer:
    return models.Answer.model_validate(await here.compute.once("thesis", compute.thesis))


@router.get("/fields", summary="The certified numbers: where each stands, its name's text, its unit")
def fields() -> dict[str, list[dict[str, Any]]]:
    names = ("path", "text", "unit", "factor", "decimals", "uncertainty")
    return {"items": [{name: getattr(field, name) for name in names} for field in FIELDS]}
