"""Copies of the database, made and put back while other programs read and write it.

Both are SQLite's own online backup: the copy is of one moment, whatever is written meanwhile; put back, the others see
the old content or the new, never something between.
"""

import os
import sqlite3
from contextlib import closing
from pathlib import Path

from calib_core.problem import Problem
from server.store_db import BUSY_S, FILE, Connection, migrations, now, told

RUNNING = "select id from runs where status in ('queued', 'running') limit 1"


def backup(data: Path, file: Path) -> int:
    """Copies the database of ``data`` to ``file``, whole and checked or not at all; its size in bytes.

    Raises Problem store.none, backup.exists, and those of the store.
    """
    source = data / FILE
    if not source.exists():
        raise Problem("store.none", path=str(data))
    if file.exists():
        raise Problem("backup.exists", path=str(file))
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f"{file.name}.part")
    part.unlink(missing_ok=True)
    try:
        with told(part), closing(_opened(source)) as ours, closing(sqlite3.connect(part)) as copy:
            # A reader's transaction, so that what others write meanwhile does not make it start again.
            ours.execute("begin")
            ours.execute("select count(*) from sqlite_master").fetchone()
            ours.backup(copy)
            ours.execute("commit")
            # One file, with nothing beside it to forget.
            copy.execute("pragma journal_mode = delete")
            _check(copy, part)
        with part.open("rb+") as written:
            os.fsync(written.fileno())
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)
    return file.stat().st_size


def restore(file: Path, data: Path) -> Path | None:
    """Makes the database of ``data`` what ``file`` is; where the one that was there is kept, None where none was.

    Raises Problem where the file is no database of ours, is damaged or newer than this program, or while a run is on.
    """
    if not file.exists():
        raise Problem("file", path=str(file), reason="No such file")
    with told(file), closing(_opened(file)) as copy:
        _check(copy, file)
    kept = None
    if (data / FILE).exists():
        kept = data / f"before-restore-{now().replace(':', '')}.sqlite"
        backup(data, kept)
    there = Connection(data)
    try:
        running = there.rows(RUNNING)
        if running:
            raise Problem("restore.run_on", run=running[0]["id"])
        with told(there.path), closing(_opened(file)) as copy:
            copy.backup(there.raw)
        # A copy from an older version gets what came since.
        with there.write():
            migrations.apply(there.db)
    finally:
        there.close()
    return kept


def _opened(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(path, timeout=BUSY_S, isolation_level=None)


def _check(copy: sqlite3.Connection, path: Path) -> None:
    """Raises Problem unless the file is whole, ours, and not from a later version."""
    found = copy.execute("pragma quick_check(1)").fetchone()[0]
    tables = {name for (name,) in copy.execute("select name from sqlite_master where type = 'table'")}
    if found != "ok" or "certificates" not in tables:
        raise Problem("store.not_a_store", path=str(path), reason=found)
    if migrations.applied(copy) - migrations.steps.keys():
        raise Problem("store.newer", path=str(path))
