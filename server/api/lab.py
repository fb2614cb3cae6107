"""The blind lab: a teacher hides effects in a bench, students hunt for them, the truth stays here till the reveal."""

import secrets
from typing import Annotated, Any, Literal

from fastapi import APIRouter, BackgroundTasks, Depends, Header, Path
from fastapi.responses import Response
from pydantic import AfterValidator, Field

from calib_core.problem import Problem
from calib_core.strengths import DIFFICULTIES, SCALE, STRONGEST
from server import experiments, lab_grading, texts
from server.api import models
from server.api.common import Cursor, Here, Language, Limit, Services
from server.api.notebooks import Effects, Name, Numbers, Text
from server.problems import declared

router = APIRouter(prefix="/lab", tags=["lab"])

Confidence = Annotated[int, Field(ge=0, le=100, description="%")]
Motions = Annotated[list[Numbers], Field(min_length=1, max_length=12)]
Key = Annotated[str | None, Header(alias="X-Lab-Key", max_length=64, description="the teacher's key")]


def _named(text: str) -> str:
    if not text.strip():
        raise Problem("lab.no_name")
    return text.strip()


class HiddenEffect(models.Body):
    """By its strength (1: METHOD's, plain to see), or by physical parameters."""

    effect: Name
    strength: Annotated[float, Field(gt=0, le=STRONGEST)] | None = None
    parameters: dict[str, float] | None = None


class NoiseBody(models.Body):
    white_mV: float = Field(1.2, ge=0, le=20, description="standard deviation of a sample at 100 Hz")
    correlated_mV: float = Field(0.0, ge=0, le=20)
    correlation_time_s: float = Field(0.5, ge=0.02, le=60)


class ExerciseBody(models.Body):
    title: models.Line = ""
    axis: models.Axis = "x"
    difficulty: Literal["easy", "medium", "hard"] | None = Field(None, description="a surprise, in place of `effects`")
    effects: list[HiddenEffect] = Field([], max_length=4, description="nothing is hidden where there are none")
    noise: NoiseBody | None = None
    seed: int | None = Field(None, ge=0, lt=2**53, description="of board, noise and surprise; drawn where left out")
    starter: Literal["sine", "mixed"] | None = Field(None, description="a recording that each student begins with")


class StudentBody(models.Body):
    name: Annotated[models.Line, Field(min_length=1, max_length=80), AfterValidator(_named)]


class MotionBody(models.Body):
    motion: Motions


class RunBody(MotionBody):
    joins: Annotated[str, Field(max_length=64)] | None = Field(None, description="an own recording to go on from")
    restart: bool = Field(False, description="switch the bench off and on first: it starts cold")


class AnswerBody(models.Body):
    """Findings, each one effect or a declared tie of several; none says that nothing is hidden."""

    findings: list[Effects] = Field(max_length=6)
    confidence: Confidence
    reasoning: Text = ""
    recording: Annotated[str, Field(max_length=64)] | None = Field(None, description="the own recording it rests on")


class Offer(models.Plain):
    name: str
    motion: list[dict[str, Any]]


class Exercise(models.Answer):
    """What everybody may know. ``truth`` is null until it is revealed."""

    code: str
    title: str
    axis: models.Axis
    starter: str | None
    created_at: str
    revealed_at: str | None
    students: int
    truth: dict[str, Any] | None
    offers: list[Offer]
    limits: dict[str, dict[str, float]]


class Made(Exercise):
    key: str = Field(description="shown once: reveal, results and delete ask for it")


class OwnRun(models.Answer):
    recording: str
    name: str
    numbers: list[int] = Field(description="the runs joined in it")
    duration_s: float
    samples: int
    created_at: str
    sentence: str


class Student(models.Answer):
    """A student's own page. ``grade`` and ``diagnosis`` are null until the truth is revealed."""

    student: str
    name: str
    notebook: str
    session: int
    runs: list[OwnRun]
    answer: dict[str, Any] | None
    submitted_at: str | None
    grade: dict[str, Any] | None
    diagnosis: dict[str, Any] | None


class Preview(models.Plain):
    duration_s: float
    sentence: str
    time_s: list[float]
    angle_deg: dict[str, list[float]]
    warming_degC: list[float]


class Result(models.Answer):
    name: str
    notebook: str
    runs: int
    measured_s: float
    answer: dict[str, Any] | None
    submitted_at: str | None
    grade: dict[str, Any] | None
    diagnosis: dict[str, Any] | None


class Results(models.Plain):
    items: list[Result]
    next: str | None
    truth: dict[str, Any]


class Hideable(models.Plain):
    effects: list[str]
    difficulties: list[str]
    strongest: float


