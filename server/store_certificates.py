"""Certificates: numbered, inserted once, never changed."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from calib_core.problem import Problem
from server.store_db import Connection, Row, dumps, like, now, page

SELECT = "select rowid as at, number, board, recording, verdict, issued_at, operator from certificates"


class Certificates:
    def __init__(self, connection: Connection) -> None:
        self._at = connection

    def issue(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Numbers and keeps a certificate: one transaction, on disk when this returns.

        The same recording, gyro model, specification, software version and compensation give the certificate that is
        there already.
        """
        named = [content["recording"]["id"], content["gyro_model"], content.get("spec"), content["software"]["version"]]
        named += [content["compensation"]] if content.get("compensation") else []
        key = hashlib.sha256(json.dumps(named, sort_keys=True).encode()).hexdigest()
        with self._at.write(durable=True) as db:
            there = self._at.rows("select content from certificates where key = ?", [key])
            if there:
                issued: dict[str, Any] = json.loads(there[0]["content"])
                return issued
            at = now()
            # None is ever deleted, so the last row's number is their count, which would have to be counted.
            count = self._at.rows("select coalesce(max(rowid), 0) + 1 as next from certificates")[0]["next"]
            number = f"GB-{at[:4]}-{count:05d}"
            issued = {**content, "number": number, "issued_at": at}
            row = {
                "number": number, "key": key, "board": content["board"], "recording": content["recording"]["id"],
                "verdict": content["verdict"], "issued_at": at, "operator": content.get("operator") or "",
                "content": dumps(issued),
            }  # fmt: skip
            db.table("certificates").insert(row)
        return issued

    def get(self, number: str) -> dict[str, Any]:
        found = self._at.rows("select content from certificates where number = ?", [number])
        if not found:
            raise Problem("certificate.not_found", number=number)
        content: dict[str, Any] = json.loads(found[0]["content"])
        return content

    def find(
        self, *, q: str = "", board: str = "", recording: str = "", limit: int = 50, cursor: str | None = None
    ) -> tuple[list[Row], str | None]:
        where, values = [], []
        if q:
            # The index alone has every text that is searched; the table's rows are some 70 kB each.
            found = "select rowid from certificates indexed by idx_certificates_number_board_operator"
            words = " or ".join(f"{column} like ? escape '\\'" for column in ("number", "board", "operator"))
            where.append(f"rowid in ({found} where {words})")
            values += [like(q)] * 3
        return page(self._at, SELECT, where, values, limit, cursor, board=board, recording=recording)
