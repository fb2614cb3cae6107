"""Backup and restore while others write: one moment, whole, and never half of anything."""

import sqlite3
import threading
from pathlib import Path

import pytest

from calib_core.problem import Problem
from server import cli
from server.store import Store
from server.store_copy import backup, restore


def filled(data: Path, *boards: str) -> Store:
    store = Store(data)
    for board in boards:
        store.boards.ensure(board)
    return store


def boards(store: Store) -> set[str]:
    return {row["id"] for row in store.boards.find(limit=200)[0]}


def test_a_copy_made_while_another_writes_is_of_one_moment_and_whole(tmp_path: Path) -> None:
    with filled(tmp_path / "data") as store:
        stop = threading.Event()

        def write() -> None:
            n = 0
            while not stop.is_set():
                with store.connection.write():
                    store.boards.ensure(f"A{n}")
                    store.boards.ensure(f"B{n}")
                n += 1

        writer = threading.Thread(target=write)
        writer.start()
        try:
            for i in range(3):
                backup(tmp_path / "data", tmp_path / f"{i}.sqlite")
        finally:
            stop.set()
            writer.join()
    for i in range(3):
        with sqlite3.connect(tmp_path / f"{i}.sqlite") as copy:
            names = {name for (name,) in copy.execute("select id from boards")}
        assert {f"B{name[1:]}" for name in names if name[0] == "A"} == {name for name in names if name[0] == "B"}
    assert not list(tmp_path.glob("*.part")) + list(tmp_path.glob("*-wal"))


def test_a_restored_store_is_seen_by_programs_that_have_it_open_and_the_old_one_is_kept(tmp_path: Path) -> None:
    with filled(tmp_path / "data", "OLD") as running:
        assert cli.main(["backup", str(tmp_path / "copy"), "--data", str(tmp_path / "data")]) == 0
        running.boards.ensure("NEW")
        assert cli.main(["restore", str(tmp_path / "copy"), "--data", str(tmp_path / "data")]) == 0
        assert boards(running) == {"OLD"}
        running.boards.ensure("NEXT")
    (kept,) = (tmp_path / "data").glob("before-restore-*.sqlite")
    assert restore(kept, tmp_path / "elsewhere") is None
    with Store(tmp_path / "elsewhere") as again:
        assert boards(again) == {"OLD", "NEW"}


def test_what_cannot_be_copied_or_put_back_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    with filled(tmp_path / "data", "OLD") as store:
        copy = tmp_path / "copy"
        backup(tmp_path / "data", copy)
        (tmp_path / "words").write_text("no database, but longer than a header of one would have to be" * 9)
        with sqlite3.connect(tmp_path / "other") as other:
            other.execute("create table t (x)")
        newer = tmp_path / "newer"
        newer.write_bytes(copy.read_bytes())
        with sqlite3.connect(newer) as later:
            later.execute("insert into _sqlite_migrations (migration_set, name) values ('gyrobench', '9999_later')")
        for code, work in {
            "backup.exists": lambda: backup(tmp_path / "data", copy),
            "store.none": lambda: backup(tmp_path / "nowhere", tmp_path / "x"),
            "file": lambda: restore(tmp_path / "none", tmp_path / "data"),
            "store.not_a_store": lambda: restore(tmp_path / "words", tmp_path / "data"),
            "store.newer": lambda: restore(newer, tmp_path / "data"),
        }.items():
            with pytest.raises(Problem) as refused:
                work()
            assert refused.value.code == code
        with pytest.raises(Problem, match=r"store\.not_a_store"):
            restore(tmp_path / "other", tmp_path / "data")
        store.connection.db.execute("insert into runs (id, status) values ('r', 'running')")
        with pytest.raises(Problem, match=r"restore\.run_on"):
            restore(copy, tmp_path / "data")
        assert boards(store) == {"OLD"}
