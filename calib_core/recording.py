"""Recording: named columns with units, segments, and the checks of ``gyro-recording 1`` (CONTRACT 1)."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from calib_core.problem import Problem
from calib_core.recording_check import GYRO_UNITS, MAX_BYTES, MAX_VALUE, MIN_DURATION_S, check, check_increasing
from calib_core.reference import AxisCalibration, ReferenceCalibration
from calib_core.segments import Segment, format_segment, parse_segment

__all__ = [
    "MAX_BYTES", "MAX_VALUE", "MIN_DURATION_S", "Gyro", "Recording", "Run", "Segment", "check",
    "format_segment", "parse_segment", "read", "write_csv", "write_parquet",
]  # fmt: skip

F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Gyro:
    """One axis' output, NaN where there is no valid sample; it was sampled ``delay_s`` after the row's time."""

    unit: str
    values: F64
    delay_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Run:
    """Rows ``start:stop``, all of one segment."""

    name: str
    start: int
    stop: int

    @property
    def rows(self) -> slice:
        return slice(self.start, self.stop)


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording as columns. Arrays are shared, never changed in place.

    ``time_s`` (n,) is when the first gyro channel was sampled; ``columns`` are all other numeric columns (n,) under
    their CONTRACT names, NaN where there is no sample; ``segment_names[segment_codes[i]]`` is what the table was doing
    in row i; ``header`` holds the ``# key: value`` lines in order.
    """

    time_s: F64
    columns: Mapping[str, F64]
    segment_codes: I32
    segment_names: tuple[str, ...]
    header: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def duration_s(self) -> float:
        """Last time minus first; 0 when empty."""
        return float(self.time_s[-1] - self.time_s[0]) if len(self) else 0.0

    @property
    def axes(self) -> tuple[str, ...]:
        """The axes that have a gyro column, in the order x, y, z."""
        return tuple(a for a in "xyz" if self._gyro_unit(a))

    @property
    def stationary(self) -> bool:
        """True where the header says that the true rate is zero throughout."""
        return self.header.get("reference", "").strip().lower() == "stationary"

    @property
    def valid(self) -> Mask:
        """(n,) False for rows that take part in nothing."""
        column = self.columns.get("valid")
        return np.ones(len(self), bool) if column is None else column == 1.0

    def gyro(self, axis: str) -> Gyro:
        """The gyro's output on ``axis``; raises Problem ``recording.no_gyro_axis`` where there is none."""
        unit = self._gyro_unit(axis)
        if not unit:
            raise Problem("recording.no_gyro_axis", axis=axis, axes=", ".join(self.axes))
        delay_s = float(self.header.get(f"{axis}_gyro_delay_s", 0.0))
        return Gyro(GYRO_UNITS[unit], self.valid_only(self.columns[f"{axis}_gyro_{unit}"]), delay_s)

    def position(self, axis: str) -> tuple[F64, F64]:
        """The encoder's real readings, each at its own time: (time_s (m,), angle_deg (m,)); empty without one.

        Where the header has the encoder's calibration, angles are corrected by it; `codes` are as they were read.
        """
        time, angle = self.codes(axis)
        calibration = self.reference_calibration(axis)
        return time, angle if calibration is None else calibration.apply(angle)

    def reference_calibration(self, axis: str) -> AxisCalibration | None:
        """How the encoder of this axis was calibrated; None where it was not."""
        record = ReferenceCalibration.of(self.header)
        return None if record is None else record.axes.get(axis)

    def codes(self, axis: str) -> tuple[F64, F64]:
        """The encoder's readings as `position` gives them, but as they were read: on the grid of its codes."""
        angle = self.columns.get(f"{axis}_position_deg")
        if angle is None:
            return np.empty(0), np.empty(0)
        angle = self.valid_only(angle)
        there = ~np.isnan(angle)
        own = self.columns.get(f"{axis}_position_time_s")
        time = self.time_s if own is None else np.where(np.isnan(own), self.time_s, own)
        return time[there], angle[there]

    def reference_rate(self, axis: str) -> F64 | None:
        """(n,) the reference rate in deg/s, NaN where there is none; zeros for a stationary record; None without."""
        if self.stationary:
            return np.zeros(len(self))
        rate = self.columns.get(f"{axis}_rate_dps")
        return None if rate is None else self.valid_only(rate)

    def runs(self) -> list[Run]:
        """The contiguous stretches of one segment, in time order."""
        if not len(self):
            return []
        starts = [0, *(np.flatnonzero(np.diff(self.segment_codes)) + 1).tolist()]
        names = [self.segment_names[code] for code in self.segment_codes[starts]]
        return [Run(*run) for run in zip(names, starts, [*starts[1:], len(self)], strict=True)]

    def where(self, predicate: Callable[[str], bool]) -> Mask:
        """(n,) True where ``predicate`` holds for the row's segment name; called once per name."""
        chosen = np.array([bool(predicate(name)) for name in self.segment_names], bool)
        return chosen[self.segment_codes] if len(self) else np.zeros(0, bool)

    def take(self, rows: slice | Mask) -> "Recording":
        """The same recording with some of its rows, chosen by a slice or a boolean mask (n,)."""
        return Recording(
            self.time_s[rows],
            {name: values[rows] for name, values in self.columns.items()},
            self.segment_codes[rows],
            self.segment_names,
            self.header,
        )

    def digest(self) -> str:
        """``sha256:…`` of the content: every column in units of 1e-9 and the segments, not the header.

        The same after any round trip through CSV, Parquet or the store, whatever the columns' order.
        """
        sha = hashlib.sha256(f"gyro-recording 1 {len(self)}".encode())
        for name, values in sorted([("time_s", self.time_s), *self.columns.items()]):
            gone = np.isnan(values)
            counts = np.rint(np.where(gone, 0.0, values) * 1e9).astype("<i8")
            counts[gone] = np.iinfo(np.int64).min
            sha.update(f"\n{name}\n".encode())
            sha.update(counts.tobytes())
        for run in self.runs():
            sha.update(f"\n{run.start} {run.name}".encode())
        return f"sha256:{sha.hexdigest()}"

    @staticmethod
    def join(parts: Sequence["Recording"]) -> "Recording":
        """One recording from several, in time order; a column missing in a part is NaN there, the first header stays.

        Raises Problem ``recording.time_not_increasing`` where the parts overlap.
        """
        parts = sorted((p for p in parts if len(p)), key=lambda p: float(p.time_s[0])) or list(parts[:1])
        names: dict[str, int] = {}
        codes = []
        for part in parts:
            table = np.array([names.setdefault(name, len(names)) for name in part.segment_names], np.int32)
            codes.append(table[part.segment_codes])
        columns = {name: None for part in parts for name in part.columns}
        joined = Recording(
            np.concatenate([part.time_s for part in parts]),
            {
                # A row is valid where its part says nothing else.
                name: np.concatenate(
                    [p.columns.get(name, np.full(len(p), 1.0 if name == "valid" else np.nan)) for p in parts]
                )
                for name in columns
            },
            np.concatenate(codes),
            tuple(names),
            parts[0].header,
        )
        check_increasing("time_s", joined.time_s, np.arange(len(joined)))
        return joined

    def _gyro_unit(self, axis: str) -> str:
        return next((unit for unit in GYRO_UNITS if f"{axis}_gyro_{unit}" in self.columns), "")

    def valid_only(self, values: F64) -> F64:
        """``values`` (n,) with NaN in the rows that take part in nothing."""
        return values if "valid" not in self.columns else np.where(self.valid, values, np.nan)


