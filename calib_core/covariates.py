"""The best estimate, from a recording, of what effects depend on: rate, angle, direction, temperature …

The argument of every φ(ω) is a rate that is exactly zero in rests, whose slow part comes from the encoder and whose
fast part comes from the gyro. With the gyro's rate alone a column would contain the gyro's own noise, which is what the
residual is made of: a spline in rate then "explains" a healthy record at thirty standard deviations.
"""

import numpy as np
from numpy.typing import NDArray

from calib_core.effects.base import Covariates
from calib_core.integral_fit import Design
from calib_core.recording import Recording

F64 = NDArray[np.float64]

CROSSOVER_S = 0.15
"""Below this time scale the gyro leads, above it the encoder."""
BACKGROUND_S = 5.0
"""Below this time scale the gyro tells when the table turns."""
TURNING_DPS = 1.5
"""Rates above this give a direction; slower ones keep the last."""
COVARIATE_S = 0.5
"""Temperature and supply are smoothed over this: they change slowly, their converters do not know that."""

OTHER_S = 0.05
"""The other axis' rate is the difference of its encoder, smoothed over this."""


def of(recording: Recording, axis: str, design: Design, bias: float, scale_factor: float) -> Covariates:
    """Covariates (k,) at the gyro's samples of ``design``, given the output's bias and scale factor."""
    s = design.averages.samples
    interval = s.interval_s
    felt = (s.output - bias) / scale_factor if np.isfinite(scale_factor) else np.zeros_like(s.output)
    other = next((a for a in ("x", "z", "y") if a != axis and f"{a}_position_deg" in recording.columns), None)
    if design.reference == "encoder":
        angle = _angle(recording, axis, s.time_s)
        slow = CROSSOVER_S / interval
        rate = _crossed(felt, angle, CROSSOVER_S, interval)
        position = np.concatenate([[0.0], np.cumsum(felt[1:] + felt[:-1])]) * interval / 2.0
        position += _smooth(angle - position, slow)
        still = design.averages.at[design.averages.at >= 0]
        rate[still] = 0.0
        # The encoder's own jump at a reversal, smoothed, would move the moment at which the table seems to turn.
        turning = _crossed(felt, angle, BACKGROUND_S, interval)
        turning[still] = 0.0
    else:
        reference = recording.reference_rate(axis)
        assert reference is not None
        rate = turning = np.nan_to_num(reference[s.index])
        has_angle = f"{axis}_position_deg" in recording.columns
        position = _angle(recording, axis, s.time_s) if has_angle else np.cumsum(rate) * interval
    tilt = None
    if f"{axis}_position_deg" in recording.columns or other == "x":
        tilt = position if axis == "x" else (_angle(recording, "x", s.time_s) if other == "x" else None)
    other_rate = None
    if other is not None:
        other_rate = np.gradient(_smooth(_angle(recording, other, s.time_s), OTHER_S / interval), interval)
    force = {
        a: np.nan_to_num(recording.columns[f"{a}_acceleration_g"][s.index])
        for a in "xyz"
        if f"{a}_acceleration_g" in recording.columns
    }
    temperature = _slow(recording, "temperature_c", s.index, interval)
    supply = _slow(recording, "supply_v", s.index, interval)
    reference_values = {
        name: float(values.mean())
        for name, values in (("temperature_c", temperature), ("supply_v", supply))
        if values is not None
    }
    return Covariates(
        axis=axis,
        time_s=s.time_s - s.time_s[0],
        rate_dps=rate,
        position_deg=position,
        acceleration_dps2=np.gradient(rate, interval),
        direction=direction(turning),
        interval_s=interval,
        temperature_c=temperature,
        supply_v=supply,
        other_rate_dps=other_rate,
        tilt_deg=tilt,
        specific_force_g=force or None,
        reference=reference_values,
    )


def encoder_rate(recording: Recording, axis: str, design: Design, smooth_s: float) -> F64:
    """(k,) the reference's rate at the gyro's samples, an encoder's smoothed over ``smooth_s``, without the gyro."""
    s = design.averages.samples
    reference = recording.reference_rate(axis)
    if reference is not None:
        return np.nan_to_num(reference[s.index])
    return np.gradient(_smooth(_angle(recording, axis, s.time_s), smooth_s / s.interval_s), s.interval_s)


def direction(rate_dps: F64) -> F64:
    """(n,) sign of the last rotation; 0 before the first that was faster than ``TURNING_DPS``.

    It changes where the rate passed zero before it was that fast; the sample next to that moment has what a straight
    line through its neighbours needs for the step to be there.
    """
    sign = np.where(rate_dps > TURNING_DPS, 1.0, np.where(rate_dps < -TURNING_DPS, -1.0, 0.0))
    turned = np.flatnonzero(sign)
    if len(turned) == 0:
        return sign
    last = np.searchsorted(turned, np.arange(len(sign)), side="right") - 1
    out = np.where(last >= 0, sign[turned[np.maximum(last, 0)]], 0.0)
    index = np.arange(len(sign))
    for now in (1.0, -1.0):
        slower = np.maximum.accumulate(np.where(now * rate_dps <= 0.0, index, -1))
        for k in np.flatnonzero((out[1:] == now) & (out[:-1] == -now)) + 1:
            j = int(slower[k])
            out[j + 1 : k] = now
            share = -rate_dps[j] / (rate_dps[j + 1] - rate_dps[j]) if rate_dps[j] else 0.5
            out[j if share < 0.5 else j + 1] += now * (1.0 - 2.0 * share)
    return out


def _crossed(felt: F64, angle: F64, crossover_s: float, interval_s: float) -> F64:
    """(k,) the rate, its part faster than ``crossover_s`` the gyro's and the rest the encoder's; a mean over three."""
    sigma = crossover_s / interval_s
    rate = felt - _smooth(felt, sigma) + np.gradient(_smooth(angle, sigma), interval_s)
    return np.convolve(np.pad(rate, 1, mode="edge"), np.full(3, 1 / 3), mode="valid")


def _angle(recording: Recording, axis: str, at_s: F64) -> F64:
    time, angle = recording.position(axis)
    return np.interp(at_s, time, angle)


def _slow(recording: Recording, name: str, index: NDArray[np.int64], interval_s: float) -> F64 | None:
    if name not in recording.columns:
        return None
    values = recording.columns[name][index]
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < 2:
        return None
    return _smooth(np.interp(np.arange(len(values)), known, values[known]), COVARIATE_S / interval_s)


def _smooth(values: F64, sigma: float) -> F64:
    """Gaussian mean, ``sigma`` in samples; ends are held."""
    if sigma < 0.3:
        return values
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(values, sigma, mode="nearest", truncate=4.0))
