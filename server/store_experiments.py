"""Experiments: what was proposed for a recording, the run that did it, and what all data together said."""

import json
import secrets
from collections.abc import Mapping, Sequence
from typing import Any

from calib_core.problem import Problem
from server.store_db import Connection, Row, dumps, now, page
from server.store_recordings import OPEN

SELECT = "select rowid as at, * from experiments"
JSON_COLUMNS = ("effects", "proposal", "result")


class Experiments:
    def __init__(self, connection: Connection) -> None:
        self._at = connection

    def add(self, recording: str, axis: str, effects: Sequence[str], proposal: Mapping[str, Any]) -> Row:
        """A proposal for a recording: ``next_experiment`` and the diagnosis it came with."""
        row = {
            "id": secrets.token_hex(6), "recording": recording, "axis": axis, "effects": dumps(list(effects)),
            "proposal": dumps(dict(proposal)), "run": None, "result": None, "created_at": now(),
        }  # fmt: skip
        with self._at.write() as db:
            db.table("experiments").insert(row)
        return self.get(str(row["id"]))

    def get(self, experiment: str) -> Row:
        found = self._at.rows(f"{SELECT} where id = ?", [experiment])
        if not found:
            raise Problem("experiment.not_found", experiment=experiment)
        row = _shown(found[0])
        del row["at"]
        return row

    def find(self, *, recording: str = "", limit: int = 50, cursor: str | None = None) -> tuple[list[Row], str | None]:
        where = [] if recording else [OPEN]
        rows, following = page(self._at, SELECT, where, [], limit, cursor, recording=recording)
        return [_shown(row) for row in rows], following

    def begin(self, experiment: str, run: str) -> None:
        """It is done by this run; what an earlier one gave is forgotten."""
        with self._at.write() as db:
            db.table("experiments").update(experiment, {"run": run, "result": None})

    def judge(self, experiment: str, result: Mapping[str, Any]) -> None:
        with self._at.write() as db:
            db.table("experiments").update(experiment, {"result": dumps(dict(result))})


def _shown(row: Row) -> Row:
    return {**row, **{name: None if row[name] is None else json.loads(row[name]) for name in JSON_COLUMNS}}
