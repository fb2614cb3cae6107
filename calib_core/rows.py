"""From a recording to rows: mean gyro output over each interval against the true rate over the same interval.

Encoder recordings (METHOD 2): the integral of V between two readings against the angle between them; inside a rest the
true rate is exactly zero, so every sample is a row of its own. A reference rate, or a stationary record, gives one row
per sample. Columns of effects are averaged over the same intervals by ``Averages``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_core import encoder_noise
from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.whitening import Rows

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

REGULAR = 0.01
"""Relative variance added to each row's white noise, for what the trapezoid rule leaves out."""
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

    def mean(self, values: F64, *, shift_s: float = 0.0, average_s: float = 0.0) -> F64:
        """(n,) means of ``values`` (k,) over the intervals, moved later by ``shift_s``; samples stay where they are."""
        out = np.empty(len(self.at))
        single = self.at >= 0
        out[single] = values[self.at[single]]
        between = ~single
        if between.any():
            s = self.samples
            begin, end = self.begin_s[between], self.end_s[between]
            integral = Integral(s.time_s, values, s.start, average_s)
            out[between] = (integral(end + shift_s) - integral(begin + shift_s)) / (end - begin)
        return out

    def change(self, values: F64, *, shift_s: float = 0.0) -> F64:
        """(n,) (end - beginning)/length of ``values`` (k,) over the intervals, moved likewise; for a sample, its slope."""
        s = self.samples
        slope = np.gradient(values, s.time_s)
        out = slope[np.maximum(self.at, 0)]
        between = self.at < 0
        begin, end = self.begin_s[between], self.end_s[between]
        ends = (np.interp(t + shift_s, s.time_s, values) for t in (begin, end))
        out[between] = -np.subtract(*ends) / (end - begin)
        return out


class Integral:
    """∫ values dt as a function of time: the integral of the cubic through values and slopes.

    At the samples this is the corrected trapezoid rule, -h²/12·(f'(b) - f'(a)). Samples that are means over a span w
    of the signal have lost w²/24·f''; its integral is put back.
    """

    def __init__(self, time_s: F64, values: F64, start: Mask, average_s: float = 0.0) -> None:
        self._t, self._f = time_s, values
        self._slope = np.gradient(values, time_s)
        h = np.diff(time_s)
        piece = h * (values[1:] + values[:-1]) / 2.0 - h**2 / 12.0 * np.diff(self._slope)
        piece[start[1:]] = 0.0
        self._sum = np.concatenate([[0.0], np.cumsum(piece)])
        self._blur = average_s**2 / 24.0

    def __call__(self, at_s: F64) -> F64:
        k = np.clip(np.searchsorted(self._t, at_s, side="right") - 1, 0, len(self._t) - 2)
        h = self._t[k + 1] - self._t[k]
        u = (at_s - self._t[k]) / h
        f0, f1, d0, d1 = self._f[k], self._f[k + 1], h * self._slope[k], h * self._slope[k + 1]
        inside = u * (f0 + u * (d0 / 2 + u * ((3 * (f1 - f0) - 2 * d0 - d1) / 3 + u * (2 * (f0 - f1) + d0 + d1) / 4)))
        slope = self._slope[k] + u * (self._slope[k + 1] - self._slope[k])
        return np.asarray(self._sum[k] + h * inside - self._blur * slope)


def samples(recording: Recording, axis: str, mask: Mask | None = None) -> Samples:
    """The gyro's samples in ``mask`` (rows of the recording); raises Problem ``fit.too_short`` under eight."""
    gyro = recording.gyro(axis)
    there = np.isfinite(gyro.values)
    if mask is not None:
        there &= mask
    index = np.flatnonzero(there)
    if len(index) < 8:
        raise Problem("fit.too_short", axis=axis, samples=len(index), least=8)
    time = recording.time_s[index] + gyro.delay_s
    step = np.diff(time)
    interval = float(np.median(step))
    start = np.concatenate([[True], step > GAP * interval])
    average = float(recording.header.get("gyro_average_s", 0.0))
    return Samples(gyro.unit, time, gyro.values[index], start, interval, average, index)


def with_reference(s: Samples, rate_dps: F64) -> tuple[Rows, Averages, F64]:
    """One row per sample that has a reference rate (all rows of the recording given): rows, averages, rate (n,)."""
    rate = rate_dps[s.index]
    at = np.flatnonzero(np.isfinite(rate))
    if len(at) < 8:
        raise Problem("fit.too_short", axis="", samples=len(at), least=8)
    n, none = len(at), np.full(len(at), -1)
    time = s.time_s[at]
    start = np.diff(time, prepend=-np.inf) > GAP * s.interval_s
    rows = Rows(time, np.full(n, s.interval_s), start, none, none, np.empty(0), np.ones(n), np.zeros(n))
    return rows, Averages(s, time, time, at), rate[at]


def with_encoder(s: Samples, time_s: F64, angle_deg: F64) -> tuple[Rows, Averages, encoder_noise.Readings]:
    """Rows between encoder readings, one per sample inside rests; and the readings used, a rest's as one.

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
        raise Problem("fit.no_reference", readings=len(time))
    readings = encoder_noise.inspect(time, angle)

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
        return np.interp(time_s, s.time_s, np.arange(float(len(s.time_s))))

    own, next_ = np.ones(len(at)), np.zeros(len(at))
    moving = at < 0
    scale = s.interval_s / (end_s - begin_s)[moving]
    own[moving] = spread(begin_s[moving], end_s[moving]) * scale**2
    chained = np.flatnonzero(moving[:-1] & moving[1:] & ~start[1:])
    a, b = chained, chained + 1
    both = spread(begin_s[a], end_s[b])
    scale = s.interval_s**2 / ((end_s - begin_s)[a] * (end_s - begin_s)[b])
    apart = (own[a] * (end_s - begin_s)[a] ** 2 + own[b] * (end_s - begin_s)[b] ** 2) / s.interval_s**2
    next_[a] = (both - apart) / 2.0 * scale
    # With exact readings at the samples' own times the alternating part would vanish altogether.
    own[moving] *= 1.0 + REGULAR
    return own, next_
