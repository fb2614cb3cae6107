"""Test readings in a recording: which rows, the encoder's readings among them, and the gyro's integral at their times.

All strokes of a test are handled at once, as flat arrays with a stroke number for each encoder reading: a session has
832 of them. Integrals are matched, the encoder is never differentiated (METHOD 2).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from calib_core.kalman import filter_record, tuning
from calib_core.linearity import word
from calib_core.points import Points
from calib_core.recording import Recording, Segment, parse_segment

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

LONGEST_GAP_S = 0.05
"""A stroke with a longer hole in the gyro's samples has no integral."""


@dataclass(frozen=True, eq=False)
class Strokes:
    """The readings of one test ("rate" or "position") on one axis, in time order, k strokes.

    ``time_s`` (m,) and ``angle_deg`` (m,) are encoder readings at their own times, ``of`` (m,) the stroke of each;
    ``start_s`` and ``stop_s`` (k,) the segments' first and last sample; ``holed`` (k,) where gyro samples are missing,
    ``unread`` (k,) where the encoder has no reading at all.
    """

    board: str
    axis: str
    segments: tuple[Segment, ...]
    start_s: F64
    stop_s: F64
    holed: Mask
    unread: Mask
    time_s: F64
    angle_deg: F64
    of: I64
    step_deg: float

    def __len__(self) -> int:
        return len(self.segments)

    def total(self, values: F64) -> F64:
        """(k,) sums of ``values`` (m,) over each stroke."""
        sums: F64 = np.bincount(self.of, values, minlength=len(self)).astype(float)
        return sums

    def mean(self, values: F64, where: Mask) -> F64:
        """(k,) means of ``values`` (m,) over the readings ``where`` (m,); NaN where there is none."""
        n = self.total(where.astype(float))
        with np.errstate(invalid="ignore"):
            means: F64 = self.total(np.where(where, values, 0.0)) / n
        return means

    def first(self, values: F64, where: Mask) -> F64:
        """(k,) smallest of ``values`` (m,) among the readings ``where`` (m,); inf where there is none."""
        found = np.full(len(self), np.inf)
        np.minimum.at(found, self.of[where], values[where])
        return found

    def last(self, values: F64, where: Mask) -> F64:
        """(k,) largest of ``values`` (m,) among the readings ``where`` (m,); -inf where there is none."""
        return -self.first(-values, where)

    def slope(self, values: F64, weight: F64) -> tuple[F64, F64, F64]:
        """(k,) weighted least-squares slopes of ``values`` (m,) over time, mean times, weighted spreads of time."""
        total = self.total(weight)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean_time = self.total(weight * self.time_s) / total
            u = np.where(weight > 0, self.time_s - mean_time[self.of], 0.0)
            spread = self.total(weight * u * u)
            return self.total(weight * u * np.where(weight > 0, values, 0.0)) / spread, mean_time, spread

    def readings(
        self,
        kind: str,
        kept: list[int],
        reference: F64,
        gyro: F64,
        duration_s: F64,
        reference_u: F64,
        warnings: list[dict[str, Any]],
    ) -> "Readings":
        """Of the strokes ``kept``; references, gyro, durations and uncertainties are (k,)."""
        taken = [self.segments[i] for i in kept]
        points = Points(
            board=np.full(len(kept), self.board),
            axis=np.full(len(kept), self.axis),
            kind=kind,
            test=np.array([segment.test for segment in taken], dtype=str),
            set_point=np.array([segment.set_point for segment in taken]),
            reference=reference[kept],
            gyro=gyro[kept],
            reading=np.array([segment.reading for segment in taken], dtype=np.int64),
            duration_s=duration_s[kept],
        )
        return Readings(points, reference_u[kept], warnings)

    def unusable(self, i: int) -> dict[str, Any] | None:
        """The warning of a stroke that no test can read."""
        code = "test.gyro_missing" if self.holed[i] else "test.no_encoder" if self.unread[i] else None
        return self.warning(code, i) if code else None

    def warning(self, code: str, i: int, **values: object) -> dict[str, Any]:
        segment = self.segments[i]
        place = {"axis": segment.axis, "set_point": segment.set_point, "reading": segment.reading}
        return {"code": code, "values": {"test": word(segment.test), **place, **values}}


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings as ``points`` (n,), the standard uncertainty of each reference, and what has to be said about them."""

    points: Points
    reference_u: F64
    warnings: list[dict[str, Any]]


def find(recording: Recording, kind: str, axis: str) -> tuple[Strokes, list[dict[str, Any]]]:
    """The strokes of ``kind`` on ``axis``, and warnings about segments that appear twice (the last one counts)."""
    latest: dict[Segment, tuple[int, int]] = {}
    repeated: dict[Segment, int] = {}
    for run in recording.runs():
        segment = parse_segment(run.name)
        if segment and segment.kind == kind and segment.axis == axis:
            if latest.pop(segment, None):
                repeated[segment] = repeated.get(segment, 1) + 1
            latest[segment] = (run.start, run.stop - 1)
    strokes = collect(recording, axis, latest)
    where = {segment: i for i, segment in enumerate(latest)}
    told = [strokes.warning("test.reading_repeated", where[s], times=n) for s, n in repeated.items()]
    return strokes, told


def collect(recording: Recording, axis: str, stretches: Mapping[Segment, tuple[int, int]]) -> Strokes:
    """The strokes whose first and last row ``stretches`` names."""
    gyro = recording.gyro(axis)
    sampled = recording.time_s[~np.isnan(gyro.values)] + gyro.delay_s
    rows = np.array(list(stretches.values()), np.int64).reshape(-1, 2)
    start_s, stop_s = recording.time_s[rows[:, 0]], recording.time_s[rows[:, 1]]
    time_s, angle = recording.position(axis)
    low, high = np.searchsorted(time_s, start_s), np.searchsorted(time_s, stop_s, side="right")
    count = high - low
    of = np.repeat(np.arange(len(rows)), count)
    at = np.arange(len(of)) + np.repeat(low - np.concatenate([[0], np.cumsum(count)])[:-1], count)
    return Strokes(
        recording.header.get("board", ""),
        axis,
        tuple(stretches),
        start_s,
        stop_s,
        _holed(sampled, start_s, stop_s),
        count == 0,
        time_s[at],
        angle[at],
        of,
        encoder_step(angle),
    )


def _holed(sampled: F64, start_s: F64, stop_s: F64) -> Mask:
    """(k,) True where consecutive samples inside the stroke, or its ends, are further apart than LONGEST_GAP_S."""
    long_before = np.concatenate([[0], np.cumsum(np.diff(sampled) > LONGEST_GAP_S)])
    low = np.searchsorted(sampled, start_s + LONGEST_GAP_S, side="right") - 1
    high = np.searchsorted(sampled, stop_s - LONGEST_GAP_S)
    inside = (low >= 0) & (high < len(sampled))
    low, high = np.clip(low, 0, len(long_before) - 1), np.clip(high, 0, len(long_before) - 1)
    holed: Mask = ~inside | (long_before[low] != long_before[high])
    return holed


def encoder_step(angle_deg: F64) -> float:
    """The encoder's step: the smallest change between successive readings (m,); 0 where nothing ever changed."""
    change = np.abs(np.diff(angle_deg))
    change = change[change > 1e-3]  # recordings resolve 1e-4 deg
    return float(change.min()) if len(change) else 0.0


