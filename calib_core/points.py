"""``gyro-points 1``: independent readings of rate or position tests, one a row (CONTRACT 1)."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from calib_core.problem import Problem
from calib_core.recording_check import MAX_BYTES, MAX_VALUE, listed
from calib_core.recording_file import header_lines, load, number, rename, rows, split

F64 = npt.NDArray[np.float64]
Texts = npt.NDArray[np.str_]
Ints = npt.NDArray[np.int64]

FORMAT = "gyro-points 1"
COLUMNS = {"rate": ("rate_dps", "gyro_dps"), "position": ("position_deg", "gyro_deg")}
"""For each kind, the reference's and the gyro's column, after ``<a>_``."""


@dataclass(frozen=True, eq=False)
class Points:
    """Readings (n,) of one kind, "rate" (deg/s) or "position" (deg), of any number of boards and axes.

    ``reference`` is the encoder's, ``gyro`` the compensated gyro's; ``test`` is "linearity", "repeat" or "";
    ``duration_s`` is NaN where it was not written down.
    """

    board: Texts
    axis: Texts
    kind: str
    test: Texts
    set_point: F64
    reference: F64
    gyro: F64
    reading: Ints
    duration_s: F64

    def __len__(self) -> int:
        return len(self.set_point)

    def take(self, chosen: npt.NDArray[Any] | slice) -> "Points":
        """The readings of a boolean mask (n,), of indices or of a slice."""
        arrays = {field.name: getattr(self, field.name)[chosen] for field in fields(self) if field.name != "kind"}
        return Points(kind=self.kind, **arrays)


def read(data: bytes | BinaryIO, *, mapping: Mapping[str, str] | None = None, max_bytes: int = MAX_BYTES) -> Points:
    """Points from CSV or gzipped CSV; raises Problem ``recording.…`` or ``points.…`` with line and column.

    Needs ``set_point`` and, for each axis, reference and gyro; where a file has one axis only, ``axis`` may be
    missing, and ``board`` may be a header line. Readings without a number are counted in each set-point.
    """
    table = split(load(data, max_bytes))
    line = table.line - 1
    names = rename(table.names, mapping or {})
    kind_named = table.header.get("format", FORMAT)
    if kind_named.startswith("gyro-recording") or "time_s" in names:
        raise Problem("points.is_recording", line=line)
    if kind_named != FORMAT:
        raise Problem("recording.unknown_format", format=kind_named[:40], known=FORMAT)
    for name in names:
        if names.count(name) > 1:
            raise Problem("recording.duplicate_column", line=line, column=name)
    if "set_point" not in names:
        raise Problem("points.no_set_point", line=line, columns=listed(names))
    kind, axes = _kind(names, line)
    board, only_axis = table.header.get("board", ""), axes[0] if len(axes) == 1 else ""
    found: list[tuple[str, str, str, float, float, float, int, float]] = []
    counted: dict[tuple[object, ...], int] = {}
    for line, cells in rows(table):
        row = dict(zip(names, cells, strict=True))
        axis = row.get("axis", only_axis).strip()
        if axis not in axes:
            raise Problem("points.axis", line=line, column="axis", axis=axis[:40], allowed=", ".join(axes))
        reference, gyro = (_number(row, f"{axis}_{column}", line) for column in COLUMNS[kind])
        place = (row.get("board", board).strip(), axis, row.get("test", "").strip(), _number(row, "set_point", line))
        counted[place] = counted.get(place, 0) + 1
        reading = _number(row, "reading", line, counted[place])
        found.append((*place, reference, gyro, int(reading), _number(row, "duration_s", line, np.nan)))
    if not found:
        raise Problem("recording.no_rows")
    boards, at_axes, tests, *numbers = (np.array(column) for column in zip(*found, strict=True))
    set_point, references, gyros, readings, durations = numbers
    return Points(boards, at_axes, kind, tests, set_point, references, gyros, readings.astype(np.int64), durations)


def write(points: Points, file: BinaryIO, header: Mapping[str, str] | None = None) -> None:
    """``gyro-points 1`` as UTF-8 CSV, shortest digits; ``test`` and ``duration_s`` only where there are any."""
    axes = sorted(set(points.axis.tolist()))
    pairs = {axis: [f"{axis}_{column}" for column in COLUMNS[points.kind]] for axis in axes}
    columns: dict[str, Sequence[object]] = {"board": points.board.tolist(), "axis": points.axis.tolist()}
    if points.test.any():
        columns["test"] = points.test.tolist()
    columns["set_point"] = _cells(points.set_point)
    for axis, names in pairs.items():
        for name, values in zip(names, (points.reference, points.gyro), strict=True):
            columns[name] = _cells(np.where(points.axis == axis, values, np.nan))
    columns["reading"] = points.reading.tolist()
    if not np.isnan(points.duration_s).all():
        columns["duration_s"] = _cells(points.duration_s)
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    table.writerows(zip(*columns.values(), strict=True))
    file.write(header_lines(FORMAT, header or {}) + text.getvalue().encode())


def _kind(names: Sequence[str], line: int) -> tuple[str, list[str]]:
    """The one kind whose columns are there, and the axes that have both of them."""
    axes = {kind: [a for a in "xyz" if all(f"{a}_{c}" in names for c in COLUMNS[kind])] for kind in COLUMNS}
    kinds = [kind for kind in COLUMNS if axes[kind]]
    if len(kinds) == 2:
        raise Problem("points.two_kinds", line=line)
    if not kinds:
        raise Problem("points.no_pair", line=line, columns=listed(names))
    return kinds[0], axes[kinds[0]]


def _number(row: Mapping[str, str], column: str, line: int, default: float | None = None) -> float:
    """The cell's number, or ``default`` where the cell is empty or there is no such column."""
    value = number(row.get(column, ""))
    if value is None or abs(value) > MAX_VALUE:
        raise Problem("recording.not_a_number", line=line, column=column, cell=row[column][:40])
    if not np.isnan(value):
        return value
    if default is None:
        raise Problem("points.empty", line=line, column=column)
    return default


def _cells(values: F64) -> list[str]:
    return ["" if np.isnan(value) else repr(value).removesuffix(".0") for value in values.tolist()]
