"""From a recording to rows: mean gyro output over each interval against the true rate over the same interval.

Encoder recordings (METHOD 2): the integral of V between two readings against the angle between them; inside a rest the
true rate is exactly zero, so every sample is a row of its own. A reference rate, or a stationary record, gives one row
per sample. Columns of effects are averaged over the same intervals by ``Averages``.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core import encoder_noise
from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.reference import AxisCalibration
from calib_core.whitening import Rows

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Operator = Any  # a scipy.sparse matrix

REGULAR = 0.01
"""By how much a row's own white noise exceeds what it shares with its neighbours, at least."""
DELAY_GRID_S = 2e-4
SMOOTH_S = 0.05
"""Passes 7/8 of a motion at 4 Hz and a twentieth of the noise that the delay's column would have."""
LEAST = 8
"""Samples below which nothing can be fitted."""
SLAB = 100_000
"""So many rows are formed at a time."""
GAP = 2.5
"""A gap of more than this many sampling intervals interrupts the record."""


@dataclass(frozen=True, eq=False)
class Samples:
    """The gyro's samples (k,) that take part, at their own times; ``start`` marks the first after each gap."""

    unit: str
    time_s: F64
    output: F64
    start: Mask
    interval_s: float
    average_s: float
    """Each sample is a mean over this span (0: a point)."""
    index: Ints
    """(k,) their rows in the recording."""


@dataclass(frozen=True, eq=False)
class Averages:
    """Means over the rows' intervals of anything known at the gyro's samples."""

    samples: Samples
    begin_s: F64
    end_s: F64
    """(n,) the interval of each row; equal where the row is one sample."""
    at: Ints
    """(n,) that sample, -1 for an interval."""

    def mean(self, values: F64) -> F64:
        """(n,) or (n, p): means of ``values`` (k,) or (k, p) over the intervals, by the corrected trapezoid rule."""
        return np.asarray(self._operators(0.0)[0] @ values)

    def change(self, values: F64) -> F64:
        """(n,) or (n, p): (end - beginning)/length of ``values`` (k,) or (k, p); for a sample, its slope."""
        return np.asarray(self._operators(0.0)[1] @ values)

    def output(self, delay_s: float) -> tuple[F64, F64]:
        """(n,) the gyro's output, the intervals taken ``delay_s`` later, and its change by that delay.

        Samples that are means over a span w have lost w²/24·f''; its integral is put back. The change is taken from
        the output with its noise smoothed away, which would pass for a change that no delay explains.
        """
        s = self.samples
        near = DELAY_GRID_S * round(delay_s / DELAY_GRID_S)  # from there it is linear enough
        mean, change = self._operators(near)
        slope = change @ _smooth(s.output, max(1, round(SMOOTH_S / s.interval_s)))
        lost = np.where(self.at < 0, change @ np.gradient(s.output, s.time_s), 0.0) * s.average_s**2 / 24.0
        onward = np.where(self.at < 0, slope, 0.0) * (delay_s - near)
        return np.asarray(mean @ s.output - lost + onward), np.asarray(slope)

    @cached_property
    def _cache(self) -> dict[float, tuple[Operator, Operator]]:
        return {}

    def _operators(self, delay_s: float) -> tuple[Operator, Operator]:
        """Sparse (n, k): mean and change, the intervals taken ``delay_s`` later."""
        if delay_s not in self._cache:
            if len(self._cache) > 1:
                self._cache.popitem()
            self._cache[delay_s] = self._build(delay_s)
        return self._cache[delay_s]

    def forget(self) -> None:
        """Gives the operators' memory back."""
        self._cache.clear()

    def _build(self, delay_s: float) -> tuple[Operator, Operator]:
        from scipy.sparse import vstack

        slope = _gradient(self.samples.time_s)
        edges = [*range(0, len(self.at), SLAB), len(self.at)]
        slabs = [self._slab(slice(a, b), delay_s, slope) for a, b in pairwise(edges)]
        if len(slabs) == 1:
            return slabs[0]
        return vstack([s[0] for s in slabs], format="csr"), vstack([s[1] for s in slabs], format="csr")

    def _slab(self, rows: slice, delay_s: float, slope: Operator) -> tuple[Operator, Operator]:
        """Some of the rows."""
        from scipy.sparse import coo_array, diags_array

        at, begin_s, end_s = self.at[rows], self.begin_s[rows], self.end_s[rows]
        time, n, k = self.samples.time_s, len(at), len(self.samples.time_s)
        single, between = np.flatnonzero(at >= 0), np.flatnonzero(at < 0)
        mean, tilt, change = _Entries(), _Entries(), _Entries()
        mean.add(single, at[single], 1.0)
        bounds, per_dt = [], 1.0 / (end_s - begin_s)[between]
        for sign, moment in ((-1.0, begin_s), (1.0, end_s)):
            i = np.clip(np.searchsorted(time, moment[between] + delay_s, side="right") - 1, 0, k - 2)
            h = time[i + 1] - time[i]
            u = (moment[between] + delay_s - time[i]) / h
            _cubic(mean, tilt, between, i, u, sign * h * per_dt, h)
            change.add(between, i, (1.0 - u) * sign * per_dt)
            change.add(between, i + 1, u * sign * per_dt)
            bounds.append(i)
        # The whole pieces between the two: rows that span several samples have several.
        count = bounds[1] - bounds[0]
        row = np.repeat(np.arange(len(between)), count)
        piece = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + bounds[0][row]
        h = np.diff(time)[piece]
        _cubic(mean, tilt, between[row], piece, np.ones(len(row)), h * per_dt[row], h)
        shape = (n, k)
        steep = coo_array(change.coordinates, shape=shape).tocsr()
        steep += diags_array(np.where(at >= 0, 1.0, 0.0)) @ slope[np.maximum(at, 0)]
        level, lean = (coo_array(e.coordinates, shape=shape).tocsr() for e in (mean, tilt))
        return level + lean @ slope, steep


