"""The rig: what it is, what answers, who holds it, and the emergency stop."""

import asyncio
import math
import sys
from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import APIRouter, Header, Response

from calib_core.reference import ReferenceCalibration
from server import texts
from server.api import models
from server.api.common import Here, Language, Services
from server.problems import declared
from server.settings import checked_speed, has_speed

router = APIRouter(prefix="/rig", tags=["rig"])
LeaseToken = Annotated[str | None, Header(alias="X-Rig-Lease", max_length=200)]


def shown(here: Services, lang: str) -> dict[str, Any]:
    from server.devices.address import ports  # with the drivers it may name, so not with the program

    bench = here.supervisor
    status = bench.rig or {}
    found = ports()
    choices = [{"url": "twin:", "label": texts.render("rig.choice.twin", {}, lang)}]
    if sys.platform != "win32":
        choices.append({"url": "emulated:", "label": texts.render("rig.choice.emulated", {}, lang)})
    for port in found:
        url = f"dynamixel:{port}?ids=1,2&baud=1000000+nidaq:Dev1?channels=ai0,ai1"
        choices.append({"url": url, "label": texts.render("rig.choice.port", {"port": port}, lang)})
    return {
        "url": bench.url,
        "kind": bench.url.split(":", 1)[0],
        "simulated": has_speed(bench.url),
        "speed": "max" if math.isinf(bench.speed) else bench.speed,
        "connected": bool(status.get("connected")),
        "parts": [_told(part, lang) for part in status.get("parts", ())],
        "checks": [_told(check, lang) for check in status.get("checks", ())],
        "checking": bench.checking,
        "lease": here.lease.shown(),
        "run": bench.run,
        "axes": status.get("axes", {}),
        "ports": found,
        "choices": choices,
        "worker": bench.status,
    }


def _told(part: Mapping[str, Any], lang: str) -> dict[str, Any]:
    """A part or check with its sentence, and the cure where the sentence has it not."""
    code, values, cure = part["code"], part["values"], part.get("cure")
    said = {"sentence": texts.render(code, values, lang), "cure": texts.render(cure, values, lang) if cure else ""}
    return {**part, **said}


@router.get("", summary="What the rig is and what answers")
def status(here: Here, lang: Language) -> models.Rig:
    return models.Rig(**shown(here, lang))


@router.put("", summary="Choose the rig", responses=declared(409, 502, 503))
def choose(body: models.RigBody, here: Here, lang: Language, lease: LeaseToken = None) -> models.Rig:
    here.lease.check(lease)
    speed = checked_speed(body.speed, body.url)
    here.supervisor.open_rig(here.store.effects.address(body.url), speed)
    return models.Rig(**shown(here, lang))


@router.post("/check", summary="Ask every part again", responses=declared(409, 502, 503))
def check(here: Here, lang: Language, lease: LeaseToken = None) -> models.Rig:
    here.lease.check(lease)
    here.supervisor.check_rig()
    return models.Rig(**shown(here, lang))


@router.post(
    "/start-check",
    status_code=202,
    summary="Check the rig's physics: the table moves, half a minute; what is found comes with GET rig",
    responses=declared(404, 409, 503),
)
def start_check(body: models.StartCheckBody, here: Here, lang: Language, lease: LeaseToken = None) -> models.Rig:
    here.lease.check(lease)
    here.supervisor.start_check(here.store.gyro_models.get(body.gyro_model).to_json())
    return models.Rig(**shown(here, lang))


@router.get("/reference", summary="How the encoders of this rig were calibrated, if they were")
def reference(here: Here) -> models.Reference:
    return _reference(here.store.rig_records.get(here.supervisor.url))


@router.put("/reference", summary="The encoders' calibration from now on", responses=declared(409))
def calibrated(body: models.ReferenceBody, here: Here, lease: LeaseToken = None) -> models.Reference:
    here.lease.check(lease)
    record = ReferenceCalibration.from_json(body.model_dump())
    here.store.rig_records.set(here.supervisor.url, record)
    return _reference(record)


@router.delete("/reference", status_code=204, summary="Not calibrated any more", responses=declared(409))
def uncalibrated(here: Here, lease: LeaseToken = None) -> Response:
    here.lease.check(lease)
    here.store.rig_records.set(here.supervisor.url, None)
    return Response(status_code=204)


def _reference(record: ReferenceCalibration | None) -> models.Reference:
    if record is None:
        return models.Reference(record=None, name="", gains={})
    gains = {
        axis: models.ReferenceGain(scale=found.scale, scale_uncertainty=found.scale_uncertainty)
        for axis, found in record.axes.items()
    }
    return models.Reference(record=record.to_json(), name=record.name, gains=gains)


@router.post("/lease", summary="Hold the rig, or go on holding it", responses=declared(409))
def take_lease(body: models.LeaseBody, here: Here, lease: LeaseToken = None) -> models.Lease:
    return models.Lease(**here.lease.take(body.holder, lease))


@router.delete("/lease", status_code=204, summary="Give the rig back", responses=declared(409))
def give_back(here: Here, lease: LeaseToken = None) -> Response:
    here.lease.give_back(lease)
    return Response(status_code=204)


@router.post(
    "/stop", status_code=204, summary="Emergency stop: no body, no token, never locked", responses=declared(503)
)
async def stop(here: Here) -> Response:
    # Not in the threads that other requests may have taken all of.
    await asyncio.to_thread(here.supervisor.stop)
    return Response(status_code=204)
