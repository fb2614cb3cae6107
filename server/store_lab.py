"""Blind exercises: what is hidden, who hunts for it, what they measured and handed in."""

import hashlib
import json
import secrets
from collections.abc import Mapping, Sequence
from typing import Any

from calib_core.problem import Problem
from server.store_db import Connection, Row, dumps, now, page
from server.store_notebooks import Notebooks

LETTERS = "BCDFGHJKMNPQRSTVWXYZ23456789"
CODE_LENGTH = 6
MOST_STUDENTS, MOST_RUNS = 300, 60
STUDENT_JSON = ("answer", "diagnosis")


class Lab:
    def __init__(self, connection: Connection) -> None:
        self._at = connection

    # --- exercises -------------------------------------------------------------------------------------------
    def create(self, title: str, hidden: Mapping[str, Any], starter: str | None) -> tuple[str, str]:
        """A new exercise; gives its code, and the teacher's key, which is kept only as a digest."""
        key = secrets.token_urlsafe(12)
        with self._at.write() as db:
            code = "".join(secrets.choice(LETTERS) for _ in range(CODE_LENGTH))
            row = {
                "code": code, "key": _digest(key), "title": title, "axis": hidden["axis"], "truth": dumps(dict(hidden)),
                "starter": starter, "created_at": now(), "revealed_at": None,
            }  # fmt: skip
            db.table("lab_exercises").insert(row)
        return code, key

    def exercise(self, code: str) -> Row:
        """What everybody may know, and ``truth``, None until it is revealed."""
        (row,) = self._exercise(code)
        students = self._at.rows("select count(*) as n from lab_students where code = ?", [row["code"]])[0]["n"]
        shown = {name: row[name] for name in ("code", "title", "axis", "starter", "created_at", "revealed_at")}
        return shown | {"students": students, "truth": json.loads(row["truth"]) if row["revealed_at"] else None}

    def truth(self, code: str) -> dict[str, Any]:
        """What is hidden: for the bench, and for whoever has the key."""
        (row,) = self._exercise(code)
        return dict(json.loads(row["truth"]))

    def check_key(self, code: str, key: str | None) -> None:
        """Raises Problem where it is not the key of this exercise."""
        (row,) = self._exercise(code)
        if key is None or not secrets.compare_digest(_digest(key), row["key"]):
            raise Problem("lab.key")

    def reveal(self, code: str) -> None:
        """From now on everybody may know; a second time changes nothing."""
        with self._at.write() as db:
            db.execute("update lab_exercises set revealed_at = coalesce(revealed_at, ?) where code = ?", [now(), code])

    def delete(self, code: str) -> None:
        """Forgets the exercise with its students; recordings and notebooks are theirs and stay."""
        with self._at.write() as db:
            db.execute("delete from lab_runs where student in (select id from lab_students where code = ?)", [code])
            db.execute("delete from lab_students where code = ?", [code])
            db.execute("delete from lab_exercises where code = ?", [code])

    def _exercise(self, code: str) -> list[Row]:
        found = self._at.rows("select * from lab_exercises where code = ?", [code])
        if not found:
            raise Problem("lab.not_found", given=code[:20])
        return found

    # --- students --------------------------------------------------------------------------------------------
    def join(self, code: str, name: str) -> str:
        """A student with a notebook of their own; gives the id that only they know."""
        title = self._exercise(code)[0]["title"]
        with self._at.write() as db:
            names = [row["name"] for row in self._at.rows("select name from lab_students where code = ?", [code])]
            if name.casefold() in (known.casefold() for known in names):
                raise Problem("lab.name_taken", name=name)
            if len(names) >= MOST_STUDENTS:
                raise Problem("lab.full", most=MOST_STUDENTS)
            notebook = Notebooks(self._at).create(title=title or f"LAB-{code}", author=name, lab=code)
            student = secrets.token_urlsafe(16)
            row = {
                "id": student, "code": code, "name": name, "notebook": notebook, "bench_s": 0.0, "session": 1,
                "answer": None, "diagnosis": None, "submitted_at": None, "created_at": now(),
            }  # fmt: skip
            db.table("lab_students").insert(row)
        return student

    def student(self, code: str, student: str) -> Row:
        found = self._at.rows("select * from lab_students where code = ? and id = ?", [code, student])
        if not found:
            raise Problem("lab.student.not_found")
        return _student(found[0])

    def students(self, code: str, *, limit: int, cursor: str | None = None) -> tuple[list[Row], str | None]:
        rows, following = page(self._at, "select rowid as at, * from lab_students", ["code = ?"], [code], limit, cursor)
        return [_student(row) for row in rows], following

    def answer(self, code: str, student: str, answer: Mapping[str, Any]) -> None:
        """What a student hands in, in place of what was handed in before. Raises Problem once the truth is out."""
        with self._at.write() as db:
            if self._exercise(code)[0]["revealed_at"]:
                raise Problem("lab.revealed")
            changes = {"answer": dumps(dict(answer)), "diagnosis": None, "submitted_at": now()}
            db.table("lab_students").update(student, changes)

    def judge(self, student: str, recording: str, diagnosis: Mapping[str, Any]) -> None:
        """What the instrument says of the recording that the answer rests on; of another it is forgotten."""
        with self._at.write() as db:
            found = self._at.rows("select answer from lab_students where id = ? and answer is not null", [student])
            if found and json.loads(found[0]["answer"])["recording"] == recording:
                db.table("lab_students").update(student, {"diagnosis": dumps(dict(diagnosis))})

    def unjudged(self, code: str) -> list[tuple[str, str]]:
        """Students whose answer rests on a recording that the instrument has not looked at, with the recording."""
        where = "code = ? and answer is not null and diagnosis is null"
        rows = self._at.rows(f"select id, answer from lab_students where {where}", [code])
        resting = [(row["id"], json.loads(row["answer"])["recording"]) for row in rows]
        return [(student, recording) for student, recording in resting if recording is not None]

    # --- runs ------------------------------------------------------------------------------------------------
    def next_run(self, student: str) -> int:
        """Its number from 1. Raises Problem where there were enough."""
        number = self._at.rows("select count(*) as n from lab_runs where student = ?", [student])[0]["n"] + 1
        if number > MOST_RUNS:
            raise Problem("lab.too_many_runs", most=MOST_RUNS)
        return int(number)

    def keep_run(
        self,
        student: str,
        recording: str,
        *,
        numbers: Sequence[int],
        motion: Sequence[Mapping[str, Any]],
        begin_s: float,
        end_s: float,
        run_s: float,
        restart: bool,
        pause_s: float,
    ) -> None:
        """A run that was measured: bench time goes on from its end, or from a fresh start."""
        with self._at.write() as db:
            change = "session = session + ?, bench_s = ?"
            db.execute(f"update lab_students set {change} where id = ?", [int(restart), end_s + pause_s, student])
            (known,) = self._at.rows("select session from lab_students where id = ?", [student])
            row = {
                "recording": recording, "student": student, "session": known["session"],
                "numbers": dumps(list(numbers)),
                "motion": dumps([dict(one) for one in motion]), "begin_s": begin_s, "end_s": end_s, "run_s": run_s,
                "created_at": now(),
            }  # fmt: skip
            db.table("lab_runs").insert(row)

    def own_run(self, student: str, recording: str) -> Row:
        """A recording of this student's; raises Problem where it is none."""
        found = self._at.rows("select * from lab_runs where student = ? and recording = ?", [student, recording])
        if not found:
            raise Problem("recording.not_found", recording=recording)
        return _run(found[0])

    def runs(self, student: str) -> list[Row]:
        """The oldest first, with the recordings' names and lengths."""
        found = self._at.rows(
            "select lab_runs.*, name, samples, duration_s from lab_runs join recordings on recordings.id = recording "
            "where student = ? order by lab_runs.rowid",
            [student],
        )
        return [_run(row) for row in found]


def _run(row: Row) -> Row:
    return {**row, "numbers": json.loads(row["numbers"]), "motion": json.loads(row["motion"])}


def _student(row: Row) -> Row:
    return {**row, **{name: None if row[name] is None else json.loads(row[name]) for name in STUDENT_JSON}}


def _digest(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()
