"""Boards under test."""

from typing import Any

from fastapi import APIRouter

from server.api import models
from server.api.common import Cursor, Here, Limit, Search
from server.problems import declared

router = APIRouter(prefix="/boards", tags=["boards"])


@router.get("", summary="Boards, newest first")
def boards(here: Here, q: Search = "", limit: Limit = 50, cursor: Cursor = None) -> models.Boards:
    items, following = here.store.boards.find(q=q, limit=limit, cursor=cursor)
    return models.Boards.model_validate({"items": items, "next": following})


@router.post("", status_code=201, summary="A new board", responses=declared(404, 409))
def add(body: models.BoardBody, here: Here) -> models.Board:
    here.store.gyro_models.get(body.gyro_model)
    return models.Board(**here.store.boards.add(body.id, gyro_model=body.gyro_model, note=body.note))


@router.get("/{board}", summary="A board with its last runs and certificates", responses=declared(404))
def board(board: str, here: Here) -> models.Board:
    row = here.store.boards.get(board)
    runs, _ = here.store.runs.find(board=board, limit=50)
    certificates, _ = here.store.certificates.find(board=board, limit=50)
    shown: dict[str, Any] = {**row, "runs": [_brief(run) for run in runs], "certificates": certificates}
    return models.Board(**shown)


@router.patch("/{board}", summary="Change a board's gyro model or note", responses=declared(404))
def change(board: str, body: models.BoardChange, here: Here) -> models.Board:
    if body.gyro_model is not None:
        here.store.gyro_models.get(body.gyro_model)
    return models.Board(**here.store.boards.change(board, **body.model_dump(exclude_none=True)))


def _brief(run: dict[str, Any]) -> dict[str, Any]:
    names = ("id", "status", "profile", "gyro_model", "recording", "certificate", "created_at", "finished_at")
    return {name: run[name] for name in names}