def _code(code: Annotated[str, Path(max_length=20, description="of the exercise, as the teacher gave it")]) -> str:
    return code.strip().upper()


Code = Annotated[str, Depends(_code)]


def exercise(here: Services, code: str) -> dict[str, Any]:
    from server import lab_bench

    shown = here.store.lab.exercise(code)
    offers = [
        {"name": name, "motion": [step.to_json() for step in steps]}
        for name, steps in lab_bench.offers(shown["axis"]).items()
    ]
    limits = {
        name: {
            "lowest_deg": axis.min_deg,
            "highest_deg": axis.max_deg,
            "highest_dps": lab_bench.GYRO.axes[name].range_dps,
        }
        for name, axis in lab_bench.AXES.items()
    }
    return shown | {"offers": offers, "limits": limits}


def motion_sentence(motion: list[dict[str, Any]], lang: str) -> str:
    return texts.render("lab.motion_sentence", {"motion": experiments.motion_words(motion)}, lang)


def told(said: dict[str, Any] | None, lang: str) -> dict[str, Any] | None:
    """What the instrument says of a student's data, in words."""
    if said is None:
        return None
    at = said.get("message", said)
    return said | {"sentence": texts.render(at["code"], at["values"], lang)}


def student(here: Services, code: str, who: str, lang: str) -> Student:
    """What a student may see: of the truth nothing before it is revealed."""
    row = here.store.lab.student(code, who)
    truth = here.store.lab.exercise(code)["truth"]
    runs = [run | {"sentence": motion_sentence(run["motion"], lang)} for run in here.store.lab.runs(who)]
    facts = {name: row[name] for name in ("name", "notebook", "session", "answer", "submitted_at")}
    graded = said = None
    if truth is not None and row["answer"] is not None:
        graded, said = _grade(truth, row), told(row["diagnosis"], lang)
    return Student.model_validate(facts | {"student": who, "runs": runs, "grade": graded, "diagnosis": said})


def _grade(truth: dict[str, Any], row: dict[str, Any]) -> dict[str, Any]:
    names = [one["effect"] for one in truth["effects"]]
    return lab_grading.grade(names, row["answer"]["findings"], row["diagnosis"])


# --- for everybody -----------------------------------------------------------------------------------------------
@router.post("", status_code=201, summary="Hide something, or nothing, in a bench", responses=declared(409))
async def create(body: ExerciseBody, here: Here) -> Made:
    from server import lab_bench

    seed = secrets.randbits(53) if body.seed is None else body.seed
    chosen = [one.model_dump() for one in body.effects]
    if body.difficulty is not None and chosen:
        raise Problem("lab.both")
    hidden = lab_bench.truth(
        body.axis,
        seed,
        difficulty=body.difficulty,
        effects=chosen,
        noise=body.noise.model_dump() if body.noise else None,
    )
    await here.bench.run(lab_bench.rehearse, hidden)
    code, key = here.store.lab.create(body.title, hidden, body.starter)
    return Made.model_validate(exercise(here, code) | {"key": key})


@router.get("/effects", summary="What a bench can hide")
def hideable() -> Hideable:
    return Hideable(effects=list(SCALE), difficulties=list(DIFFICULTIES), strongest=STRONGEST)


@router.get("/{code}", summary="An exercise, as everybody may know it", responses=declared(404))
def one(code: Code, here: Here) -> Exercise:
    return Exercise.model_validate(exercise(here, code))


# --- for students ------------------------------------------------------------------------------------------------
@router.post("/{code}/students", status_code=201, summary="Join with a name", responses=declared(404, 409))
async def join(code: Code, body: StudentBody, here: Here, lang: Language) -> Student:
    from server import lab_bench

    who = here.store.lab.join(code, body.name)
    known = here.store.lab.exercise(code)
    if known["starter"]:
        motion = lab_bench.starter(known["starter"], known["axis"])
        await here.bench.run(lab_bench.run, here.store.data, code, who, motion, None, False)
    return student(here, code, who, lang)


@router.get("/{code}/students/{who}", summary="A student's own page", responses=declared(404))
def own(code: Code, who: str, here: Here, lang: Language) -> Student:
    return student(here, code, who, lang)


@router.post("/{code}/students/{who}/plan", summary="What a motion would do, before it is run", responses=declared(404))
def plan(code: Code, who: str, body: MotionBody, here: Here, lang: Language) -> Preview:
    from server import lab_bench

    here.store.lab.student(code, who)
    motion = [one.model_dump() for one in body.motion]
    shown = lab_bench.preview(motion, here.store.lab.exercise(code)["axis"])
    return Preview.model_validate(shown | {"sentence": motion_sentence(motion, lang)})


