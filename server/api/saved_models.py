"""Saved models: fitted to a recording as in the workbench, kept, and given out as code that compensates."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Response
from pydantic import Field

from server import compute
from server.api import models
from server.api.common import Cursor, Here, Limit, Search
from server.problems import declared

router = APIRouter(prefix="/models", tags=["models"])
MEDIA = {"json": "application/json", "h": "text/x-c; charset=utf-8", "py": "text/x-python; charset=utf-8"}
EffectName = Annotated[str, Field(min_length=1, max_length=64)]


class ModelBody(models.Body):
    name: Annotated[models.Line, Field(min_length=1)]
    recording: str = Field(max_length=64)
    axis: Literal["x", "y", "z"]
    effects: list[EffectName] = Field([], max_length=12, description="of the library or a user's own; none: the base")
    note: models.Note = ""


class Parameter(models.Plain):
    name: str
    value: float
    unit: str
    standard_uncertainty: float | None


class Model(models.Answer):
    id: str
    name: str
    recording: str
    board: str
    axis: str
    unit: str
    effects: list[str]
    parameters: list[Parameter]
    reference: dict[str, float]
    noise: dict[str, float | None]
    error: dict[str, Any]
    user_effects: list[dict[str, str]]
    software: dict[str, str]
    note: str
    created_at: str


class Models(models.Plain):
    items: list[Model]
    next: str | None


@router.get("", summary="Saved models, newest first")
def found(
    here: Here,
    q: Search = "",
    board: Search = "",
    recording: Annotated[str, Query(max_length=64)] = "",
    limit: Limit = 50,
    cursor: Cursor = None,
) -> Models:
    rows, following = here.store.models.find(q=q, board=board, recording=recording, limit=limit, cursor=cursor)
    return Models.model_validate({"items": rows, "next": following})


@router.post("", status_code=201, summary="Fit a model to a recording and keep it", responses=declared(404))
async def save(body: ModelBody, here: Here) -> Model:
    effects = tuple(dict.fromkeys(body.effects))
    made = await here.compute.run(
        compute.save_model, here.store.data, body.name, body.recording, body.axis, effects, body.note
    )
    return Model.model_validate(here.store.models.get(made))


@router.get(
    "/{model}.{form}",
    summary="What compensates by it: .json, .h (C99) or .py",
    responses={200: {"content": {media: {} for media in MEDIA.values()}}, **declared(404)},
    response_class=Response,
)
async def code(model: str, form: Literal["json", "h", "py"], here: Here) -> Response:
    text = await here.compute.run(compute.export_model, here.store.data, model, form)
    headers = {"Content-Disposition": f'attachment; filename="{model}.{form}"'}
    return Response(text, media_type=MEDIA[form], headers=headers)


@router.get("/{model}", summary="One saved model", responses=declared(404))
def model(model: str, here: Here) -> Model:
    return Model.model_validate(here.store.models.get(model))


@router.delete("/{model}", status_code=204, summary="Forget a saved model", responses=declared(404))
def delete(model: str, here: Here) -> Response:
    here.store.models.delete(model)
    return Response(status_code=204)
