"""One SQLite file: opening, numbered migrations, transactions, and its errors as sentences."""

import json
import re
import sqlite3
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib_core.problem import Problem

if TYPE_CHECKING:
    from sqlite_utils import Database

FILE = "gyrobench.sqlite"
BUSY_S = 10.0
Row = dict[str, Any]
Step = Callable[["Database"], None]

MIGRATIONS = "gyrobench"


class Schema:
    """The numbered steps that make the tables, applied by sqlite-utils.

    That package is loaded where there is a step to apply or something to write: its command line comes with it, and a
    start that finds all in place need not wait for that.
    """

    def __init__(self) -> None:
        self.steps: dict[str, Step] = {}

    def __call__(self, *, name: str) -> "Callable[[Step], Step]":
        def kept(step: "Step") -> "Step":
            if name in self.steps:
                raise ValueError(f"two migrations are called {name}")
            self.steps[name] = step
            return step

        return kept

    def applied(self, raw: sqlite3.Connection) -> set[str]:
        """The names of the steps that this file has had."""
        if not raw.execute("select 1 from sqlite_master where name = '_sqlite_migrations'").fetchone():
            return set()
        found = raw.execute("select name from _sqlite_migrations where migration_set = ?", [MIGRATIONS])
        return {name for (name,) in found}

    def apply(self, db: "Database") -> None:
        from sqlite_utils import Migrations

        set_of_steps = Migrations(MIGRATIONS)
        for name, step in self.steps.items():
            set_of_steps(name=name)(step)
        set_of_steps.apply(db)


migrations = Schema()


@migrations(name="0001_session")
def _session(db: "Database") -> None:
    db.table("boards").create({"id": str, "gyro_model": str, "note": str, "created_at": str}, pk="id")
    db.table("gyro_models").create({"id": str, "body": str, "created_at": str}, pk="id")
    db.table("recordings").create(
        {
            "id": str, "name": str, "board": str, "run": str, "source": str, "header": str, "digest": str,
            "samples": int, "duration_s": float, "created_at": str,
        },
        pk="id",
    )  # fmt: skip
    db.table("blocks").create(
        {"id": int, "recording": str, "kind": str, "state": str, "live": int, "samples": int, "end_s": float,
         "data": bytes},
        pk="id",
        foreign_keys=[("recording", "recordings", "id")],
    )  # fmt: skip
    db.table("blocks").create_index(["recording", "kind", "state"])
    db.table("runs").create(
        {
            "id": str, "board": str, "gyro_model": str, "profile": str, "status": str, "recording": str,
            "certificate": str, "request": str, "plan": str, "states": str, "message": str, "created_at": str,
            "started_at": str, "finished_at": str,
        },
        pk="id",
    )  # fmt: skip
    db.table("runs").create_index(["board"])
    db.table("results").create({"run": str, "state": str, "body": str}, pk=("run", "state"))
    db.table("certificates").create(
        {"number": str, "key": str, "board": str, "recording": str, "verdict": str, "issued_at": str, "operator": str,
         "content": str},
        pk="number",
    )  # fmt: skip
    db.table("certificates").create_index(["key"], unique=True)
    for verb in ("update", "delete"):
        db.execute(
            f"create trigger certificates_no_{verb} before {verb} on certificates "
            "begin select raise(abort, 'certificates are never changed'); end"
        )


@migrations(name="0002_rig_records")
def _rig_records(db: "Database") -> None:
    db.table("rig_records").create({"id": int, "kind": str, "body": str, "created_at": str}, pk="id")


@migrations(name="0003_experiments")
def _experiments(db: "Database") -> None:
    db.table("experiments").create(
        {"id": str, "recording": str, "axis": str, "effects": str, "proposal": str, "run": str, "result": str,
         "created_at": str},
        pk="id",
        foreign_keys=[("recording", "recordings", "id")],
    )  # fmt: skip


@migrations(name="0004_notebooks")
def _notebooks(db: "Database") -> None:
    db.table("notebooks").create({"id": str, "title": str, "author": str, "lab": str, "created_at": str}, pk="id")
    db.table("notebook_lines").create(
        {"notebook": str, "n": int, "at": str, "step": str, "body": str},
        pk=("notebook", "n"),
        foreign_keys=[("notebook", "notebooks", "id")],
    )
    for verb in ("update", "delete"):
        db.execute(
            f"create trigger notebook_lines_no_{verb} before {verb} on notebook_lines "
            "begin select raise(abort, 'a line of a notebook is never changed'); end"
        )


@migrations(name="0005_lab")
def _lab(db: "Database") -> None:
    db.table("lab_exercises").create(
        {"code": str, "key": str, "title": str, "axis": str, "truth": str, "starter": str, "created_at": str,
         "revealed_at": str},
        pk="code",
    )  # fmt: skip
    db.table("lab_students").create(
        {"id": str, "code": str, "name": str, "notebook": str, "bench_s": float, "session": int, "answer": str,
         "diagnosis": str, "submitted_at": str, "created_at": str},
        pk="id",
        foreign_keys=[("code", "lab_exercises", "code")],
    )  # fmt: skip
    db.table("lab_students").create_index(["code"])
    db.table("lab_runs").create(
        {"recording": str, "student": str, "session": int, "numbers": str, "motion": str, "begin_s": float,
         "end_s": float, "run_s": float, "created_at": str},
        pk="recording",
        foreign_keys=[("student", "lab_students", "id")],
    )  # fmt: skip
    db.table("lab_runs").create_index(["student"])