@router.post(
    "/{code}/students/{who}/runs",
    status_code=201,
    summary="Run a motion on the hidden bench",
    responses=declared(404, 409),
)
async def run(code: Code, who: str, body: RunBody, here: Here, lang: Language) -> OwnRun:
    from server import lab_bench

    here.store.lab.student(code, who)
    motion = [one.model_dump() for one in body.motion]
    made = await here.bench.run(lab_bench.run, here.store.data, code, who, motion, body.joins, body.restart)
    return next(run for run in student(here, code, who, lang).runs if run.recording == made)


@router.put("/{code}/students/{who}/answer", summary="Hand in an answer", responses=declared(404, 409))
def answer(code: Code, who: str, body: AnswerBody, here: Here, lang: Language, after: BackgroundTasks) -> Student:
    from calib_core.effects import library

    row = here.store.lab.student(code, who)
    if here.store.lab.exercise(code)["revealed_at"]:
        raise Problem("lab.revealed")
    for name in (name for names in body.findings for name in names):
        if name not in library():
            raise Problem("effects.unknown", given=name, allowed=", ".join(library()))
    if body.recording is not None:
        here.store.lab.own_run(who, body.recording)
    given = body.model_dump()
    here.store.lab.answer(code, who, given)
    line = {name: given[name] for name in ("findings", "confidence", "reasoning")}
    here.store.notebooks.append(row["notebook"], "submitted", line)
    if body.recording is not None:
        after.add_task(judge, here, code, who, body.recording)
    return student(here, code, who, lang)


async def judge(here: Services, code: str, who: str, recording: str) -> None:
    """What the instrument says of the data that an answer rests on: for the grading of ties, once it is ready."""
    from server import lab_bench

    samples = here.store.recordings.row(recording)["samples"]
    asked = (recording, "", "handed in")  # no axis: of this search no page is told
    said = await here.searches.run(asked, samples, lab_bench.judged, here.store.data, code, who, recording)
    here.store.lab.judge(who, recording, said)


# --- for whoever has the key -------------------------------------------------------------------------------------
def results_of(here: Services, code: str, lang: str, limit: int, cursor: str | None) -> tuple[list[Any], str | None]:
    truth = here.store.lab.truth(code)
    rows, following = here.store.lab.students(code, limit=limit, cursor=cursor)
    items = []
    for row in rows:
        runs = here.store.lab.runs(row["id"])
        items.append(
            {name: row[name] for name in ("name", "notebook", "answer", "submitted_at")}
            | {"runs": len(runs), "measured_s": sum(run["run_s"] for run in runs)}
            | {"grade": _grade(truth, row) if row["answer"] else None, "diagnosis": told(row["diagnosis"], lang)}
        )
    return items, following


@router.get("/{code}/results", summary="Who found what, and the truth", responses=declared(403, 404))
def results(
    code: Code, here: Here, lang: Language, key: Key = None, limit: Limit = 50, cursor: Cursor = None
) -> Results:
    here.store.lab.check_key(code, key)
    items, following = results_of(here, code, lang, limit, cursor)
    return Results.model_validate({"items": items, "next": following, "truth": here.store.lab.truth(code)})


@router.get(
    "/{code}/results.csv",
    summary="The same as a table: one row a student",
    responses={200: {"content": {"text/csv; charset=utf-8": {}}}, **declared(403, 404)},
    response_class=Response,
)
def table(code: Code, here: Here, lang: Language, key: Key = None) -> Response:
    from server.documents.lab_table import render_results
    from server.store_lab import MOST_STUDENTS

    here.store.lab.check_key(code, key)
    items, _ = results_of(here, code, lang, MOST_STUDENTS, None)
    content = render_results(here.store.lab.truth(code), reversed(items))
    headers = {"Content-Disposition": f'attachment; filename="lab-{code}.csv"'}
    return Response(content, media_type="text/csv; charset=utf-8", headers=headers)


@router.post("/{code}/reveal", summary="Let everybody see the truth; answers are closed", responses=declared(404))
async def reveal(code: Code, here: Here, key: Key = None) -> Exercise:
    here.store.lab.check_key(code, key)
    for who, recording in here.store.lab.unjudged(code):
        await judge(here, code, who, recording)
    here.store.lab.reveal(code)
    return Exercise.model_validate(exercise(here, code))


@router.delete("/{code}", status_code=204, summary="Forget the exercise with its answers", responses=declared(404))
def delete(code: Code, here: Here, key: Key = None) -> None:
    here.store.lab.check_key(code, key)
    here.store.lab.delete(code)
