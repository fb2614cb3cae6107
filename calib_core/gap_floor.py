"""What an encoder's codes bring into windows of a second, whatever the model: their part of the noise floor.

A code's error is no noise: it recurs with the motion, and at rest it is one draw. So the path is found that gyro and
codes tell together (the Kalman smoother's, by the whitened rows), and read in codes once more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_core.integral_fit import Design
from calib_core.weak_form import Windows
from calib_core.whitening import RowNoise, Whitener

F64 = NDArray[np.float64]

DOUBT = (-0.07, 0.0, 0.07)
"""Of a step: about how far the path may be from where it was found."""


def coded(design: Design, windows: Windows, rate_dps: F64, seen_deg: F64, noise: RowNoise) -> F64:
    """(w,) the square that reading the angle in codes is expected to bring into each window, (deg/s)².

    ``rate_dps`` (k,) is the model's rate at the samples, as the gyro tells it; ``seen_deg`` (k,) what the encoder shows
    beside the angle; ``noise`` in deg/s.
    """
    readings, rows, averages = design.readings, design.rows, design.averages
    assert readings is not None
    squares = np.full(len(windows.first), noise.reading_deg**2 * windows.steepness)
    step = readings.step_deg
    if step == 0.0:
        return squares
    left = averages.mean(rate_dps) + averages.change(seen_deg) - design.rate
    whitener = Whitener(rows, 1.0, noise)
    pull = rows.to_readings(whitener.precision_times(whitener.whiten(left)))
    path = readings.angle_deg - (rows.reading_variance + noise.reading_deg**2) * pull
    for doubt in DOUBT:
        near = path + doubt * step
        error = np.interp(averages.samples.time_s, readings.time_s, step * np.round(near / step) - near)
        squares += windows.rate(error[:, None])[:, 0] ** 2 / len(DOUBT)
    return squares
