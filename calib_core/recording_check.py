"""The checks of ``gyro-recording 1``: each bad case is one Problem, with its row and column where it has them."""

import re
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from calib_core.problem import Problem

if TYPE_CHECKING:
    from calib_core.recording import Recording

F64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

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


def check_names(names: Sequence[str], line: int = 1) -> None:
    """Refuse a table whose columns cannot be a recording; ``names``, on ``line``, are all of them after mapping."""
    for column, times in Counter(names).items():
        if times > 1:
            raise Problem("recording.duplicate_column", line=line, column=column)
        known = _AXIS_COLUMN.fullmatch(column) or _PLAIN_COLUMN.fullmatch(column)
        if known and known[2] not in _UNITS[known[1]]:
            stem = column[: -len(known[2])]
            allowed = ", ".join(stem + unit for unit in _UNITS[known[1]])
            raise Problem("recording.unknown_unit", line=line, column=column, unit=known[2], allowed=allowed)
    if "time_s" not in names:
        raise Problem("recording.no_time", line=line, column="time_s", columns=listed(names))
    found = 0
    for axis in "xyz":
        gyros = [f"{axis}_gyro_{unit}" for unit in GYRO_UNITS if f"{axis}_gyro_{unit}" in names]
        if len(gyros) > 1:
            raise Problem("recording.two_units", line=line, column=gyros[1], other=gyros[0], axis=axis)
        if f"{axis}_position_time_s" in names and f"{axis}_position_deg" not in names:
            raise Problem("recording.position_time_alone", line=line, column=f"{axis}_position_time_s", axis=axis)
        found += len(gyros)
    if not found:
        raise Problem("recording.no_gyro", line=line, columns=listed(names))


def listed(names: Sequence[str]) -> str:
    """The names for a sentence, which a file of junk must not make endless."""
    return ", ".join(name[:40] for name in names[:20]) + (", …" if len(names) > 20 else "")


def is_known(column: str) -> bool:
    """Whether CONTRACT 1 gives the column a meaning; others are kept where they are numbers."""
    return column in ("valid", "segment") or bool(_AXIS_COLUMN.fullmatch(column) or _PLAIN_COLUMN.fullmatch(column))


def check(recording: "Recording") -> "Recording":
    """The recording itself; raises Problem where it breaks CONTRACT 1.

    The Problem's ``line`` is the row, counted from 1; the reader of a text puts the text's line in its place.
    """
    check_names(["time_s", *recording.columns])
    if not len(recording):
        raise Problem("recording.no_rows")
    for key in ("gyro_average_s", "x_gyro_delay_s", "y_gyro_delay_s", "z_gyro_delay_s"):
        _check_seconds(key, recording.header.get(key, "0"))
    for column, values in [("time_s", recording.time_s), *recording.columns.items()]:
        _refuse("recording.out_of_range", np.abs(values) > MAX_VALUE, column, values, limit=MAX_VALUE)
    _refuse("recording.time_missing", np.isnan(recording.time_s), "time_s", recording.time_s)
    check_increasing("time_s", recording.time_s, np.arange(len(recording)))
    for axis in "xyz":
        if f"{axis}_position_time_s" in recording.columns:
            rows = np.flatnonzero(~np.isnan(recording.valid_only(recording.columns[f"{axis}_position_deg"])))
            check_increasing(f"{axis}_position_time_s", recording.position(axis)[0], rows)
    if (valid := recording.columns.get("valid")) is not None:
        _refuse("recording.valid_not_0_or_1", (valid != 0.0) & (valid != 1.0), "valid", valid)
    for code, segment in enumerate(recording.segment_names):
        if _CONTROL.search(segment):
            where = recording.segment_codes == code
            _refuse("recording.control_character", where, "segment", recording.time_s)
    if recording.duration_s < MIN_DURATION_S:
        raise Problem("recording.too_short", duration_s=recording.duration_s, needed_s=MIN_DURATION_S)
    return recording


def check_increasing(column: str, times: F64, rows: npt.NDArray[np.intp]) -> None:
    """Refuse ``times`` (m,), found in ``rows`` (m,), where one is not later than the one before."""
    later = times[1:] > times[:-1]
    if not later.all():
        first = int(later.argmin())
        value, previous = float(times[first + 1]), float(times[first])
        line = int(rows[first + 1]) + 1
        raise Problem("recording.time_not_increasing", line=line, column=column, value=value, previous=previous)


def _check_seconds(key: str, value: str) -> None:
    try:
        good = abs(float(value)) < 1.0
    except ValueError:
        good = False
    if not good:
        raise Problem("recording.header_seconds", key=key, value=value[:40])


def _refuse(code: str, wrong: Mask, column: str, values: F64, **more: object) -> None:
    if wrong.any():
        row = int(wrong.argmax())
        raise Problem(code, line=row + 1, column=column, value=float(values[row]), **more)
