"""Recordings as compact blocks: appended as they are measured, one block a state once it has ended."""

import hashlib
import io
import json
import secrets
import zlib
from collections.abc import Collection, Mapping
from typing import Any

from calib_core.packing import pack_recording, unpack_recording
from calib_core.points import FORMAT, Points, read, write
from calib_core.problem import Problem
from calib_core.recording import Recording
from server.store_db import Connection, Row, dumps, like, now, page

SELECT = "select rowid as at, * from recordings"
LAB = "lab"
"""The source of what students of a blind exercise record."""
OPEN = f"recording not in (select id from recordings where source = '{LAB}')"
"""What was made of other recordings than theirs."""


class Recordings:
    def __init__(self, connection: Connection) -> None:
        self._at = connection

    def create(self, *, board: str, name: str, source: str, header: Mapping[str, str], run: str | None = None) -> str:
        """An empty recording that blocks are appended to; gives its id."""
        recording = secrets.token_hex(6)
        row = {
            "id": recording, "name": name, "board": board, "run": run, "source": source, "header": dumps(dict(header)),
            "digest": None, "samples": 0, "duration_s": 0.0, "created_at": now(),
        }  # fmt: skip
        with self._at.write() as db:
            db.table("recordings").insert(row)
        return recording

    def add(self, whole: Recording, *, board: str, name: str, source: str = "upload") -> str:
        """A recording that is complete, for instance an uploaded one."""
        with self._at.write():
            recording = self.create(board=board, name=name, source=source, header=whole.header)
            self.append(recording, whole, state="", live=False)
            self.seal(recording, whole)
        return recording

    def add_points(self, points: Points, *, board: str, name: str, source: str = "upload") -> str:
        """Independent readings (``gyro-points 1``), kept as the text that they are written as."""
        text = io.BytesIO()
        write(points, text)
        raw = text.getvalue()
        with self._at.write() as db:
            recording = self.create(board=board, name=name, source=source, header={"format": FORMAT})
            block = {"recording": recording, "kind": "points", "state": "", "live": 0, "samples": len(points)}
            db.table("blocks").insert({**block, "end_s": 0.0, "data": zlib.compress(raw)})
            facts = {"digest": hashlib.sha256(raw).hexdigest(), "samples": len(points)}
            db.table("recordings").update(recording, facts)
        return recording

    def points(self, recording: str) -> Points | None:
        """The readings of ``add_points``; None where it is a recording in time."""
        found = self._at.rows("select data from blocks where recording = ? and kind = 'points'", [recording])
        return read(zlib.decompress(found[0]["data"])) if found else None

    def keep(self, packed: Mapping[str, Any], *, board: str, name: str, source: str = "upload") -> str:
        """A complete recording that was packed elsewhere (`batch_work.certify`); the same one is kept once."""
        same = "select id, header from recordings where digest = ? and board = ?"
        with self._at.write() as db:
            for row in self._at.rows(same, [packed["digest"], board]):
                if json.loads(row["header"]) == packed["header"]:
                    return str(row["id"])
            recording = self.create(board=board, name=name, source=source, header=packed["header"])
            db.table("recordings").update(recording, {key: packed[key] for key in ("digest", "samples", "duration_s")})
            self._insert_block(recording, packed["data"], samples=packed["samples"], end_s=packed["end_s"])
        return recording

    def append(self, recording: str, rows: Recording, *, state: str, kind: str = "rows", live: bool = True) -> None:
        """A block of rows after the last; ``kind`` "fast" holds the 1 kHz file's."""
        end_s = float(rows.time_s[-1]) if len(rows) else 0.0
        packed = pack_recording(rows)
        self._insert_block(recording, packed, samples=len(rows), end_s=end_s, kind=kind, state=state, live=live)

    def _insert_block(
        self, recording: str, data: bytes, *, samples: int, end_s: float, kind: str = "rows", state: str = "",
        live: bool = False,
    ) -> None:  # fmt: skip
        block = {
            "recording": recording, "kind": kind, "state": state, "live": int(live), "samples": samples,
            "end_s": end_s, "data": data,
        }  # fmt: skip
        names = ", ".join(block)
        marks = ", ".join("?" * len(block))
        with self._at.write() as db:
            # Plain SQL: twenty blocks a second need no look at the table's schema before each.
            db.execute(f"insert into blocks ({names}) values ({marks})", list(block.values()))

    def compact(self, recording: str, state: str) -> None:
        """A state's many small blocks become one: smaller, and quick to read."""
        with self._at.write() as db:
            for kind in ("rows", "fast"):
                where = "recording = ? and kind = ? and state = ? and live = 1"
                small = self._at.rows(f"select data from blocks where {where} order by id", [recording, kind, state])
                if small:
                    joined = Recording.join([unpack_recording(row["data"]) for row in small])
                    db.execute(f"delete from blocks where {where}", [recording, kind, state])
                    self.append(recording, joined, state=state, kind=kind, live=False)

    def copy_states(self, source: str, to: str, states: Collection[str]) -> None:
        """The blocks of some states of another recording: what a run that repeats the others starts from."""
        marks = ", ".join("?" * len(states))
        with self._at.write() as db:
            db.execute(
                "insert into blocks (recording, kind, state, live, samples, end_s, data) "
                "select ?, kind, state, live, samples, end_s, data "
                f"from blocks where recording = ? and state in ({marks}) order by id",
                [to, source, *states],
            )

    def states(self, recording: str) -> list[str]:
        found = self._at.rows("select distinct state from blocks where recording = ? and state != ''", [recording])
        return [row["state"] for row in found]

    def end_s(self, recording: str) -> float | None:
        """Time of the last stored sample, of any rate; None where there is none."""
        found = self._at.rows("select max(end_s) as last from blocks where recording = ?", [recording])
        return None if found[0]["last"] is None else float(found[0]["last"])

    def set_header(self, recording: str, header: Mapping[str, str]) -> None:
        with self._at.write() as db:
            db.table("recordings").update(recording, {"header": dumps({**self.row(recording)["header"], **header})})

    def seal(self, recording: str, whole: Recording) -> None:
        """Notes what the recording's content is, once nothing more is appended."""
        facts = {"digest": whole.digest(), "samples": len(whole), "duration_s": round(whole.duration_s, 3)}
        with self._at.write() as db:
            db.table("recordings").update(recording, facts)

    def row(self, recording: str) -> Row:
        found = self._at.rows(f"{SELECT} where id = ?", [recording])
        if not found:
            raise Problem("recording.not_found", recording=recording)
        row = self._shown(found[0])
        del row["at"]
        return row

    def find(
        self, *, q: str = "", board: str = "", limit: int = 50, cursor: str | None = None
    ) -> tuple[list[Row], str | None]:
        """Newest first; those of blind exercises are the students' own, who have their ids."""
        where, values = [f"source != '{LAB}'"], []
        if q:
            where.append("(board like ? escape '\\' or name like ? escape '\\' or id = ?)")
            values += [like(q), like(q), q]
        if board:
            where.append("board = ?")
            values.append(board)
        rows, following = page(self._at, SELECT, where, values, limit, cursor)
        return [self._shown(row) for row in rows], following

    def load(self, recording: str, *, kind: str = "rows", state: str | None = None) -> Recording:
        """What is stored, as one Recording; raises Problem where there are no such rows."""
        header: dict[str, Any] = self.row(recording)["header"]
        sql, values = "select data from blocks where recording = ? and kind = ?", [recording, kind]
        if state is not None:
            sql, values = f"{sql} and state = ?", [*values, state]
        blocks = self._at.rows(f"{sql} order by id", values)
        if not blocks and header.get("format") == FORMAT:
            raise Problem("recording.is_points")
        if not blocks:
            raise Problem("recording.empty", recording=recording, state=state or "")
        joined = Recording.join([unpack_recording(row["data"]) for row in blocks])
        return Recording(joined.time_s, joined.columns, joined.segment_codes, joined.segment_names, header)

    def _shown(self, row: Row) -> Row:
        row = {**row, "header": json.loads(row["header"])}
        if row["digest"] is None:  # not sealed: a run is on, or was interrupted; counted as it stands
            where = "from blocks where recording = ? and kind = 'rows'"
            first = f"(select data {where} order by id limit 1) as first"
            sql = f"select sum(samples) as n, max(end_s) as last, {first} {where}"
            (found,) = self._at.rows(sql, [row["id"], row["id"]])
            if found["n"]:
                begin_s = float(unpack_recording(found["first"]).time_s[0])
                row |= {"samples": found["n"], "duration_s": round(found["last"] - begin_s, 3)}
        return row
