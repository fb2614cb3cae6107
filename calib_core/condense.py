"""Fewer rows that know as much: neighbouring readings, and neighbouring samples at rest, taken together.

The mean of several consecutive readings, at the mean of their times, is one reading with less noise. A row between two
such means is a mean of the rows that lie between, its weights rising and falling as a triangle. It is linear, so output
and columns go the same way and nothing is approximated; only motion within a mean is lost, and of that there is little:
40 ms keep 96 % of a motion at 4 Hz.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core.integral_fit import Design
from calib_core.rows import REGULAR, Averages
from calib_core.whitening import Rows

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Operator = Any  # a scipy.sparse matrix

TOGETHER_S = 0.04
KEPT = 0.91
"""Of the square of a reference rate's slope, what its means must keep: the slope is what lateness looks like."""


@dataclass(frozen=True)
class _Entries:
    """Weights of the design's rows ``fine`` in the new rows ``row``."""

    row: Ints
    fine: Ints
    weight: F64


def condense(design: Design) -> tuple[Rows, Operator]:
    """The design's n rows over means of about 40 ms (single readings where these are further apart), n' in all, and
    the sparse operator (n', n) that makes them of its own."""
    from scipy.sparse import csr_array, diags_array

    rows = design.rows
    at_rest, between = np.flatnonzero(rows.after < 0), np.flatnonzero(rows.after >= 0)
    still = _still(rows, at_rest, _samples(design))
    turning, before, after, variance = _turning(design, between)
    count = int(still.row.max(initial=-1)) + 1
    row = np.concatenate([still.row, turning.row + count])
    fine = np.concatenate([still.fine, turning.fine])
    weight = np.concatenate([still.weight, turning.weight]) * rows.dt_s[fine]
    dt = np.bincount(row, weight).astype(float)
    time = np.bincount(row, weight * rows.time_s[fine]) / dt
    order = np.argsort(time, kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    operator = csr_array((weight / dt[row], (place[row], fine)), shape=(len(dt), len(rows)))

    # What white noise of the samples leaves in the new rows, and in neighbours together.
    shared = np.where(np.append(rows.start[1:], True), 0.0, rows.white_next)[:-1]
    covariance = operator @ diags_array([shared, rows.white_own, shared], offsets=[-1, 0, 1]) @ operator.T
    start = np.bincount(row, rows.start[fine])[order] > 0.0
    next_ = np.append(np.where(start[1:], 0.0, covariance.diagonal(1)), 0.0)
    least = (1.0 + REGULAR) * (np.abs(next_) + np.append(0.0, np.abs(next_[:-1])))
    none = np.full(count, -1)
    return Rows(
        time[order],
        dt[order],
        start,
        np.concatenate([none, before])[order],
        np.concatenate([none, after])[order],
        variance,
        np.maximum(covariance.diagonal(), least),
        next_,
    ), operator


def _samples(design: Design) -> int:
    """How many samples a mean may hold: at rest nothing is lost, of a reference rate's slope little may be."""
    interval = design.averages.samples.interval_s
    most = max(1, round(TOGETHER_S / interval))
    if design.reference != "rate" or not design.moves:
        return most
    slope = np.diff(design.rate)
    whole = float(slope @ slope)
    for count in range(most, 1, -1):
        smooth = np.convolve(slope, np.full(count, 1.0 / count), mode="same")
        if float(smooth @ smooth) > KEPT * whole:
            return count
    return 1


def _still(rows: Rows, fine: Ints, together: int) -> _Entries:
    """Means over samples that follow one another."""
    fresh = (np.diff(fine, prepend=-2) != 1) | rows.start[fine]
    group, _, size = _groups(fresh, together, least=1)
    return _Entries(group, fine, 1.0 / size[group])


def _turning(design: Design, fine: Ints) -> tuple[_Entries, Ints, Ints, F64]:
    """Rows between means of readings; their readings before and after, and the variance of the new readings.

    A rest's reading stays alone: its error is one, and it is left at another time than it was reached.
    """
    rows, readings = design.rows, design.readings
    if readings is None or not len(fine):
        none = np.empty(0, np.int64)
        return _Entries(none, none, np.empty(0)), none, none, np.empty(0)
    m = len(rows.reading_variance)
    together = max(1, round(TOGETHER_S / float(np.median(rows.dt_s[fine]))))
    linked = np.zeros(m, bool)
    linked[rows.before[fine]] = True  # to the reading that follows
    resting = readings.rest >= 0
    fresh = np.ones(m, bool)
    fresh[1:] = ~linked[:-1] | resting[1:] | resting[:-1]
    group, rank, size = _groups(fresh, together, least=2)
    last = np.flatnonzero(np.diff(group, append=group[-1] + 1))
    onward = np.where(linked[last], np.cumsum(linked[last]) - 1, -1)  # the new row that begins in each group
    reached = np.append(-1, onward[:-1])

    q = rows.before[fine]
    g, inner = group[q], group[q] == group[rows.after[fine]]
    # A step inside a mean counts onward for the readings up to it, and towards the mean for those after it.
    share = np.where(inner, (rank[q] + 1.0) / size[g], 1.0)
    row = np.concatenate([onward[g], np.where(inner, reached[g], -1)])
    weight = np.concatenate([share, 1.0 - share])
    kept = (row >= 0) & (weight > 0.0)
    entries = _Entries(row[kept], np.concatenate([fine, fine])[kept], weight[kept])
    variance = np.bincount(group, rows.reading_variance) / size**2
    before = np.flatnonzero(onward >= 0)
    return entries, before, before + 1, variance


def _groups(fresh: Mask, together: int, least: int) -> tuple[Ints, Ints, F64]:
    """The group (n,) of each member, its rank (n,) in it, and the sizes of the groups: each run, which begins where
    ``fresh``, falls into parts of about ``together``, at ``least`` so many where it has the members."""
    n = len(fresh)
    first = np.flatnonzero(fresh)
    run = np.cumsum(fresh) - 1
    length = np.diff(np.append(first, n))
    parts = np.maximum(np.round(length / together).astype(np.int64), np.minimum(least, length))
    begin = np.cumsum(parts) - parts
    group = begin[run] + (np.arange(n) - first[run]) * parts[run] // length[run] if n else np.empty(0, np.int64)
    head = np.flatnonzero(np.diff(group, prepend=-1))
    return group, np.arange(n) - head[group] if n else group, np.bincount(group).astype(float)


def integrals(averages: Averages) -> tuple[Operator, Operator]:
    """Sparse (n, k) over the design's rows, from anything known at the k samples: its mean by the trapezoid rule (a
    sample itself at rest), and its change over the interval by its length (nothing at rest)."""
    from scipy.sparse import csr_array

    time, k = averages.samples.time_s, len(averages.samples.time_s)
    single, between = np.flatnonzero(averages.at >= 0), np.flatnonzero(averages.at < 0)
    per_dt = 1.0 / (averages.end_s - averages.begin_s)[between]
    rows, places, means, changes = [single], [averages.at[single]], [np.ones(len(single))], [np.zeros(len(single))]
    ends = []
    for sign, moment in ((-per_dt, averages.begin_s[between]), (per_dt, averages.end_s[between])):
        i = np.clip(np.searchsorted(time, moment, side="right") - 1, 0, k - 2)
        h = time[i + 1] - time[i]
        u = (moment - time[i]) / h
        rows += [between, between]
        places += [i, i + 1]
        means += [sign * h * (u - u**2 / 2.0), sign * h * u**2 / 2.0]
        changes += [sign * (1.0 - u), sign * u]
        ends.append(i)
    # The whole pieces between the two.
    count = ends[1] - ends[0]
    row = np.repeat(np.arange(len(between)), count)
    piece = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + ends[0][row]
    half = (time[piece + 1] - time[piece]) / 2.0 * per_dt[row]
    rows += [between[row], between[row]]
    places += [piece, piece + 1]
    means += [half, half]
    changes += [np.zeros(len(row))] * 2
    at = (np.concatenate(rows), np.concatenate(places))
    mean, change = (csr_array((np.concatenate(v), at), shape=(len(averages.at), k)) for v in (means, changes))
    change.eliminate_zeros()
    return mean, change