def run_lengths(values: F64, of: I64) -> F64:
    """(m,) how many equal successive ``values`` (m,) of the same stroke each one is among."""
    new = np.concatenate([[True], (np.diff(values) != 0) | (np.diff(of) != 0)]) if len(values) else np.zeros(0, bool)
    number = np.cumsum(new) - 1
    return np.bincount(number)[number].astype(float) if len(values) else values


def integral_at(time_s: F64, rate: F64, at_s: F64) -> F64:
    """(m,) the integral of ``rate`` (n,) from time_s[0] to each of ``at_s`` (m,), straight lines between samples.

    NaN samples are left out, so the line goes across them. Between samples the integral is a parabola: taking it as a
    line would add a false angle of (change of rate) * dt / 8. The instrument's samples are means over their own period
    and its spans begin and end at constant rate, so the trapezoid's end correction (METHOD 2) vanishes.
    """
    good = ~np.isnan(rate)
    t, w = time_s[good], rate[good]
    if len(t) < 2:
        return np.full(len(at_s), np.nan)
    dt = np.diff(t)
    area = np.concatenate([[0.0], np.cumsum(0.5 * (w[1:] + w[:-1]) * dt)])
    i = np.clip(np.searchsorted(t, at_s, side="right") - 1, 0, len(t) - 2)
    h = at_s - t[i]
    with np.errstate(invalid="ignore"):  # a stroke without its encoder has no times
        out: F64 = area[i] + h * (w[i] + 0.5 * h * (w[i + 1] - w[i]) / dt[i])
    return out


def filtered(time_s: F64, rate: F64) -> F64:
    """(n,) the thesis' Kalman filter over a compensated rate (n,): filtering and compensating commute (3.23).

    Its gain depends on the ratio of the densities only, which is the tuning's; so any density of the noise will do.
    """
    return filter_record(rate, float(np.median(np.diff(time_s))), tuning(1.0))