@migrations(name="0010_owners")
def _owners(db: "Database") -> None:
    db.table("runs").add_column("owner", str)


@migrations(name="0013_search")
def _search(db: "Database") -> None:
    """What is looked for among 10^5: a board's certificates and recordings, a recording that is here already, and the
    words of a certificate, so that a search reads an index and not the certificates."""
    for table, columns in (
        ("certificates", ["board"]),
        ("certificates", ["number", "board", "operator"]),
        ("recordings", ["board"]),
        ("recordings", ["digest"]),
    ):
        db.table(table).create_index(columns, if_not_exists=True)


class Connection:
    """One connection for all threads of a process, a lock around it; other processes wait for SQLite's own."""

    def __init__(self, data: Path) -> None:
        """Opens or creates the file in ``data``. Raises Problem where that cannot be."""
        self.path = data / FILE
        self._lock = threading.RLock()
        try:
            data.mkdir(parents=True, exist_ok=True)
            with told(self.path):
                self.raw = sqlite3.connect(self.path, timeout=BUSY_S, check_same_thread=False)
                for pragma in ("journal_mode = wal", "synchronous = normal", "foreign_keys = on"):
                    self.raw.execute(f"pragma {pragma}")
                if migrations.steps.keys() - migrations.applied(self.raw):
                    # Another process may open a new file at the same moment: look again inside the transaction.
                    with self.write():
                        migrations.apply(self.db)
        except OSError as error:
            raise Problem("store.cannot_open", path=str(data), reason=error.strerror or str(error)) from error

    @cached_property
    def db(self) -> "Database":
        """The same connection in sqlite-utils' hands, for whoever writes."""
        from sqlite_utils import Database

        return Database(self.raw)

    def rows(self, sql: str, parameters: Sequence[Any] = ()) -> list[Row]:
        with self._lock, told(self.path):
            found = self.raw.execute(sql, parameters)
            names = [column[0] for column in found.description]
            return [dict(zip(names, row, strict=True)) for row in found]

    @contextmanager
    def write(self, *, durable: bool = False) -> "Iterator[Database]":
        """One transaction, all or nothing; ``durable`` waits until the disk has it (synchronous FULL)."""
        with self._lock, told(self.path):
            if self.raw.in_transaction:
                yield self.db
                return
            if durable:
                self.raw.execute("pragma synchronous = full")
            try:
                # Immediate, because a reader that turns writer is refused at once where another writes.
                self.raw.execute("begin immediate")
                try:
                    yield self.db
                    self.raw.execute("commit")
                except BaseException:
                    self.raw.rollback()
                    raise
            finally:
                if durable:
                    self.raw.execute("pragma synchronous = normal")

    def close(self) -> None:
        with self._lock:
            self.raw.close()


@contextmanager
def told(path: Path) -> Iterator[None]:
    """SQLite's errors as Problems that say what to do."""
    try:
        yield
    except sqlite3.Error as error:
        code = {
            sqlite3.SQLITE_FULL: "store.full",
            sqlite3.SQLITE_BUSY: "store.locked",
            sqlite3.SQLITE_CANTOPEN: "store.cannot_open",
            sqlite3.SQLITE_READONLY: "store.cannot_open",
            sqlite3.SQLITE_NOTADB: "store.not_a_store",
            sqlite3.SQLITE_CORRUPT: "store.not_a_store",
            sqlite3.SQLITE_IOERR: "store.failed",
        }.get(getattr(error, "sqlite_errorcode", 0) & 0xFF)
        if code is None:
            raise
        raise Problem(code, path=str(path), reason=str(error)) from error


def now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def dumps(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


ID_PATTERN = "^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
CURSOR_PATTERN = "^[0-9]{1,15}$"


def checked_id(value: str, what: str) -> str:
    """An id as a person types it: it ends up in file names and addresses. Raises Problem ``<what>.characters``."""
    if not re.fullmatch(ID_PATTERN[1:-1], value):
        raise Problem(f"{what}.characters", given=value[:80])
    return value


def page(
    connection: Connection,
    select: str,
    where: Sequence[str],
    parameters: Sequence[object],
    limit: int,
    cursor: str | None,
    **equal: str,
) -> tuple[list[Row], str | None]:
    """Rows newest first, at most ``limit``, and the cursor of the next page; ``select`` names rowid as "at".

    ``equal``: columns and the value that is wanted of each; nothing wanted leaves the column out.
    """
    wanted = {column: value for column, value in equal.items() if value}
    conditions, values = [*where, *(f"{column} = ?" for column in wanted)], [*parameters, *wanted.values()]
    if cursor is not None:
        if not re.fullmatch(CURSOR_PATTERN[1:-1], cursor):
            raise Problem("request.cursor", given=cursor)
        conditions.append("rowid < ?")
        values.append(int(cursor))
    clause = f" where {' and '.join(conditions)}" if conditions else ""
    found = connection.rows(f"{select}{clause} order by rowid desc limit ?", [*values, limit + 1])
    more = len(found) > limit
    found = found[:limit]
    following = str(found[-1]["at"]) if more else None
    for row in found:
        del row["at"]
    return found, following


def like(q: str) -> str:
    return "%" + re.sub(r"([%_\\])", r"\\\1", q) + "%"
