"""What a recording's model is missing."""

import json
from typing import Annotated, Any, Literal

from fastapi import APIRouter
from pydantic import Field

from server import compute, diagnosis
from server.api.common import Here, Language
from server.api.models import Answer, Body
from server.problems import declared

router = APIRouter(tags=["diagnoses"])

EffectName = Annotated[str, Field(min_length=1, max_length=64)]


class DiagnosisBody(Body):
    axis: Literal["x", "y", "z"] | None = Field(None, description="the recording's own where it is left out")
    effects: list[EffectName] = Field([], max_length=30, description="effects that the model already has")
    board: str | None = Field(None, max_length=64, description="of points: whose readings, where there are several")


class Said(Answer):
    """Something told: a sentence, and the code and values it is made of."""

    code: str
    values: dict[str, Any]
    sentence: str


class Found(Said):
    effect: str
    two_delta_lnL: float | None
    p: float | None


class Diagnosis(Answer):
    """CONTRACT 3. ``error``, ``noise`` and ``after`` are null where the recording is not testable."""

    recording: dict[str, Any]
    axis: str
    unit: str | None
    verdict: Literal["adequate", "missing", "ambiguous", "unknown", "not_testable"]
    sentence: str
    code: str
    values: dict[str, Any]
    checks: list[Said]
    model: dict[str, Any]
    noise: dict[str, float | None] | None
    error: dict[str, Any] | None
    where_it_fails: list[Said]
    missing: list[Found]
    rivals: list[list[str]]
    rival_sets: list[list[list[str]]]
    candidates: list[dict[str, Any]]
    unknown: dict[str, Any] | None
    next_experiment: dict[str, Any] | None
    after: dict[str, Any] | None
    limits: list[Said]
    user_effects: list[dict[str, str]] = Field([], description="users' own effects that it names, as formulas")


@router.post(
    "/recordings/{recording}/diagnosis",
    summary="Compare the model with a recording and name what is missing",
    responses=declared(404),
)
async def diagnose(recording: str, body: DiagnosisBody, here: Here, lang: Language) -> Diagnosis:
    effects, axes = tuple(dict.fromkeys(body.effects)), (here.supervisor.rig or {}).get("axes", {})
    samples = here.store.recordings.row(recording)["samples"]
    asked = (recording, body.axis, "diagnosis", effects, body.board, json.dumps(axes))
    given = (here.store.data, recording, body.axis, effects, body.board, axes)
    answer = await here.searches.run((*asked, samples), samples, compute.diagnose, *given)
    return Diagnosis.model_validate(diagnosis.told(answer, lang))
