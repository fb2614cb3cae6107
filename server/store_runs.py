"""Runs: what was asked, how far it went, what each state gave."""

import json
import os
import secrets
from collections.abc import Mapping, Sequence
from typing import Any

from calib_core.problem import Problem
from server.store_db import Connection, Row, dumps, like, now, page

SELECT = "select rowid as at, * from runs"
JSON_COLUMNS = ("request", "plan", "states", "message")
SEARCHED = ("board", "json_extract(request, '$.operator')", "json_extract(request, '$.note')")
ENDED = ("finished", "stopped", "failed", "interrupted")
INTERRUPTED = {"code": "run.interrupted", "values": {}}


class Runs:
    def __init__(self, connection: Connection) -> None:
        self._at = connection

    def create(
        self,
        *,
        board: str,
        gyro_model: str,
        profile: str,
        recording: str,
        request: Mapping[str, Any],
        plan: Mapping[str, Any],
        states: Sequence[str],
    ) -> str:
        """A queued run. ``plan`` is its own copy of everything it needs, the gyro model included."""
        run = secrets.token_hex(6)
        row = {
            "id": run, "board": board, "gyro_model": gyro_model, "profile": profile, "status": "queued",
            "recording": recording, "certificate": None, "request": dumps(dict(request)), "plan": dumps(dict(plan)),
            "states": dumps([{"name": name, "status": "waiting"} for name in states]), "message": None,
            "created_at": now(), "started_at": None, "finished_at": None, "owner": _this_process(),
        }  # fmt: skip
        with self._at.write() as db:
            db.table("runs").insert(row)
            db.table("recordings").update(recording, {"run": run})
        return run

    def get(self, run: str) -> Row:
        found = self._at.rows(f"{SELECT} where id = ?", [run])
        if not found:
            raise Problem("run.not_found", run=run)
        row = _shown(found[0])
        del row["at"]
        return {**row, "results": self.results(run)}

    def find(
        self, *, q: str = "", board: str = "", status: str = "", limit: int = 50, cursor: str | None = None
    ) -> tuple[list[Row], str | None]:
        where, values = [], []
        if q:
            where.append("(id = ? or " + " or ".join(f"{text} like ? escape '\\'" for text in SEARCHED) + ")")
            values += [q, *[like(q)] * len(SEARCHED)]
        rows, following = page(self._at, SELECT, where, values, limit, cursor, board=board, status=status)
        return [_shown(row) for row in rows], following

    def start(self, run: str) -> None:
        with self._at.write() as db:
            db.table("runs").update(run, {"status": "running", "started_at": now(), "owner": _this_process()})

    def set_state(self, run: str, state: str, status: str) -> None:
        """``status``: waiting, running, done, failed or kept (taken over from the run that this one continues)."""
        with self._at.write() as db:
            states = self._states(run)
            for entry in states:
                if entry["name"] == state:
                    entry["status"] = status
            db.table("runs").update(run, {"states": dumps(states)})

    def finish(
        self, run: str, status: str, *, message: Mapping[str, Any] | None = None, certificate: str | None = None
    ) -> None:
        with self._at.write() as db:
            states = self._states(run)
            for entry in states:
                if entry["status"] == "running":
                    entry["status"] = "failed"
            changes = {"status": status, "finished_at": now(), "states": dumps(states), "certificate": certificate}
            db.table("runs").update(run, {**changes, "message": dumps(message) if message else None})

    def interrupt_open(self) -> list[str]:
        """Runs that say they are on though nothing runs them (the program was ended): mark them, keep their samples.

        Another program that lives may be running its own in the same store: that one is left alone.
        """
        rows = self._at.rows("select id, owner from runs where status in ('queued', 'running')")
        lost = [row["id"] for row in rows if not _lives_elsewhere(row["owner"])]
        for run in lost:
            self.finish(run, "interrupted", message=INTERRUPTED)
        return lost

    def set_result(self, run: str, state: str, result: Mapping[str, Any]) -> None:
        with self._at.write() as db:
            db.table("results").upsert({"run": run, "state": state, "body": dumps(dict(result))}, pk=("run", "state"))

    def results(self, run: str) -> dict[str, Any]:
        rows = self._at.rows("select state, body from results where run = ? order by rowid", [run])
        return {row["state"]: json.loads(row["body"]) for row in rows}

    def _states(self, run: str) -> list[dict[str, str]]:
        found = self._at.rows("select states from runs where id = ?", [run])
        states: list[dict[str, str]] = json.loads(found[0]["states"])
        return states


def _shown(row: Row) -> Row:
    shown = {name: value for name, value in row.items() if name != "owner"}
    return {**shown, **{name: None if row[name] is None else json.loads(row[name]) for name in JSON_COLUMNS}}


def _this_process() -> str:
    """Its number, and when it began: numbers are used again."""
    import psutil

    return f"{os.getpid()} {psutil.Process().create_time():.0f}"


def _lives_elsewhere(owner: str | None) -> bool:
    """Whether a process other than this one, of this number and begun then, still runs."""
    import psutil

    number, _, began = (owner or "").partition(" ")
    if not began or int(number) == os.getpid():
        return False
    try:
        return f"{psutil.Process(int(number)).create_time():.0f}" == began
    except psutil.Error:
        return False
