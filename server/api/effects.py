"""The effects that models are made of: the library, and users' own formulas."""

from typing import Annotated, Literal

from fastapi import APIRouter, Response
from pydantic import Field

from server import diagnosis
from server.api import models
from server.api.common import Here, Language
from server.problems import declared

router = APIRouter(prefix="/effects", tags=["effects"])
Acts = Literal["output", "rate", "angle"]


class EffectBody(models.Body):
    """A user's own effect: parameter × formula on the output, the rate the sensor feels, or the encoder's angle."""

    name: Annotated[str, Field(max_length=60, description="small letters, digits, _")]
    formula: Annotated[
        str, Field(max_length=1000, description="over rate_dps, temperature_c …: numbers, + - * / **, functions")
    ]
    parameter: Annotated[str, Field(max_length=60)] = "k"
    unit: Annotated[str, Field(max_length=60, description="of the parameter; {out} stands for the recording's unit")]
    acts: Acts = "output"
    note: models.Note = ""


class Parameter(models.Plain):
    name: str
    unit: str = Field(description="{out} stands for the recording's unit")
    typical: float
    bounds: tuple[float, float]
    grid: list[float] = Field(description="where the search begins; empty for a linear parameter")


class Effect(models.Plain):
    """One physical effect: where it acts, what it is, how it shows, and how to provoke it."""

    name: str
    title: str
    stage: Literal["table", "sensor", "electrics", "acquisition"]
    needs: list[str]
    parameters: list[Parameter]
    summary: str
    equation: str
    cause: str
    signature: str
    confused_with: str
    excite_it: str
    source: str
    own: bool = Field(description="whether a user made it")
    formula: str | None = None
    acts: Acts | None = None
    note: str | None = None
    created_at: str | None = None


class Effects(models.Plain):
    items: list[Effect]
    next: None = None


@router.get("", summary="The library and users' own: equations, causes, signatures, parameters")
def effects(here: Here, lang: Language) -> Effects:
    own = [diagnosis.own_card(row, lang) for row in here.store.effects.find()]
    return Effects.model_validate({"items": [*diagnosis.cards(lang), *own]})


@router.post("", status_code=201, summary="Keep an effect of one's own", responses=declared(409))
def add(body: EffectBody, here: Here, lang: Language) -> Effect:
    given = body.model_dump()
    return Effect.model_validate(diagnosis.own_card(here.store.effects.add(given, note=given.pop("note")), lang))


@router.get("/{effect}", summary="One effect", responses=declared(404))
def effect(effect: str, here: Here, lang: Language) -> Effect:
    found = next((card for card in diagnosis.cards(lang) if card["name"] == effect), None)
    return Effect.model_validate(found or diagnosis.own_card(here.store.effects.get(effect), lang))


@router.delete("/{effect}", status_code=204, summary="Forget an effect of one's own", responses=declared(404, 409))
def delete(effect: str, here: Here) -> Response:
    here.store.effects.delete(effect)
    return Response(status_code=204)
