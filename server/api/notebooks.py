"""Lab notebooks: what a student did, line by line, and the PDF to hand in."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter
from fastapi.responses import Response
from pydantic import Field, model_validator

from server import compute, notebook
from server.api import models
from server.api.common import Cursor, Here, Language, Limit
from server.problems import declared

router = APIRouter(prefix="/notebooks", tags=["notebooks"])

Name = Annotated[str, Field(min_length=1, max_length=64)]
Effects = Annotated[list[Name], Field(min_length=1, max_length=10)]
Text = Annotated[str, Field(max_length=4000)]
Size = Annotated[float, Field(ge=0, le=1e9)]
Unit = Literal["deg/s", "deg"]


class NotebookBody(models.Body):
    title: models.Line = ""
    author: models.Line = Field("", description="who writes in it")


class Opened(models.Body):
    step: Literal["opened"]
    recording: Annotated[str, Field(max_length=64)]
    name: models.Line
    axis: Literal["x", "y", "z"]
    samples: Annotated[int, Field(ge=0, le=10**9)]
    duration_s: Size


class Guessed(models.Body):
    """A cause picked before the evidence is seen (none: nothing is missing), the picture that failed, and why."""

    step: Literal["guessed"]
    effects: list[Name] = Field([], max_length=10)
    covariate: Annotated[str, Field(max_length=64)] | None = None
    why: Text = ""


class Seen(models.Body):
    """The evidence for a suspect; null where the recording could not test it."""

    step: Literal["seen"]
    effect: Name
    two_delta_lnL: Annotated[float, Field(ge=-1e9, le=1e9)] | None = None


class Changed(models.Body):
    """Effects that came into the model, or left it, with the error on unseen data before and after."""

    step: Literal["added", "removed"]
    effects: Effects
    before: Size
    after: Size
    floor: Size | None = None
    unit: Unit = "deg/s"


class Numbers(models.Body):
    """One motion, as CONTRACT 3 writes it."""

    axis: models.Axis
    kind: Literal["sine", "multisine", "staircase", "hold", "poses", "heat"]
    amplitude_deg: list[Annotated[float, Field(ge=0, le=360)]] = Field([], max_length=50)
    frequency_hz: list[Annotated[float, Field(gt=0, le=1000)]] = Field([], max_length=50)
    rates_dps: list[Annotated[float, Field(ge=0.1, le=5000)]] = Field([], max_length=50)
    angles_deg: list[Annotated[float, Field(ge=-3600, le=3600)]] = Field([], max_length=50)
    duration_s: Annotated[float, Field(gt=0, le=3600)]


class Experiment(models.Body):
    step: Literal["experiment"]
    motion: Annotated[list[Numbers], Field(min_length=1, max_length=20)]
    duration_s: Size
    recording: Annotated[str, Field(max_length=64)] | None = None


class Verdict(models.Body):
    """What the diagnosis said: its own code and values."""

    step: Literal["verdict"]
    code: Annotated[str, Field(max_length=64)]
    values: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _can_be_said(self) -> "Verdict":
        notebook.checked_verdict(self.code, self.values)
        return self


class Note(models.Body):
    step: Literal["note"]
    text: Annotated[str, Field(min_length=1, max_length=4000)]


class Submitted(models.Body):
    """An answer handed in to a blind exercise: findings, each a name or a tie of names; none is an answer too."""

    step: Literal["submitted"]
    findings: Annotated[list[Effects], Field(max_length=10)]
    confidence: Annotated[int, Field(ge=0, le=100, description="%")]
    reasoning: Text = ""


LineBody = Annotated[
    Opened | Guessed | Seen | Changed | Experiment | Verdict | Note | Submitted, Field(discriminator="step")
]


class Line(models.Answer):
    n: int
    at: str
    step: str
    values: dict[str, Any]
    sentence: str
    own: str | None = Field(description="the student's own words")


class Notebook(models.Answer):
    id: str
    title: str
    author: str
    created_at: str
    last_at: str | None
    lines: int


class Notebooks(models.Plain):
    items: list[Notebook]
    next: str | None


class Opening(Notebook):
    """A notebook with everything that stands in it."""

    content: list[Line]


@router.post("", status_code=201, summary="Begin a notebook")
def begin(body: NotebookBody, here: Here) -> Notebook:
    made = here.store.notebooks.create(title=body.title, author=body.author)
    return Notebook.model_validate(here.store.notebooks.get(made))


@router.get("", summary="Notebooks, newest first; those of blind exercises are in no list")
def found(here: Here, limit: Limit = 50, cursor: Cursor = None) -> Notebooks:
    items, following = here.store.notebooks.find(limit=limit, cursor=cursor)
    return Notebooks.model_validate({"items": items, "next": following})


@router.get(
    "/{notebook_id}.pdf",
    summary="A notebook as it is handed in",
    responses={200: {"content": {"application/pdf": {}}}, **declared(404)},
    response_class=Response,
)
async def document(
    notebook_id: str, here: Here, accepted: Language, lang: Literal["en", "th"] | None = None
) -> Response:
    rendered = await here.compute.run(compute.notebook, here.store.data, notebook_id, lang or accepted)
    headers = {"Content-Disposition": f'attachment; filename="notebook-{notebook_id}.pdf"'}
    return Response(rendered, media_type="application/pdf", headers=headers)


@router.get("/{notebook_id}", summary="A notebook with its lines", responses=declared(404))
def one(notebook_id: str, here: Here, lang: Language) -> Opening:
    head = here.store.notebooks.get(notebook_id)
    content = [notebook.told(line, lang) for line in here.store.notebooks.lines(notebook_id)]
    return Opening.model_validate(head | {"content": content})


@router.post(
    "/{notebook_id}/lines", status_code=201, summary="Write the next line; it stays", responses=declared(404, 409)
)
def write(notebook_id: str, body: LineBody, here: Here, lang: Language) -> Line:
    values = body.model_dump(exclude={"step"}, exclude_none=True)
    return Line.model_validate(notebook.told(here.store.notebooks.append(notebook_id, body.step, values), lang))
