"""Batches: many files certified together, each with its own end."""

import json
import secrets
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from calib_core.problem import Problem
from server.store_db import Connection, Row, dumps, migrations, now, page

if TYPE_CHECKING:
    from sqlite_utils import Database

SELECT = "select rowid as at, * from batches"
OPEN = "status in ('queued', 'running')"
JSON_COLUMNS = ("error", "axes", "warnings")


@migrations(name="0011_batches")
def _batches(db: "Database") -> None:
    db.table("batches").create(
        {
            "id": str, "key": str, "fingerprint": str, "name": str, "status": str, "gyro_model": str, "spec": str,
            "message": str, "created_at": str, "began_at": str, "finished_at": str,
        },
        pk="id",
    )  # fmt: skip
    db.table("batches").create_index(["key"], unique=True)
    db.table("batch_files").create(
        {
            "id": int, "batch": str, "position": int, "name": str, "size": int, "status": str, "change": int,
            "board": str, "certificate": str, "verdict": str, "error": str, "axes": str, "warnings": str,
            "cpu_s": float, "finished_at": str,
        },
        pk="id",
        foreign_keys=[("batch", "batches", "id")],
    )  # fmt: skip
    db.table("batch_files").create_index(["batch", "change"], unique=True)
    db.table("batch_files").create_index(["batch", "status", "verdict"])
    db.execute("create index idx_batch_files_waiting on batch_files (id) where status = 'waiting'")


