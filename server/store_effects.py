"""Users' own effects: a formula, its parameter and unit, under a name of its own."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, quote

from calib_core.problem import Problem
from server.store_db import FILE, Connection, Row, dumps, migrations, now

if TYPE_CHECKING:
    from sqlite_utils import Database

    from calib_core.effects import Effect
    from calib_core.formula import UserEffect

MOST = 100


@migrations(name="0008_effects")
def _effects(db: "Database") -> None:
    db.table("effects").create({"name": str, "body": str, "note": str, "created_at": str}, pk="name")


class Effects:
    def __init__(self, connection: Connection) -> None:
        self._at = connection

    def add(self, given: Mapping[str, object], *, note: str = "") -> Row:
        """Keeps an effect (``formula.to_json``'s keys). Raises Problem ``formula.…``, ``effect.exists``."""
        from calib_core.formula import from_json, to_json

        body = to_json(from_json(given))
        row = {"name": body["name"], "body": dumps(body), "note": note, "created_at": now()}
        with self._at.write() as db:
            kept = {there["name"] for there in self._at.rows("select name from effects")}
            if body["name"] in kept:
                raise Problem("effect.exists", effect=body["name"])
            if len(kept) >= MOST:
                raise Problem("effect.too_many", most=MOST)
            db.table("effects").insert(row)
        return self.get(body["name"])

    def get(self, name: str) -> Row:
        """Its JSON with note and day. Raises Problem ``effect.not_found``."""
        found = self._at.rows("select * from effects where name = ?", [name])
        if not found:
            raise Problem("effect.not_found", effect=name)
        return _shown(found[0])

    def find(self) -> list[Row]:
        return [_shown(row) for row in self._at.rows("select * from effects order by name")]

    def delete(self, name: str) -> None:
        """Raises Problem ``effect.not_found``, and ``effect.of_library`` for what is nobody's own.

        Models, certificates and recordings that use it carry its formula, and go on working.
        """
        from calib_core.effects import library

        if name in library():
            raise Problem("effect.of_library", effect=name)
        self.get(name)
        with self._at.write() as db:
            db.table("effects").delete(name)

    def classes(self) -> "dict[str, type[UserEffect]]":
        """By name. What a later library has under the same name is left to the library."""
        from calib_core.effects import library
        from calib_core.formula import from_json

        return {row["name"]: from_json(row) for row in self.find() if row["name"] not in library()}

    def suspects(self) -> "dict[str, type[Effect]]":
        """The library and the users' own: what a diagnosis may name."""
        from calib_core.effects import library

        return {**library(), **self.classes()}

    def address(self, url: str) -> str:
        """A twin's address with the formulas of the users' own effects that it hides: it needs no store then."""
        from calib_core.formula import to_json

        _, _, query = url.partition("?")
        options = dict(parse_qsl(query))
        if not url.startswith("twin:") or "own" in options:
            return url
        paths = [part.partition(":")[0].strip().split(".") for part in options.get("effects", "").split(";")]
        named = {path[-2] for path in paths if len(path) > 1}
        used = [to_json(effect) for name, effect in self.classes().items() if name in named]
        return f"{url}&own={quote(dumps(used), safe='')}" if used else url


def suspects_of(data: str | Path | None) -> "dict[str, type[Effect]]":
    """``Effects.suspects`` of the store in ``data``; only the library where there is no store yet, and none is made."""
    from calib_core.effects import library

    with _there(data) as effects:
        return effects.suspects() if effects else dict(library())


def address_of(url: str, data: str | Path | None) -> str:
    """``Effects.address`` by the store in ``data``, if there is one."""
    if "effects=" not in url:
        return url
    with _there(data) as effects:
        return effects.address(url) if effects else url


@contextmanager
def _there(data: str | Path | None) -> Iterator[Effects | None]:
    from server.settings import data_dir
    from server.store import Store

    if not (data_dir(data) / FILE).is_file():
        yield None
        return
    with Store(data) as store:
        yield store.effects


def _shown(row: Row) -> dict[str, Any]:
    return {**json.loads(row["body"]), "note": row["note"], "created_at": row["created_at"]}
