"""Saturation: stretches where the output stays on one level while the table turns faster than that level means.

Inside the clip the output says nothing about the rate, so those samples leave the record; what remains is judged as
any other record is. The evidence is what that explains, over the whole record, against the best other effect.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_core.covariates import encoder_rate
from calib_core.integral_fit import Design
from calib_core.recording import Recording

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEVEL = 4.0
"""Samples within this many deviations of the extreme level are on it."""
LEAST = 15
"""So many samples make a level."""
FEWEST = 100
"""Samples through which the line is drawn."""
TOP, PLAIN = 4, 60.0
"""Beside an exact rate: so large a part of the samples may be on a limit, which must explain so much."""
SETTLED = 3.0
"""So many deviations of the smoothing after a change."""
APART_DPS = 3.0
"""Slower rates belong to neither half of the line."""
SMOOTH_S, STEADY_DPS2, STEADY_S = 0.06, 150.0, 0.1
"""Where the rate changes faster, or the output moves within this time, the smoothed encoder is behind."""


@dataclass(frozen=True, eq=False)
class Clip:
    """Which samples of the recording (n,) are on a limit, and the limits (None where not reached)."""

    clipped: Mask
    low: float | None
    high: float | None


def _limit(output: F64, expected: F64, noise: float) -> tuple[float, float]:
    """Where the ``output`` (k,) seems to stop although more is ``expected`` of it, and the 2ΔlnL in white ``noise``."""
    order = np.argsort(-expected)[: len(expected) // TOP]
    output, expected = output[order], expected[order]
    # With the m highest on a limit of their own mean: what that takes off the squares about what was expected.
    m = np.arange(1.0, len(order) + 1.0)
    mean = np.cumsum(output) / m
    left = np.cumsum(output**2) - m * mean**2
    gain = (np.cumsum((output - expected) ** 2) - left) / noise**2
    gain[(m < LEAST) | (mean > expected)] = 0.0
    best = int(np.argmax(gain))
    return float(mean[best]), float(gain[best])


def find(recording: Recording, axis: str, design: Design, noise: float) -> Clip | None:
    """The limits that the output of ``axis`` seems to stop at, or None; ``noise`` is one sample's deviation."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    if not design.moves:
        return None
    s = design.averages.samples
    rate = encoder_rate(recording, axis, design, SMOOTH_S)
    middle, reach = float(np.median(s.output)), float(np.ptp(s.output)) / 2.0
    width = max(3, round(STEADY_S / s.interval_s))
    wander = maximum_filter1d(s.output, width) - minimum_filter1d(s.output, width)
    steady = (np.abs(np.gradient(rate, s.interval_s)) < STEADY_DPS2) & (wander < 3.0 * LEVEL * noise)
    inner = steady & (np.abs(s.output - middle) < 0.7 * reach)
    # Where motion begins and ends the smoothed encoder is slower than the gyro: by half a per cent over all.
    settled = inner & minimum_filter1d(steady, 2 * round(SETTLED * SMOOTH_S / s.interval_s) + 1)
    if settled.sum() >= FEWEST:
        inner = settled
    if reach < 20.0 * noise or inner.sum() < FEWEST or np.ptp(rate[inner]) == 0.0:
        return None
    # A dead band or play shifts the line apart at zero: its two halves need not meet.
    line = np.column_stack([np.ones(len(rate)), rate, np.sign(rate) * (np.abs(rate) > APART_DPS)])
    expected = line @ np.linalg.lstsq(line[inner], s.output[inner], rcond=None)[0]
    spread = float(np.std(s.output[inner] - expected[inner]))
    limits: dict[float, float] = {}
    clipped = np.zeros(len(s.output), bool)
    if design.reference == "rate":
        for side in (-1.0, 1.0):
            limit, gain = _limit(side * s.output, side * expected, noise)
            if gain > PLAIN:
                limits[side] = side * limit
                clipped |= side * expected > limit
    for side in (-1.0, 1.0) if not limits else ():
        top = side * s.output
        extreme = float(np.quantile(top, 1.0 - 5.0 / len(top)))
        on = steady & (top > extreme - 2.0 * LEVEL * noise)
        beyond = side * (expected - s.output)[on]
        independent = max(on.sum() * s.interval_s / SMOOTH_S, 1.0)
        if on.sum() >= LEAST and beyond.mean() > max(LEVEL * noise / 2.0, 5.0 * spread / np.sqrt(independent)):
            level = float(np.median(s.output[on]))
            limits[side] = level
            clipped |= side * (s.output - level) > -LEVEL * noise
    if not limits:
        return None
    near = np.convolve(clipped, np.ones(5), mode="same") > 0.0
    whole = np.zeros(len(recording), bool)
    whole[s.index[near]] = True
    return Clip(whole, limits.get(-1.0), limits.get(1.0))
