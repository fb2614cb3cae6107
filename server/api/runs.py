"""Runs: plan, start, stop, look at."""

from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, Query

from server import compute, texts
from server.api import models
from server.api.common import Cursor, Here, Language, Limit, Search, Services
from server.api.rig import LeaseToken
from server.problems import declared
from server.settings import checked_speed

router = APIRouter(prefix="/runs", tags=["runs"])
MaxPoints = Annotated[int, Query(ge=10, le=20000, description="at most so many rows")]


def shown(row: dict[str, Any], lang: str) -> models.Run:
    request, message = row["request"], row["message"]
    results = row.get("results", {})
    if message is not None:
        message = {**message, "sentence": texts.render(message["code"], message["values"], lang)}
    facts = {
        **{name: request.get(name) for name in ("seed", "readings", "rig", "spec", "continues", "speed")},
        **{name: row[name] for name in _AS_STORED},
        "operator": request.get("operator", ""),
        "note": request.get("note", ""),
        "conditions": request.get("conditions", {}),
        "states": [{**state, "result": results.get(state["name"])} for state in row["states"]],
        "message": message,
        "duration_s": _seconds(row["started_at"], row["finished_at"]),
        "plan": {"seconds": row["plan"]["duration_s"]},
        "results": results,
    }
    return models.Run(**facts)


_AS_STORED = (
    "id", "status", "recording", "board", "gyro_model", "profile", "created_at", "started_at", "finished_at",
    "certificate",
)  # fmt: skip


def _seconds(start: str | None, end: str | None) -> float | None:
    if start is None or end is None:
        return None
    return (datetime.fromisoformat(end) - datetime.fromisoformat(start)).total_seconds()


def _planned(here: Services, body: models.RunBody) -> tuple[dict[str, Any], Any]:
    # With the first plan, not with the program: the arithmetic behind it is a tenth of start-up.
    from calib_core.sequence import Axis
    from server import run_plan

    axes = {name: Axis(**facts) for name, facts in (here.supervisor.rig or {}).get("axes", {}).items()}
    return run_plan.plan_of(here.store, body.model_dump(exclude_none=True), axes)


@router.post("/plan", summary="What a run would do and how long it takes, without starting it", responses=declared(404))
def plan(body: models.RunBody, here: Here) -> models.PlanAnswer:
    _, made = _planned(here, body)
    states = [{"name": state.name, "seconds": state.duration_s, "readings": state.readings} for state in made.states]
    return models.PlanAnswer.model_validate({"states": states, "seconds": made.duration_s})


@router.post("", status_code=201, summary="Start a run", responses=declared(404, 409, 503))
def start(body: models.RunBody, here: Here, lang: Language, lease: LeaseToken = None) -> models.Run:
    from server.run_plan import create

    here.lease.check(lease)
    bench = here.supervisor
    with bench.free():
        speed = bench.speed if body.speed is None else checked_speed(body.speed, bench.url)
        filled, made = _planned(here, body)
        run = create(here.store, filled, made, rig=bench.url, speed=speed)
        row = here.store.runs.get(run)
        bench.begin(run, speed, {"status": "queued", "states": row["states"], "results": row["results"]})
    return shown(row, lang)


@router.get("", summary="Runs, newest first")
def runs(
    here: Here, lang: Language, q: Search = "", board: Search = "", limit: Limit = 50, cursor: Cursor = None
) -> models.Runs:
    items, following = here.store.runs.find(q=q, board=board, limit=limit, cursor=cursor)
    return models.Runs(items=[shown(row, lang) for row in items], next=following)


@router.get("/{run}", summary="A run with the results so far", responses=declared(404))
def one(run: str, here: Here, lang: Language) -> models.Run:
    return shown(here.store.runs.get(run), lang)


@router.post("/{run}/stop", summary="Stop a run; the motors are left safe", responses=declared(404, 409, 503))
def stop(run: str, here: Here, lang: Language) -> models.Run:
    here.store.runs.get(run)
    here.supervisor.stop_run(run)
    return shown(here.store.runs.get(run), lang)


@router.get("/{run}/series", summary="Stored samples of a run, thinned for a chart", responses=declared(404))
async def series(
    run: str, here: Here, state: models.StateName | None = None, max_points: MaxPoints = 2000
) -> models.Series:
    recording = here.store.runs.get(run)["recording"]
    columns = await here.compute.run(compute.series, here.store.data, recording, state, max_points)
    return models.Series(columns=columns)


@router.get("/{run}/comparison", summary="Rate and angle against the encoder", responses=declared(404))
async def comparison(run: str, here: Here, axis: models.Axis, max_points: MaxPoints = 2000) -> models.Answer:
    recording = here.store.runs.get(run)["recording"]
    found = await here.compute.run(compute.comparison, here.store.data, recording, axis, max_points)
    return models.Answer.model_validate(found)
