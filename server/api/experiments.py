"""Experiments: the motion that would settle what a recording leaves open, done on the rig and judged with it."""

import secrets
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query
from pydantic import Field

from server import diagnosis, experiments, texts
from server.api import models
from server.api.common import Cursor, Here, Language, Limit, Services
from server.api.rig import LeaseToken
from server.live import ENDED
from server.problems import declared
from server.settings import checked_speed

router = APIRouter(prefix="/experiments", tags=["experiments"])
EffectName = Annotated[str, Field(min_length=1, max_length=64)]


class ExperimentBody(models.Body):
    recording: str = Field(max_length=64)
    axis: models.Axis
    effects: list[EffectName] = Field([], max_length=30, description="effects that the model already has")


class ExperimentRunBody(models.Body):
    speed: models.Speed | None = None


class Motion(models.Answer):
    axis: str
    kind: Literal["sine", "multisine", "staircase", "hold", "poses", "heat"]
    duration_s: float


class NextExperiment(models.Answer):
    """CONTRACT 3's ``next_experiment``; ``remain``: rivals that would still be tied, ``decides``: whether any would."""

    separates: list[str]
    motion: list[Motion]
    duration_s: float
    expected_two_delta_lnL: float
    decides: bool
    remain: list[list[str]]
    sentence: str


class Judged(models.Answer):
    recording: str = Field(description="all data together, as a recording of its own")
    diagnosis: dict[str, Any]


class Experiment(models.Answer):
    id: str
    recording: str
    axis: models.Axis
    effects: list[str]
    status: Literal["proposed", "running", "done", "failed"]
    next_experiment: NextExperiment
    run: str | None
    message: models.Message | None
    result: Judged | None
    created_at: str


class Experiments(models.Plain):
    items: list[Experiment]
    next: str | None


def shown(here: Services, row: dict[str, Any], lang: str) -> Experiment:
    run = here.store.runs.get(row["run"]) if row["run"] else None
    status, message, result = "proposed", None, row["result"]
    if run is not None:
        ended = run["status"] in ENDED
        status = "running" if not ended or (run["status"] == "finished" and result is None) else "done"
        status = status if not ended or run["status"] == "finished" else "failed"
        message = run["message"]
    if result is not None and "message" in result:
        status, message, result = "failed", result["message"], None
    if message is not None:
        message = {**message, "sentence": texts.render(message["code"], message["values"], lang)}
    following = row["proposal"]
    said = following | {"sentence": texts.render(following["code"], following["values"], lang)}
    if result is not None:
        result = result | {"diagnosis": diagnosis.told(result["diagnosis"], lang)}
    facts = {name: row[name] for name in ("id", "recording", "axis", "effects", "run", "created_at")}
    told = {"status": status, "message": message, "next_experiment": said, "result": result}
    return Experiment.model_validate(facts | told)


@router.post("", status_code=201, summary="Propose the next experiment for a recording", responses=declared(404, 409))
async def propose(body: ExperimentBody, here: Here, lang: Language) -> Experiment:
    axes = (here.supervisor.rig or {}).get("axes", {})
    effects = tuple(dict.fromkeys(body.effects))
    samples = here.store.recordings.row(body.recording)["samples"]
    given = (body.recording, body.axis, effects, axes, here.supervisor.url)
    asked = (body.recording, body.axis, "motion", secrets.token_hex(4))  # each gets a proposal of its own
    made = await here.searches.run(asked, samples, experiments.proposed, here.store.data, *given)
    return shown(here, here.store.experiments.get(made), lang)


@router.get("", summary="Experiments, newest first")
def found(
    here: Here,
    lang: Language,
    recording: Annotated[str, Query(max_length=64)] = "",
    limit: Limit = 50,
    cursor: Cursor = None,
) -> Experiments:
    rows, following = here.store.experiments.find(recording=recording, limit=limit, cursor=cursor)
    return Experiments(items=[shown(here, row, lang) for row in rows], next=following)


@router.post(
    "/{experiment}/run",
    status_code=201,
    summary="Do it on the rig; the result comes with GET once the run has ended",
    responses=declared(404, 409, 503),
)
def run(experiment: str, body: ExperimentRunBody, here: Here, lang: Language, lease: LeaseToken = None) -> Experiment:
    here.lease.check(lease)
    row = here.store.experiments.get(experiment)
    bench = here.supervisor
    with bench.free():
        speed = bench.speed if body.speed is None else checked_speed(body.speed, bench.url)
        axes = (bench.rig or {}).get("axes", {})
        started = experiments.create(here.store, row, axes, rig=bench.url, speed=speed)
        queued = here.store.runs.get(started)
        bench.begin(started, speed, {"status": "queued", "states": queued["states"], "results": {}})
    return shown(here, here.store.experiments.get(experiment), lang)


@router.get("/{experiment}", summary="An experiment, and the joined verdict once it is done", responses=declared(404))
async def one(experiment: str, here: Here, lang: Language) -> Experiment:
    row = here.store.experiments.get(experiment)
    if row["run"] and row["result"] is None and here.store.runs.get(row["run"])["status"] == "finished":
        samples = here.store.recordings.row(row["recording"])["samples"]
        asked = (row["recording"], row["axis"], "judged", experiment)
        await here.searches.run(asked, samples, experiments.judged, here.store.data, experiment)
        row = here.store.experiments.get(experiment)
    return shown(here, row, lang)
