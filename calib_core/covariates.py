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
from calib_core.rows import Samples

F64 = NDArray[np.float64]

CROSSOVER_S = 0.15
"""Below this time scale the gyro leads, above it the encoder."""
BACKGROUND_S = 5.0
"""Below this time scale the gyro tells when the table turns."""
TURNING_DPS, LEAST_DPS = 1.5, 0.5
"""Rates above this give a direction, or above the least where the gyro is quiet; slower ones keep the last."""
PLAIN = 9.0
"""So many deviations of the rate's noise are plainly a motion."""
STILL, RESTED = 0.6, 15
"""A rate below this share of one with a direction, for so many samples, was no motion, whatever its sign."""
COVARIATE_S = 0.5
"""Temperature and supply are smoothed over this: they change slowly, their converters do not know that."""
OTHER_S = 0.05
"""A rate that the encoder tells alone, the other axis' or within a gap, is its difference smoothed over this."""
BRIDGED_S = 5.0
"""Motion goes on through gaps shorter than this (samples on a limit are left out), and begins anew after others."""


def of(
    recording: Recording,
    axis: str,
    design: Design,
    bias: float,
    scale_factor: float,
    *,
    shift_dps: F64 | float = 0.0,
    shown_deg: F64 | float = 0.0,
) -> Covariates:
    """Covariates (k,) at the gyro's samples of ``design``, given the output's bias and scale factor; ``shift_dps`` (k,)
    is what effects are known to bring into the measured rate, ``shown_deg`` (k,) into the encoder's angle."""
    s = design.averages.samples
    interval = s.interval_s
    felt = (s.output - bias) / scale_factor if np.isfinite(scale_factor) else np.zeros_like(s.output)
    felt = felt - shift_dps
    time, own = _bridged(s)
    other = next((a for a in ("x", "z", "y") if a != axis and f"{a}_position_deg" in recording.columns), None)
    if design.reference == "encoder":
        angle = _angle(recording, axis, time) - np.interp(time, s.time_s, np.broadcast_to(shown_deg, s.time_s.shape))
        if len(time) > len(own):
            # Where samples are left out the encoder tells alone.
            bridged = np.gradient(_smooth(angle, OTHER_S / interval), interval)
            bridged[own] = felt
            felt = bridged
        rate = _crossed(felt, angle, CROSSOVER_S, interval)
        position = np.concatenate([[0.0], np.cumsum(felt[1:] + felt[:-1])]) * interval / 2.0
        position += _smooth(angle - position, CROSSOVER_S / interval)
        still = own[design.averages.at[design.averages.at >= 0]]
        rate[still] = 0.0
        # The encoder's own jump at a reversal, smoothed, would move the moment at which the table seems to turn.
        turning = _crossed(felt, angle, BACKGROUND_S, interval)
        turning[still] = 0.0
        acceleration = np.gradient(rate, interval)[own]
        rate, position, turned = rate[own], position[own], direction(turning)[own]
    else:
        reference = recording.reference_rate(axis)
        assert reference is not None
        rate = np.nan_to_num(reference[s.index])
        acceleration, turned = np.gradient(rate, interval), direction(rate)
        has_angle = f"{axis}_position_deg" in recording.columns
        position = _angle(recording, axis, s.time_s) if has_angle else np.cumsum(rate) * interval
    tilt = None
    if f"{axis}_position_deg" in recording.columns or other == "x":
        tilt = position if axis == "x" else (_angle(recording, "x", s.time_s) if other == "x" else None)
    other_rate = None
    if other is not None:
        other_rate = np.gradient(_smooth(_angle(recording, other, time), OTHER_S / interval), interval)[own]
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
        acceleration_dps2=acceleration,
        direction=turned,
        interval_s=interval,
        temperature_c=temperature,
        supply_v=supply,
        other_rate_dps=other_rate,
        tilt_deg=tilt,
        specific_force_g=force or None,
        reference=reference_values,
    )


