"""How far an encoder's reading may be from the truth: its step, rests, and motion that repeats the same codes.

METHOD 2: a moving reading has the variance step²/12, times half its run of equal codes (the error is the same sawtooth
all along a run), times how often its code pattern recurs (a motion locked to the clock never averages quantisation).
At rest the error is one draw however many readings there are, so a whole rest is one reading.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

REST_S = 0.4
"""The same code for at least this long is a rest."""
SETTLING_S, LEAVING_S = 0.25, 0.1
"""Cut from the beginning and the end of a rest: the table still creeps within the code, for several time constants."""
FINE = 30.0
"""A grid so fine that neighbouring readings are this many codes apart is a printed number's last digit, or as good."""
PATTERN = 16
"""Two readings see the same motion where this many codes before and after them are equal."""


@dataclass(frozen=True, eq=False)
class Readings:
    """m readings in time order and what their codes tell about their errors."""

    time_s: F64
    angle_deg: F64
    step_deg: float
    """The spacing of the codes; 0 where the angles lie on no grid."""
    run: Ints
    """How many consecutive readings share this one's code."""
    recurrence: Ints
    """How many different runs show this one's code pattern."""
    rest: Ints
    """The number of the rest it belongs to, -1 while moving."""

    def take(self, chosen: Mask) -> "Readings":
        """The readings ``chosen`` (m,)."""
        arrays = (a[chosen] for a in (self.run, self.recurrence, self.rest))
        return Readings(self.time_s[chosen], self.angle_deg[chosen], self.step_deg, *arrays)

    @property
    def variance(self) -> F64:
        """(m,) deg², of the error of each reading; a rest's readings share one error."""
        return self.step_deg**2 / 12.0 * np.where(self.rest >= 0, 1.0, np.maximum(1.0, self.run / 2.0))


def step_of(angle_deg: F64) -> float:
    """The spacing of the codes in deg, from the angles (m,) alone; 0 where they lie on no grid, or are all equal."""
    levels = np.unique(np.round(angle_deg, 6))
    gaps = np.diff(levels)
    if len(gaps) == 0:
        return 0.0
    # Printed angles are rounded: the smallest gap is off by that, the mean of such gaps by little, and the slope over
    # all codes by nothing.
    step = float(gaps[gaps < 1.5 * gaps.min()].mean())
    for _ in range(3):
        codes = np.round((levels - levels[0]) / step)
        step = float(codes @ (levels - levels[0]) / (codes @ codes))
    off_grid = np.abs(levels - levels[0] - step * codes).max()
    jumps = np.abs(np.diff(angle_deg))
    fine = np.median(jumps[jumps > 0.0]) > FINE * step
    return 0.0 if fine or off_grid > 0.1 * step else step


def inspect(time_s: F64, angle_deg: F64) -> Readings:
    """Step, runs, rests and recurrence of the readings (m,) at increasing times (m,)."""
    m = len(angle_deg)
    step = step_of(angle_deg)
    codes = np.round((angle_deg - angle_deg[0]) / (step or 1.0)).astype(np.int64)
    if step == 0.0 and np.ptp(angle_deg) > 0.0:
        one = np.ones(m, np.int64)
        return Readings(time_s, angle_deg, 0.0, one, one, -one)
    first = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1) != 0)
    last = np.append(first[1:], m) - 1
    length = last - first + 1
    number = np.repeat(np.arange(len(first)), length)

    resting = (time_s[last] - time_s[first] >= REST_S) & ~_passing(codes[first], length)
    rest = np.where(resting[number], np.cumsum(resting)[number] - 1, -1)
    settling = (time_s - time_s[first][number] < SETTLING_S) & (number > 0)
    settling |= (time_s[last][number] - time_s < LEAVING_S) & (number < len(first) - 1)
    rest[settling] = -1
    settled = int(np.searchsorted(time_s, time_s[0] + LEAVING_S))
    run = np.where(resting[number] & (rest < 0), settled, length[number])
    return Readings(time_s, angle_deg, step, run, _recurrence(codes, number), rest)


def _passing(code: Ints, length: Ints) -> Mask:
    """Which runs are slow motion in one direction, not a rest: neighbours one code away, and long themselves."""
    passing = np.zeros(len(code), bool)
    step = np.diff(code)
    on = (step[1:] == step[:-1]) & (np.abs(step[1:]) == 1)
    passing[1:-1] = on & (np.minimum(length[:-2], length[2:]) > 0.3 * length[1:-1])
    return passing


def _recurrence(codes: Ints, number: Ints) -> Ints:
    """In how many different runs each reading's pattern of codes is seen."""
    m = len(codes)
    if m <= 2 * PATTERN:
        return np.ones(m, np.int64)
    weights = np.random.default_rng(0).integers(1, 2**62, 2 * PATTERN + 1)
    pattern = np.convolve(codes, weights, mode="valid")  # wraps: a hash of the codes around each reading
    pattern = np.concatenate([np.full(PATTERN, pattern[0]), pattern, np.full(PATTERN, pattern[-1])])
    order = np.lexsort((number, pattern))
    pattern, number = pattern[order], number[order]
    new_pattern = np.diff(pattern, prepend=pattern[0] - 1) != 0
    new_run = new_pattern | (np.diff(number, prepend=-1) != 0)
    group = np.cumsum(new_pattern) - 1
    seen = np.empty(m, np.int64)
    seen[order] = np.bincount(group, weights=new_run).astype(np.int64)[group]
    return seen
