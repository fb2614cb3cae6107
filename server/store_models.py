"""Saved models: what was fitted to a recording's axis, with its error, as it was found."""

import json
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib_core.problem import Problem
from server import __version__
from server.store_db import Connection, Row, dumps, like, migrations, now, page
from server.store_recordings import OPEN

if TYPE_CHECKING:
    from sqlite_utils import Database

    from calib_core.compensation import Compensation

SELECT = "select rowid as at, * from models"


@migrations(name="0009_models")
def _models(db: "Database") -> None:
    columns = {"id": str, "name": str, "board": str, "recording": str, "axis": str, "body": str, "created_at": str}
    db.table("models").create(columns, pk="id", foreign_keys=[("recording", "recordings", "id")])


class Models:
    def __init__(self, connection: Connection) -> None:
        self._at = connection

    def add(self, facts: Mapping[str, Any], body: Mapping[str, Any]) -> Row:
        """``facts``: name, board, recording, axis; ``body``: the rest of what ``fitted`` found."""
        row = {"id": secrets.token_hex(6), **facts, "body": dumps(dict(body)), "created_at": now()}
        with self._at.write() as db:
            db.table("models").insert(row)
        return self.get(row["id"])

    def get(self, model: str) -> Row:
        """Raises Problem ``model.not_found``."""
        found = self._at.rows(f"{SELECT} where id = ?", [model])
        if not found:
            raise Problem("model.not_found", model=model)
        row = _shown(found[0])
        del row["at"]
        return row

    def __contains__(self, model: str) -> bool:
        return bool(self._at.rows("select 1 as there from models where id = ?", [model]))

    def find(
        self, *, q: str = "", board: str = "", recording: str = "", limit: int = 50, cursor: str | None = None
    ) -> tuple[list[Row], str | None]:
        where, values = [] if recording else [OPEN], []
        if q:
            where.append("(name like ? escape '\\' or board like ? escape '\\' or id = ?)")
            values += [like(q), like(q), q]
        rows, following = page(self._at, SELECT, where, values, limit, cursor, board=board, recording=recording)
        return [_shown(row) for row in rows], following

    def delete(self, model: str) -> None:
        """Certificates that were issued with it carry it, and stay as they are. Raises Problem ``model.not_found``."""
        self.get(model)
        with self._at.write() as db:
            db.table("models").delete(model)


def save(data: Path, name: str, recording: str, axis: str, effects: Sequence[str], note: str) -> str:
    """Fits base and effects as the workbench does, and keeps the model; gives its id."""
    from calib_core.formula import to_json
    from server.store import Store
    from server.workbench import warm

    bench = warm(data, recording, axis)
    with Store(data) as store:
        own = {n: effect for n, effect in store.effects.classes().items() if n in effects}
        for effect in own.values():
            bench.own(effect)
        model = bench.fit(effects)
        error, noise = model.fitted.error, model.space.noise.noise
        scale = abs(model.space.scale_factor) or 1.0
        header, kept = bench.recording.header, store.recordings.row(recording)
        facts = {"name": name, "board": kept["board"], "recording": recording, "axis": axis}
        body = {
            "note": note,
            "unit": model.space.design.averages.samples.unit,
            "effects": list(model.effects),
            "parameters": model.parameters,
            "reference": dict(model.space.covariates.reference),
            "noise": {"white_dps": noise.white / scale, "correlation_time_s": noise.correlation_time_s or None},
            "error": {
                "held_out_rms_dps": error.held_out_rms_dps,
                "floor_rms_dps": error.floor_rms_dps,
                "holdout": {"block_s": error.block_s, "blocks": error.blocks},
            },
            "user_effects": [to_json(effect) for effect in own.values()],
            "digest": kept["digest"],
            "rig": header.get("rig", ""),
            "software": {"name": "gyrobench", "version": __version__},
        }
        compensation_of({**facts, **body, "id": ""})  # refused now rather than when it is needed
        return str(store.models.add(facts, body)["id"])


def compensation_of(row: Mapping[str, Any]) -> "Compensation":
    """A saved model turned round. Raises Problem ``compensation.…``."""
    from calib_core.compensation import Compensation

    return Compensation.of(
        row["parameters"],
        axis=row["axis"],
        unit=row["unit"],
        reference=row["reference"],
        user_effects=row["user_effects"],
        board=row["board"],
        source={key: value for key in ("id", "name", "recording", "digest") if (value := row[key])},
    )


def saved_in(data: str | Path | None, model: str) -> "Compensation | None":
    """The saved model of a store turned round; None where there is none of that id."""
    from server.store import Store

    with Store(data) as store:
        return compensation_of(store.models.get(model)) if model in store.models else None


def _shown(row: Row) -> dict[str, Any]:
    body = json.loads(row.pop("body"))
    return {**row, **body}
