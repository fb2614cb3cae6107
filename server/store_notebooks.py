"""Lab notebooks: lines that are written once, in their order, and never changed or taken out."""

import json
import secrets
from collections.abc import Mapping
from typing import Any

from calib_core.problem import Problem
from server.store_db import Connection, Row, dumps, now, page

MOST_LINES = 2000
SELECT = (
    "select rowid as at, id, title, author, created_at, "
    "(select count(*) from notebook_lines where notebook = notebooks.id) as lines, "
    "(select max(at) from notebook_lines where notebook = notebooks.id) as last_at from notebooks"
)


class Notebooks:
    def __init__(self, connection: Connection) -> None:
        self._at = connection

    def create(self, *, title: str = "", author: str = "", lab: str = "") -> str:
        """An empty notebook; gives its id. One that belongs to a blind exercise (``lab``) is in no list."""
        notebook = secrets.token_hex(8)
        with self._at.write() as db:
            row = {"id": notebook, "title": title, "author": author, "lab": lab, "created_at": now()}
            db.table("notebooks").insert(row)
        return notebook

    def get(self, notebook: str) -> Row:
        found = self._at.rows(f"{SELECT} where id = ?", [notebook])
        if not found:
            raise Problem("notebook.not_found", notebook=notebook)
        del found[0]["at"]
        return found[0]

    def find(self, *, limit: int = 50, cursor: str | None = None) -> tuple[list[Row], str | None]:
        return page(self._at, SELECT, ["lab = ''"], [], limit, cursor)

    def append(self, notebook: str, step: str, values: Mapping[str, Any]) -> Row:
        """The next line, stamped with the time; raises Problem where there is no such notebook or it is full."""
        with self._at.write() as db:
            number = self.get(notebook)["lines"] + 1
            if number > MOST_LINES:
                raise Problem("notebook.full", most=MOST_LINES)
            line = {"notebook": notebook, "n": number, "at": now(), "step": step, "body": dumps(dict(values))}
            db.table("notebook_lines").insert(line)
        return _shown(line)

    def lines(self, notebook: str) -> list[Row]:
        """All lines, the oldest first."""
        return [
            _shown(row)
            for row in self._at.rows("select * from notebook_lines where notebook = ? order by n", [notebook])
        ]


def _shown(row: Row) -> Row:
    return {"n": row["n"], "at": row["at"], "step": row["step"], "values": json.loads(row["body"])}