def read(
    data: bytes | BinaryIO,
    *,
    name: str = "",
    mapping: Mapping[str, str] | None = None,
    max_bytes: int = MAX_BYTES,
) -> Recording:
    """A checked Recording from CSV, gzipped CSV or Parquet, told apart by their first bytes.

    ``mapping`` renames foreign columns, ``{"their name": "x_gyro_dps"}``. Raises Problem
    ``recording.…`` with ``file`` = ``name``, and ``line`` and ``column`` where they apply; a Parquet file's line is its
    row, counted from 1. A ``gyro-points 1`` file is refused: ``points.read`` takes it.
    """
    from calib_core.recording_file import read_any

    try:
        return read_any(data, mapping=mapping or {}, max_bytes=max_bytes)
    except Problem as problem:
        raise Problem(problem.code, **{**problem.values, "file": name}) from None


def write_csv(recording: Recording, file: BinaryIO) -> None:
    """``gyro-recording 1`` as UTF-8 CSV: shortest digits that read back to the same number, NaN as an empty cell."""
    from calib_core.recording_file import write

    write(recording, file)


def write_parquet(recording: Recording, file: BinaryIO) -> None:
    """The same columns as Parquet, the header in the schema's metadata."""
    from calib_core.recording_parquet import write

    write(recording, file)
