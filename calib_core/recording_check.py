"""The checks of ``gyro-recording 1``: each bad case is one Problem, with its row and column where it has them."""

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from calib_core.problem import Problem

if TYPE_CHECKING:
    from calib_core.recording import Recording

MAX_BYTES = 200_000_000
"""Largest recording, decompressed: ten times the 45 minutes of a whole session at 100 Hz."""
MIN_DURATION_S = 2.0
MAX_VALUE = 9e9
"""Largest magnitude of a cell: the digest counts in units of 1e-9 in 64 bits."""

GYRO_UNITS = {"v": "V", "dps": "deg/s", "counts": "counts"}
_UNITS = {
    "gyro": tuple(GYRO_UNITS),
    "position": ("deg",),
    "position_time": ("s",),
    "rate": ("dps",),
    "acceleration": ("g",),
    "time": ("s",),
    "temperature": ("c",),
    "supply": ("v",),
}
_AXIS_COLUMN = re.compile(r"[xyz]_(gyro|position_time|position|rate|acceleration)_(.+)")
_PLAIN_COLUMN = re.compile(r"(time|temperature|supply)_(.+)")
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")


class RowProblem(Problem):
    """A Problem of row ``row`` (from 0), before the reader has put a line to it."""

    def at_line(self, line: int) -> Problem:
        values = {key: value for key, value in self.values.items() if key != "row"}
        return Problem(self.code, **{"line": line, **values})


def check_names(names: Sequence[str]) -> None:
    """Refuse a table whose columns cannot be a recording; ``names`` are all its columns after mapping."""
    for column in names:
        if names.count(column) > 1:
            raise Problem("recording.duplicate_column", column=column)
        known = _AXIS_COLUMN.fullmatch(column) or _PLAIN_COLUMN.fullmatch(column)
        if known and known[2] not in _UNITS[known[1]]:
            stem = column[: -len(known[2])]
            allowed = ", ".join(stem + unit for unit in _UNITS[known[1]])
            raise Problem("recording.unknown_unit", column=column, unit=known[2], allowed=allowed)
    if "time_s" not in names:
        raise Problem("recording.no_time", columns=", ".join(names))
    for axis in "xyz":
        gyros = [f"{axis}_gyro_{unit}" for unit in GYRO_UNITS if f"{axis}_gyro_{unit}" in names]
        if len(gyros) > 1:
            raise Problem("recording.two_units", axis=axis, columns=", ".join(gyros))
        if f"{axis}_position_time_s" in names and f"{axis}_position_deg" not in names:
            raise Problem("recording.position_time_alone", column=f"{axis}_position_time_s", axis=axis)
    if not any(f"{axis}_gyro_{unit}" in names for axis in "xyz" for unit in GYRO_UNITS):
        raise Problem("recording.no_gyro", columns=", ".join(names))


def is_known(column: str) -> bool:
    """Whether CONTRACT 1 gives the column a meaning; others are kept where they are numbers."""
    return column in ("valid", "segment") or bool(_AXIS_COLUMN.fullmatch(column) or _PLAIN_COLUMN.fullmatch(column))


def check(recording: "Recording") -> "Recording":
    """The recording itself; raises Problem, with the row where there is one, where it breaks CONTRACT 1."""
    check_names(["time_s", *recording.columns])
    if not len(recording):
        raise Problem("recording.no_rows")
    for column, values in [("time_s", recording.time_s), *recording.columns.items()]:
        beyond = np.abs(values) > MAX_VALUE
        if beyond.any():
            row = int(beyond.argmax())
            raise RowProblem(
                "recording.out_of_range", row=row, column=column, value=float(values[row]), limit=MAX_VALUE
            )
    empty = np.isnan(recording.time_s)
    if empty.any():
        raise RowProblem("recording.time_missing", row=int(empty.argmax()), column="time_s")
    check_increasing("time_s", recording.time_s, np.arange(len(recording)))
    for axis in "xyz":
        if f"{axis}_position_time_s" in recording.columns:
            rows = np.flatnonzero(~np.isnan(recording.valid_only(recording.columns[f"{axis}_position_deg"])))
            check_increasing(f"{axis}_position_time_s", recording.position(axis)[0], rows)
    if (valid := recording.columns.get("valid")) is not None:
        wrong = (valid != 0.0) & (valid != 1.0)
        if wrong.any():
            row = int(wrong.argmax())
            raise RowProblem("recording.valid_not_0_or_1", row=row, column="valid", value=float(valid[row]))
    for code, segment in enumerate(recording.segment_names):
        if _CONTROL.search(segment):
            row = int((recording.segment_codes == code).argmax())
            raise RowProblem("recording.control_character", row=row, column="segment")
    for axis in "xyz":
        key = f"{axis}_gyro_delay_s"
        try:
            delay_s = float(recording.header.get(key, 0.0))
        except ValueError:
            delay_s = np.nan
        if not abs(delay_s) < 1.0:
            raise Problem("recording.delay", key=key, value=recording.header[key])
    if recording.duration_s < MIN_DURATION_S:
        raise Problem("recording.too_short", duration_s=recording.duration_s, needed_s=MIN_DURATION_S)
    return recording


def check_increasing(column: str, times: npt.NDArray[np.float64], rows: npt.NDArray[np.intp]) -> None:
    wrong = np.flatnonzero(~(np.diff(times) > 0.0))
    if len(wrong):
        first = int(wrong[0])
        raise RowProblem(
            "recording.time_not_increasing",
            row=int(rows[first + 1]),
            column=column,
            value=float(times[first + 1]),
            previous=float(times[first]),
        )
