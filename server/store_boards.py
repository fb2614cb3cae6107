"""Boards under test, and the gyro models they carry."""

import json
from typing import Any

from calib_core.gyro_models import PRESETS, GyroModel
from calib_core.problem import Problem
from server.store_db import Connection, Row, checked_id, dumps, like, now, page

USUAL_MODEL = "LPY503AL-OUT"


class Boards:
    def __init__(self, connection: Connection) -> None:
        self._at = connection

    def get(self, board: str) -> Row:
        found = self._at.rows("select * from boards where id = ?", [board])
        if not found:
            raise Problem("board.not_found", board=board)
        return found[0]

    def find(self, *, q: str = "", limit: int = 50, cursor: str | None = None) -> tuple[list[Row], str | None]:
        select = (
            "select rowid as at, *, (select count(*) from runs where runs.board = boards.id) as runs, "
            "(select count(*) from certificates where certificates.board = boards.id) as certificates, "
            "(select max(created_at) from runs where runs.board = boards.id) as last_run_at, "
            "(select id from recordings where recordings.board = boards.id order by rowid desc limit 1) "
            "as last_recording from boards"
        )
        where = ["(id like ? escape '\\' or note like ? escape '\\')"] if q else []
        return page(self._at, select, where, [like(q)] * 2 if q else [], limit, cursor)

    def add(self, board: str, *, gyro_model: str, note: str = "") -> Row:
        """A new board; raises Problem where there is one of this id or its id has characters that cannot be used."""
        checked_id(board, "board")
        with self._at.write() as db:
            if self._at.rows("select 1 from boards where id = ?", [board]):
                raise Problem("board.exists", board=board)
            db.table("boards").insert({"id": board, "gyro_model": gyro_model, "note": note, "created_at": now()})
        return self.get(board)

    def ensure(self, board: str, *, gyro_model: str = USUAL_MODEL) -> None:
        """The board of a run or an upload, made where it is new."""
        checked_id(board, "board")
        with self._at.write() as db:
            row = {"id": board, "gyro_model": gyro_model, "note": "", "created_at": now()}
            db.table("boards").insert(row, ignore=True)

    def change(self, board: str, **changes: str) -> Row:
        self.get(board)
        with self._at.write() as db:
            if changes:
                db.table("boards").update(board, changes)
        return self.get(board)


class GyroModels:
    def __init__(self, connection: Connection) -> None:
        self._at = connection

    def get(self, model: str) -> GyroModel:
        if model in PRESETS:
            return PRESETS[model]
        found = self._at.rows("select body from gyro_models where id = ?", [model])
        if not found:
            raise Problem("gyro_model.not_found", gyro_model=model)
        return GyroModel.from_json(json.loads(found[0]["body"]))

    def find(self) -> list[GyroModel]:
        own = self._at.rows("select body from gyro_models order by rowid")
        return [*PRESETS.values(), *(GyroModel.from_json(json.loads(row["body"])) for row in own)]

    def save(self, model: GyroModel, *, new: bool) -> GyroModel:
        """Keeps a model of the operator's own; presets stay as their datasheet has them."""
        checked_id(model.id, "gyro_model")
        if model.id in PRESETS:
            raise Problem("gyro_model.preset", gyro_model=model.id)
        body: dict[str, Any] = {**model.to_json(), "preset": False}
        with self._at.write() as db:
            there = bool(self._at.rows("select 1 from gyro_models where id = ?", [model.id]))
            if new and there:
                raise Problem("gyro_model.exists", gyro_model=model.id)
            if not new and not there:
                raise Problem("gyro_model.not_found", gyro_model=model.id)
            db.table("gyro_models").upsert({"id": model.id, "body": dumps(body), "created_at": now()}, pk="id")
        return GyroModel.from_json(body)

    def delete(self, model: str) -> None:
        """Forgets an own model that no board names; runs and certificates keep their own copy."""
        if model in PRESETS:
            raise Problem("gyro_model.preset", gyro_model=model)
        with self._at.write() as db:
            self.get(model)
            boards = [row["id"] for row in self._at.rows("select id from boards where gyro_model = ? limit 5", [model])]
            if boards:
                raise Problem("gyro_model.in_use", gyro_model=model, boards=boards)
            db.table("gyro_models").delete(model)