class Batches:
    def __init__(self, connection: Connection) -> None:
        self._at = connection

    def create(
        self, batch: str, files: Sequence[Mapping[str, Any]], *, name: str, fingerprint: str, key: str | None = None,
        gyro_model: Mapping[str, Any] | None = None, spec: Mapping[str, Any] | None = None,
    ) -> tuple[str, bool]:  # fmt: skip
        """The id of a batch of ``files`` ({"name", "size", "error"}), and whether it is new.

        A key that was used before gives the batch it was used for; raises Problem batch.key_used where that one was
        of other files or settings.
        """
        row = {
            "id": batch, "key": key, "fingerprint": fingerprint, "name": name, "status": "queued",
            "gyro_model": gyro_model and dumps(gyro_model), "spec": spec and dumps(spec), "message": None,
            "created_at": now(), "began_at": None, "finished_at": None,
        }  # fmt: skip
        with self._at.write(durable=True) as db:
            there = self._at.rows("select id, fingerprint from batches where key = ?", [key]) if key else []
            if there:
                if there[0]["fingerprint"] != fingerprint:
                    raise Problem("batch.key_used", batch=there[0]["id"])
                return str(there[0]["id"]), False
            db.table("batches").insert(row)
            db.conn.executemany(
                "insert into batch_files (batch, position, name, size, change, status, verdict, error) "
                "values (?, ?, ?, ?, ?, ?, ?, ?)",
                [(batch, n, f["name"], f["size"], n, *_begun(f.get("error"))) for n, f in enumerate(files, 1)],
            )
            self._end_where_done(batch)
        return batch, True

    def get(self, batch: str) -> Row:
        found = self._at.rows(f"{SELECT} where id = ?", [batch])
        if not found:
            raise Problem("batch.not_found", batch=batch)
        row = self._shown(found[0])
        del row["at"]
        return row

    def find(self, *, limit: int = 50, cursor: str | None = None) -> tuple[list[Row], str | None]:
        rows, following = page(self._at, SELECT, [], [], limit, cursor)
        return [self._shown(row) for row in rows], following

    def files(
        self, batch: str, *, status: str = "", limit: int = 200, cursor: str | None = None
    ) -> tuple[list[Row], str | None]:
        """Files in the order in which they last changed, and where to go on; None at the end.

        Whoever follows a batch asks again with the last ``change`` it has seen as cursor.
        """
        if cursor is not None and not cursor.isdigit():
            raise Problem("request.cursor", given=cursor)
        where, values = "batch = ? and change > ?", [batch, int(cursor or 0)]
        if status:
            where, values = f"{where} and status = ?", [*values, status]
        found = self._at.rows(f"select * from batch_files where {where} order by change limit ?", [*values, limit + 1])
        rows = [_file(row) for row in found[:limit]]
        return rows, str(rows[-1]["change"]) if len(found) > limit else None

    # --- what the engine asks and says -----------------------------------------------------------------------------
    def waiting(self, limit: int) -> list[Row]:
        """Files that wait, oldest first, with their batch's settings."""
        return self._at.rows(
            "select f.id, f.batch, f.position, f.name, b.gyro_model, b.spec from batch_files f "
            "join batches b on b.id = f.batch where f.status = 'waiting' order by f.id limit ?",
            [limit],
        )

    def count_waiting(self) -> int:
        return int(self._at.rows("select count(*) as n from batch_files where status = 'waiting'")[0]["n"])

    def is_open(self, batch: str) -> bool:
        return bool(self._at.rows(f"select 1 from batches where id = ? and {OPEN}", [batch]))

    def begin(self, batch: str) -> None:
        if self._at.rows("select 1 from batches where id = ? and status = 'queued'", [batch]):
            with self._at.write() as db:
                db.execute("update batches set status = 'running', began_at = ? where id = ?", [now(), batch])

    def wait_again(self) -> None:
        """What was running when the last engine ended is queued, so that its time left is counted anew."""
        with self._at.write() as db:
            db.execute("update batches set status = 'queued' where status = 'running'")

    def tell(self, message: Mapping[str, Any] | None) -> None:
        """What keeps all open batches from going on; None: nothing."""
        with self._at.write() as db:
            db.execute(f"update batches set message = ? where {OPEN}", [None if message is None else dumps(message)])

    def is_waiting(self, file: int) -> bool:
        return bool(self._at.rows("select 1 from batch_files where id = ? and status = 'waiting'", [file]))

    def end(self, file: int, status: str, **facts: Any) -> None:
        """Notes the end of a file, and that of its batch with the last one; to be called inside a transaction."""
        (row,) = self._at.rows("select batch from batch_files where id = ?", [file])
        facts = {name: dumps(value) if name in JSON_COLUMNS else value for name, value in facts.items()}
        facts |= {"status": status, "change": self._next_change(row["batch"]), "finished_at": now()}
        with self._at.write() as db:
            sets = ", ".join(f"{name} = ?" for name in facts)
            db.execute(f"update batch_files set {sets} where id = ?", [*facts.values(), file])
            self._end_where_done(row["batch"])

    # --- what people ask -------------------------------------------------------------------------------------------
    def cancel(self, batch: str) -> Row:
        """Files that still wait stay uncertified; those that are done stay done."""
        with self._at.write() as db:
            self.get(batch)
            self._move(batch, "waiting", "cancelled")
            db.execute(
                f"update batches set status = 'cancelled', finished_at = ? where id = ? and {OPEN}", [now(), batch]
            )
        return self.get(batch)

    def retry(self, batch: str) -> Row:
        """Failed and cancelled files wait again. Raises Problem batch.nothing_to_retry."""
        with self._at.write() as db:
            self.get(batch)
            if not sum(self._move(batch, status, "waiting") for status in ("failed", "cancelled")):
                raise Problem("batch.nothing_to_retry", batch=batch)
            db.execute("update batches set status = 'queued', finished_at = null where id = ?", [batch])
        return self.get(batch)

    def _move(self, batch: str, old: str, new: str) -> int:
        """All of a batch's files of one status to another, each with a new number of change; how many there were."""
        with self._at.write() as db:
            moved = self._at.rows(
                "select id from batch_files where batch = ? and status = ? order by position", [batch, old]
            )
            change = self._next_change(batch)
            db.conn.executemany(
                "update batch_files set status = ?, change = ?, error = null, verdict = null, finished_at = null "
                "where id = ?",
                [(new, change + i, row["id"]) for i, row in enumerate(moved)],
            )
        return len(moved)

    def _next_change(self, batch: str) -> int:
        return int(self._at.rows("select max(change) + 1 as n from batch_files where batch = ?", [batch])[0]["n"])

    def _end_where_done(self, batch: str) -> None:
        self._at.db.execute(
            f"update batches set status = 'finished', finished_at = ? where id = ? and {OPEN} "
            "and not exists (select 1 from batch_files where batch = batches.id and status = 'waiting')",
            [now(), batch],
        )

    def _shown(self, row: Row) -> Row:
        counted = self._at.rows(
            "select status, verdict, count(*) as n from batch_files where batch = ? group by status, verdict",
            [row["id"]],
        )
        statuses: dict[str, int] = dict.fromkeys(("waiting", "done", "failed", "cancelled"), 0)
        verdicts: dict[str, int] = {}
        for found in counted:
            statuses[found["status"]] += found["n"]
            if found["verdict"]:
                verdicts[found["verdict"]] = verdicts.get(found["verdict"], 0) + found["n"]
        since = self._at.rows(
            "select count(*) as n from batch_files where batch = ? and finished_at >= ?",
            [row["id"], row["began_at"] or "9"],
        )
        return {
            **row,
            **{name: row[name] and json.loads(row[name]) for name in ("gyro_model", "spec", "message")},
            "files": sum(statuses.values()), **statuses, "verdicts": verdicts, "since_began": since[0]["n"],
        }  # fmt: skip


def new_id() -> str:
    return secrets.token_hex(6)


def _begun(error: Mapping[str, Any] | None) -> tuple[str, str | None, str | None]:
    return ("waiting", None, None) if error is None else ("failed", "error", dumps(error))


def _file(row: Row) -> Row:
    return {**row, **{name: row[name] and json.loads(row[name]) for name in JSON_COLUMNS}}