def _smooth(values: F64, width: int) -> F64:
    """The mean with weights that fall off linearly to nothing ``width`` samples away."""
    weights = np.bartlett(2 * width + 1)[1:-1]
    padded = np.pad(values, width - 1, mode="edge")
    return np.convolve(padded, weights / weights.sum(), mode="valid")


class _Entries:
    """Entries of a sparse matrix, gathered piece by piece."""

    def __init__(self) -> None:
        self._parts: list[tuple[Ints, Ints, F64]] = []

    def add(self, row: Ints, column: Ints, value: F64 | float) -> None:
        self._parts.append((row, column, np.broadcast_to(value, row.shape)))

    @property
    def coordinates(self) -> tuple[F64, tuple[Ints, Ints]]:
        row, column, value = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        return value, (row, column)


def _cubic(level: _Entries, slope: _Entries, row: Ints, i: Ints, u: F64, weight: F64, h: F64) -> None:
    """Adds weight/h·∫ from sample i to u of the way to the next, of the cubic through both values and slopes.

    For u = 1 that is the trapezoid rule less h²/12·(f'(b) - f'(a)).
    """
    level.add(row, i, weight * (u - u**3 + u**4 / 2.0))
    level.add(row, i + 1, weight * (u**3 - u**4 / 2.0))
    slope.add(row, i, weight * h * (u**2 / 2.0 - 2.0 * u**3 / 3.0 + u**4 / 4.0))
    slope.add(row, i + 1, weight * h * (u**4 / 4.0 - u**3 / 3.0))


def _gradient(time_s: F64) -> Operator:
    """Sparse (k, k): slopes at the samples, as numpy.gradient takes them."""
    from scipy.sparse import diags_array

    h = np.diff(time_s)
    before, after = h[:-1], h[1:]
    low = np.append(-after / (before * (before + after)), -1.0 / h[-1])
    middle = np.concatenate([[-1.0 / h[0]], (after - before) / (before * after), [1.0 / h[-1]]])
    high = np.append(1.0 / h[0], before / (after * (before + after)))
    return diags_array([low, middle, high], offsets=[-1, 0, 1]).tocsr()


def samples(recording: Recording, axis: str, mask: Mask | None = None) -> Samples:
    """The gyro's samples in ``mask`` (rows of the recording); raises Problem ``fit.too_short``, ``fit.stuck``."""
    gyro = recording.gyro(axis)
    there = np.isfinite(gyro.values)
    if mask is not None:
        there &= mask
    index = np.flatnonzero(there)
    if len(index) < LEAST:
        raise Problem("fit.too_short", axis=axis, samples=len(index), least=LEAST)
    if np.ptp(gyro.values[index]) == 0.0:
        raise Problem("fit.stuck", axis=axis, value=float(gyro.values[index[0]]), unit=gyro.unit)
    time = recording.time_s[index] + gyro.delay_s
    step = np.diff(time)
    interval = float(np.median(step))
    start = np.concatenate([[True], step > GAP * interval])
    average = float(recording.header.get("gyro_average_s", 0.0))
    return Samples(gyro.unit, time, gyro.values[index], start, interval, average, index)


def with_reference(s: Samples, axis: str, rate_dps: F64) -> tuple[Rows, Averages, F64]:
    """One row per sample that has a reference rate (all rows of the recording given): rows, averages, rate (n,)."""
    rate = rate_dps[s.index]
    at = np.flatnonzero(np.isfinite(rate))
    if len(at) < LEAST:
        raise Problem("fit.too_short", axis=axis, samples=len(at), least=LEAST)
    n, none = len(at), np.full(len(at), -1)
    time = s.time_s[at]
    start = np.diff(time, prepend=-np.inf) > GAP * s.interval_s
    rows = Rows(time, np.full(n, s.interval_s), start, none, none, np.empty(0), np.ones(n), np.zeros(n))
    return rows, Averages(s, time, time, at), rate[at]


