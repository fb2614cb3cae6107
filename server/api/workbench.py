"""The workbench: a recording's signal, models fitted to it in a moment, what it suspects; and examples to learn on."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query
from fastapi.responses import Response
from pydantic import Field

from calib_core.points import FORMAT
from server import compute, examples, workbench
from server.api.common import Here, Language, Services
from server.api.models import Answer, Body, Plain
from server.problems import declared
from server.texts import render

router = APIRouter(tags=["workbench"])
COLUMNS = "application/octet-stream"
"""u32 length, JSON, Float64 columns named and counted by its ``arrays``: as ``server.live`` describes."""
BINARY: dict[int | str, dict[str, Any]] = {200: {"content": {COLUMNS: {}}}}
AxisName = Literal["x", "y", "z"]
Points = Annotated[int, Field(ge=100, le=50_000, description="at most so many instants of the signal")]
EffectName = Annotated[str, Field(min_length=1, max_length=64)]
Board = Annotated[str, Query(max_length=64, description="of readings of several boards: which")]
Seconds = Annotated[float, Field(ge=-1e9, le=1e9)]


class Formula(Body):
    """A user's own effect, as ``calib_core.formula`` reads it."""

    name: Annotated[str, Field(max_length=64)]
    formula: Annotated[str, Field(max_length=1000)]
    parameter: Annotated[str, Field(max_length=64)] = "k"
    unit: Annotated[str, Field(max_length=64)] = ""
    acts: Literal["output", "rate", "angle"] = "output"


class FitBody(Body):
    axis: AxisName
    effects: list[EffectName] = Field([], max_length=12, description="in the order they came into the model")
    formulas: list[Formula] = Field([], max_length=12, description="of the effects that are in no library")
    begin_s: Seconds | None = Field(None, description="show the signal from here, in seconds from its first sample")
    end_s: Seconds | None = None
    points: Points = 4000
    board: Annotated[str, Field(max_length=64)] = Field("", description="of readings of several boards: which")


class Suspect(Answer):
    effect: str
    title: str
    status: Literal["tested", "not_excited", "no_data"]
    word: str
    sentence: str
    two_delta_lnL: float | None
    z: float | None = Field(description="the evidence as that of one degree of freedom")
    tie: int | None = Field(description="effects with the same number cannot be told apart here")
    in_model: bool
    can_be_added: bool


class Suspects(Answer):
    verdict: str
    sentence: str
    headline: str = Field(description="what is missing, in few words; empty where nothing is")
    untested: str = Field(description="what this recording could not test, and why; may be empty")
    threshold: float | None = Field(description="the z that noise alone reaches in one recording of a hundred")
    suspects: list[Suspect]


class Progress(Plain):
    """``stage``: null where nothing is searched, "queued", or what is being done."""

    stage: Literal["queued", "reading", "fitting", "searching", "structure", "motions"] | None
    seconds: float


class Path(Plain):
    """Where the axes that move are sent."""

    time_s: list[float]
    angle_deg: dict[str, list[float]]


class Example(Plain):
    name: str
    title: str
    story: str
    axis: Literal["x", "z"]
    recording: str | None = Field(description="null until it is asked for with POST")


class Examples(Plain):
    items: list[Example]
    next: None = None


@router.get(
    "/recordings/{recording}/signal",
    summary="The gyro's output, as many instants as a screen shows",
    responses={**BINARY, **declared(404)},
    response_class=Response,
)
def signal(
    recording: str,
    here: Here,
    axis: AxisName | None = None,
    board: Board = "",
    points: Annotated[int, Query(ge=100, le=50_000)] = 4000,
) -> Response:
    here.store.recordings.row(recording)
    return Response(workbench.signal(here.store.data, recording, axis, board, points), media_type=COLUMNS)


def _asked(here: Services, recording: str, axis: str) -> tuple[object, ...]:
    """What a search of the library is known by; a run that is still on has more samples each time."""
    return (recording, axis, "suspects", here.store.recordings.row(recording)["samples"])


@router.post(
    "/recordings/{recording}/fit",
    summary="Base and effects on a recording: signal, residuals, spectrum, parameters, error on data not seen",
    responses={**BINARY, **declared(404)},
    response_class=Response,
)
async def fit(recording: str, body: FitBody, here: Here, lang: Language) -> Response:
    found = here.searches.known(_asked(here, recording, body.axis))
    formulas = [formula.model_dump() for formula in body.formulas]
    window = (body.begin_s, body.end_s)
    columns = await here.compute.run(
        workbench.fit,
        here.store.data,
        recording,
        body.axis,
        tuple(body.effects),
        formulas,
        window,
        body.points,
        body.board,
        lang,
        found and found["noise"],
    )
    return Response(columns, media_type=COLUMNS)


@router.get(
    "/recordings/{recording}/suspects",
    summary="Every effect of the library with its evidence beside a model",
    responses=declared(404),
)
async def suspects(
    recording: str,
    axis: AxisName,
    here: Here,
    lang: Language,
    effects: Annotated[str, Query(max_length=1000, description="names, with commas between them")] = "",
    board: Board = "",
) -> Suspects:
    row = here.store.recordings.row(recording)
    names, found = tuple(filter(None, effects.split(","))), None
    if row["header"].get("format") != FORMAT:
        asked, given = _asked(here, recording, axis), (here.store.data, recording, axis)
        found = await here.searches.run(asked, row["samples"], workbench.searched, *given, keep=True)
    answer = await here.compute.run(workbench.suspects, here.store.data, recording, axis, names, board, lang, found)
    return Suspects.model_validate(answer)


@router.get(
    "/recordings/{recording}/progress",
    summary="How far a search is that goes on for a recording",
    responses=declared(404),
)
def progress(recording: str, axis: AxisName, here: Here) -> Progress:
    here.store.recordings.row(recording)
    stage, seconds = here.searches.progress(recording, axis)
    return Progress.model_validate({"stage": stage, "seconds": seconds})


@router.get("/experiments/{experiment}/motion", summary="An experiment's motion, to be drawn", responses=declared(404))
def motion(experiment: str, here: Here) -> Path:
    return Path(**workbench.path(here.store.experiments.get(experiment)["proposal"]["motion"]))


@router.get("/examples", summary="Recordings to learn on")
def found(here: Here, lang: Language) -> Examples:
    return Examples(items=[_shown(here, name, lang) for name in (*examples.EXAMPLES, *examples.THESIS)])


@router.post("/examples/{name}", status_code=201, summary="Make an example's recording", responses=declared(404))
async def make(name: str, here: Here, lang: Language) -> Example:
    await here.compute.run(compute.example, here.store.data, name)
    return _shown(here, name, lang)


def _shown(here: Here, name: str, lang: str) -> Example:
    title, story = (render(f"example.{name}.{part}", {}, lang) for part in ("title", "story"))
    axis = examples.EXAMPLES[name].axis if name in examples.EXAMPLES else "x"
    kept = examples.kept(here.store, name)
    return Example.model_validate({"name": name, "title": title, "story": story, "axis": axis, "recording": kept})