def _bridged(s: Samples) -> tuple[F64, NDArray[np.int64]]:
    """(m,) times of the samples and of those that short gaps lack, and the places (k,) of the samples among them."""
    step = np.diff(s.time_s)
    gap = np.flatnonzero(s.start[1:] & (step < BRIDGED_S))
    lacking = np.round(step[gap] / s.interval_s).astype(np.int64) - 1
    begin = np.repeat(np.cumsum(lacking) - lacking, lacking)
    within = (np.arange(len(begin)) - begin + 1) * s.interval_s
    time = np.insert(s.time_s, np.repeat(gap + 1, lacking), np.repeat(s.time_s[gap], lacking) + within)
    count = np.zeros(len(s.time_s), np.int64)
    count[gap + 1] = lacking
    return time, np.arange(len(s.time_s)) + np.cumsum(count)


def encoder_rate(recording: Recording, axis: str, design: Design, smooth_s: float) -> F64:
    """(k,) the reference's rate at the gyro's samples, an encoder's smoothed over ``smooth_s``, without the gyro."""
    s = design.averages.samples
    reference = recording.reference_rate(axis)
    if reference is not None:
        return np.nan_to_num(reference[s.index])
    return np.gradient(_smooth(_angle(recording, axis, s.time_s), smooth_s / s.interval_s), s.interval_s)


def direction(rate_dps: F64) -> F64:
    """(n,) sign of the last rotation; 0 before the first that was plainly faster than the noise.

    It changes where the rate passed zero before it was that fast, after a rest where motion began (at rest the noise
    passes zero); the sample next to that moment has what a straight line through its neighbours needs for the step to
    be there.
    """
    bend = np.abs(np.diff(rate_dps, 3))
    # In rests the rate is zero without noise; means over three have third differences of twice their deviation.
    bend = bend[bend > 0.0]
    scatter = float(np.median(bend)) / (0.6745 * 2.0) if len(bend) else 0.0
    turning = float(np.clip(PLAIN * scatter, LEAST_DPS, TURNING_DPS))
    still = STILL * turning
    sign = np.where(rate_dps > turning, 1.0, np.where(rate_dps < -turning, -1.0, 0.0))
    turned = np.flatnonzero(sign)
    if len(turned) == 0:
        return sign
    last = np.searchsorted(turned, np.arange(len(sign)), side="right") - 1
    out = np.where(last >= 0, sign[turned[np.maximum(last, 0)]], 0.0)
    out[_began(np.abs(rate_dps), 0, int(turned[0]), still) : turned[0]] = sign[turned[0]]
    index = np.arange(len(sign))
    for now in (1.0, -1.0):
        towards = now * rate_dps
        slower = np.maximum.accumulate(np.where(towards <= 0.0, index, -1))
        for k in np.flatnonzero((out[1:] == now) & (out[:-1] == -now)) + 1:
            j, first = int(slower[k]), _began(towards, int(slower[k]) + 1, int(k), still)
            if np.abs(rate_dps[max(first - RESTED, 0) : first]).max(initial=0.0) < still:
                j, rise = first - 1, towards[min(first + 1, len(index) - 1)] - towards[first]
                share = 1.0 - min(towards[first] / rise, 1.0) if rise > 0.0 else 0.5
            else:
                share = towards[j] / (towards[j] - towards[j + 1]) if towards[j] else 0.5
            out[j + 1 : k] = now
            out[j if share < 0.5 else j + 1] += now * (1.0 - 2.0 * share)
    return out


def _began(rate_dps: F64, begin: int, end: int, still: float) -> int:
    """The first sample from ``begin`` to ``end`` that is faster than ``still``."""
    return begin + int(np.argmax(rate_dps[begin : end + 1] > still))


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
    whole = np.interp(np.arange(len(values)), known, values[known])
    smooth = _smooth(whole, COVARIATE_S / interval_s)
    # What smoothing took off slow swings is put back, smoothed: a thirtieth of one of 5 s is lost, not a fifth.
    return smooth + _smooth(whole - smooth, COVARIATE_S / interval_s)


def _smooth(values: F64, sigma: float) -> F64:
    """Gaussian mean, ``sigma`` in samples; ends are held."""
    if sigma < 0.3:
        return values
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(values, sigma, mode="nearest", truncate=4.0))