def with_encoder(
    s: Samples, axis: str, time_s: F64, angle_deg: F64, calibration: AxisCalibration | None = None
) -> tuple[Rows, Averages, encoder_noise.Readings]:
    """Rows between encoder readings, one per sample inside rests; and the readings used, a rest's as one.

    Codes are told apart by what was read; the angles they stand for are then corrected by the encoder's calibration.
    ``time_s``, ``angle_deg`` (m,) are all readings of the recording; those outside the samples' stretches are left out.
    """
    order = np.argsort(time_s, kind="stable")
    time, angle = time_s[order], angle_deg[order]
    stretch = np.cumsum(s.start) - 1
    first, last = s.time_s[s.start], s.time_s[np.append(s.start[1:], True)]
    k = np.clip(np.searchsorted(first, time, side="right") - 1, 0, None)
    inside = (time >= first[k]) & (time <= last[k]) & np.append(True, np.diff(time) > 0)
    time, angle, k = time[inside], angle[inside], k[inside]
    if len(time) < 3:
        raise Problem("fit.no_reference", axis=axis)
    readings = encoder_noise.inspect(time, angle)
    if calibration is not None:
        corrected, step = calibration.apply(angle), readings.step_deg * calibration.scale
        readings = replace(readings, angle_deg=corrected, step_deg=step)

    # One reading for each moving reading, one for each rest.
    rest = readings.rest
    new = (rest < 0) | (np.diff(rest, prepend=-1) != 0) | (np.diff(k, prepend=-1) != 0)
    number = np.cumsum(new) - 1
    join = np.flatnonzero((np.diff(number) == 1) & (np.diff(k) == 0))
    none = np.full(len(join), -1)
    moving = np.array([time[join], time[join + 1], number[join], number[join + 1], none], dtype=float)

    # In rests, the samples whose whole interval lies inside.
    begin = np.flatnonzero(new & (rest >= 0))
    end = np.append(np.flatnonzero(new)[1:], len(time))[number[begin]] - 1
    half = s.interval_s / 2.0
    low, high = np.searchsorted(s.time_s, time[begin] + half), np.searchsorted(s.time_s, time[end] - half)
    inside = [np.arange(a, b) for a, b in zip(low, high, strict=True)]
    at = np.concatenate(inside).astype(np.int64) if inside else np.empty(0, np.int64)
    none = np.full(len(at), -1)
    still = np.array([s.time_s[at], s.time_s[at], none, none, at], dtype=float)

    pieces = np.concatenate([moving, still], axis=1)
    begin_s, end_s, *numbers = pieces[:, np.argsort(pieces[0] + pieces[1], kind="stable")]
    before, after, at = (x.astype(np.int64) for x in numbers)
    middle = (begin_s + end_s) / 2.0
    dt = np.where(at >= 0, s.interval_s, end_s - begin_s)
    inside = stretch[np.clip(np.searchsorted(s.time_s, middle, side="right") - 1, 0, None)]
    start = np.diff(inside, prepend=-1) != 0
    kept = readings.take(new)
    own, next_ = _white(s, begin_s, end_s, at, start)
    rows = Rows(middle, dt, start, before, after, kept.variance, own, next_)
    return rows, Averages(s, begin_s, end_s, at), kept


def _white(s: Samples, begin_s: F64, end_s: F64, at: Ints, start: Mask) -> tuple[F64, F64]:
    """Variance of each row's mean, and covariance with the next row's, for samples of white noise of variance 1.

    By the trapezoid rule an integral up to a time between samples k and k+1, u of the way, holds all samples up to k,
    less (1-u)²/2 of sample k, plus u²/2 of sample k+1.
    """

    def spread(begin_s: F64, end_s: F64) -> F64:
        (a, u), (b, v) = ((np.floor(x), x % 1.0) for x in (_at(begin_s), _at(end_s)))
        p, q, r, t = (1.0 - u) ** 2 / 2.0, u**2 / 2.0, (1.0 - v) ** 2 / 2.0, v**2 / 2.0
        apart = b - a
        out = apart + p**2 + q**2 + r**2 + t**2
        out -= np.where(apart >= 1, 2.0 * (r + q), 2.0 * (p * r + q * t))
        return np.asarray(out + np.where(apart == 1, 2.0 * r * q, 0.0))

    def _at(time_s: F64) -> F64:
        return np.asarray(np.interp(time_s, s.time_s, np.arange(float(len(s.time_s)))))

    own, next_ = np.ones(len(at)), np.zeros(len(at))
    moving = at < 0
    length = np.where(moving, (end_s - begin_s) / s.interval_s, 1.0)
    own[moving] = spread(begin_s[moving], end_s[moving])
    a = np.flatnonzero(moving[:-1] & moving[1:] & ~start[1:])
    next_[a] = (spread(begin_s[a], end_s[a + 1]) - own[a] - own[a + 1]) / 2.0
    # Rows next but one share a little too, which is left out: dominance keeps the whole positive definite without it.
    own = np.maximum(own, (1.0 + REGULAR) * (np.abs(next_) + np.append(0.0, np.abs(next_[:-1]))))
    next_[:-1] /= length[:-1] * length[1:]
    return own / length**2, next_
