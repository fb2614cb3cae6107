"""The rate test (thesis 5.1-5.9): constant-rate strokes, the encoder's rate against the compensated gyro's."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from calib_core import linearity
from calib_core.adaptation import THESIS_SPAN_S
from calib_core.points import Points
from calib_core.recording import Recording
from calib_core.sequence import PROFILES
from calib_core.strokes import F64, Mask, Readings, Strokes, filtered, find, integral_at, run_lengths

FULL_SCALE_DPS = 200.0
LEAST_STEPS = 5
"""Encoder steps that a stroke has to cover before it counts as a turn."""
TRIM_S = 0.1
"""Left out at each end of the constant-rate stretch: the table's run-up and stop, where the encoder cannot see them."""
SHORTEST_S = 0.3
"""The least constant-rate stretch that is worth a slope."""
OFF_SPEED = 0.1
"""The table is told to be off when its measured rate differs from the set-point by this part of it and 1 deg/s."""


def points(recording: Recording, axis: str, bias: float, scale_factor: float, profile: str = "standard") -> Points:
    """The readings (n,) of a rate test on ``axis``; see ``readings``."""
    return readings(recording, axis, bias, scale_factor, profile).points


def run(
    recording: Recording,
    axis: str,
    *,
    bias: float,
    scale_factor: float,
    bias_u: float = 0.0,
    scale_factor_u: float = 0.0,
    profile: str = "standard",
    full_scale: float = FULL_SCALE_DPS,
    ci: float = linearity.CI,
) -> linearity.TestResult:
    """The whole rate test of a recording. ``full_scale`` is r0 in deg/s, twice the range; ``*_u`` are standard.

    Type B joins what all readings share: the encoder's step (2.22), the bias and the scale factor that compensate.
    """
    found = readings(recording, axis, bias, scale_factor, profile)
    encoder = float(found.reference_u.max(initial=0.0))
    scale = float(np.abs(found.points.reference).max(initial=0.0)) * scale_factor_u / scale_factor
    return linearity.evaluate(
        found.points,
        full_scale,
        kind="rate",
        type_b=math.hypot(encoder, bias_u / scale_factor, scale),
        ci=ci,
        expected=expected(profile, full_scale),
        warnings=found.warnings,
    )


def expected(profile: str, full_scale: float) -> Mapping[str, list[float]]:
    """The set-points that each half of the test should have, scaled with the range."""
    shape, scale = PROFILES[profile], full_scale / FULL_SCALE_DPS
    return {
        "linearity": [rate * scale for rate in shape.rate_linearity],
        "repeat": [rate * scale for rate in shape.rate_repeat],
    }


def readings(recording: Recording, axis: str, bias: float, scale_factor: float, profile: str = "standard") -> Readings:
    """Every stroke's rate by the encoder and by the gyro, compensated with bias and scale factor in the record's unit.

    standard  the slope of the encoder over the stroke's whole constant-rate stretch, codes weighted by how long they
              repeat, against the *same* weighted slope of the gyro's integral at the encoder's own times: a mean of
              the rate over exactly that span, so that what is not quite constant falls out of the comparison
    thesis    the encoder's 0.1 s difference at the middle of the stretch against the Kalman-filtered gyro there
    """
    strokes, warnings = find(recording, "rate", axis)
    gyro = recording.gyro(axis)
    gyro_time = recording.time_s + gyro.delay_s
    rate = (gyro.values - bias) / scale_factor
    constant = steady(strokes)
    weight = code_weight(strokes, constant)
    reference, middle, spread = strokes.slope(strokes.angle_deg, weight)
    begin, end = strokes.first(strokes.time_s, constant), strokes.last(strokes.time_s, constant)
    duration = np.where(np.isfinite(begin), end - begin, 0.0)
    kept = _keep(strokes, duration, reference, warnings)
    if profile == "thesis":
        reference, measured = _thesis(strokes, recording, axis, middle, gyro_time, rate)
        # Each end of the difference is off by up to half a step (2.22), independently.
        u = np.full(len(strokes), strokes.step_deg / 12**0.5 * 2**0.5 / THESIS_SPAN_S)
    else:
        measured, _, _ = strokes.slope(integral_at(gyro_time, rate, strokes.time_s), weight)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = strokes.step_deg / 12**0.5 / np.sqrt(spread)
    return strokes.readings("rate", kept, reference, measured, duration, u, warnings)


def steady(strokes: Strokes) -> Mask:
    """(m,) the encoder readings of each stroke's constant-rate stretch.

    A line through the middle of the way, extended both ways until the encoder leaves it for good.
    """
    angle, time = strokes.angle_deg, strokes.time_s
    everything = np.ones(len(angle), bool)
    low, high = strokes.first(angle, everything), strokes.last(angle, everything)
    with np.errstate(invalid="ignore"):
        travel = high - low
        part = (angle - low[strokes.of]) / np.maximum(travel, 1e-9)[strokes.of]
    moved = (travel >= LEAST_STEPS * strokes.step_deg) & (travel > 0.0)
    core = (np.abs(part - 0.5) < 0.2) & moved[strokes.of]
    slope, middle, _ = strokes.slope(angle, core.astype(float))
    line = strokes.mean(angle, core)[strokes.of] + slope[strokes.of] * (time - middle[strokes.of])
    tolerance = np.maximum(1.5 * strokes.step_deg, 0.005 * travel)[strokes.of]
    with np.errstate(invalid="ignore"):
        off = np.abs(angle - line) > tolerance
        left = np.maximum(strokes.last(time, off & (time < middle[strokes.of])), strokes.first(time, everything))
        right = np.minimum(strokes.first(time, off & (time > middle[strokes.of])), strokes.last(time, everything))
    inside = (time > left[strokes.of] + TRIM_S) & (time < right[strokes.of] - TRIM_S)
    constant: Mask = inside & moved[strokes.of]
    return constant


def code_weight(strokes: Strokes, where: Mask) -> F64:
    """(m,) weights of encoder readings for a slope, 0 outside ``where``: equal codes are not news (METHOD 2)."""
    return np.where(where, 1.0 / np.maximum(1.0, run_lengths(strokes.angle_deg, strokes.of) / 2.0), 0.0)


def _keep(strokes: Strokes, duration: F64, rate: F64, warnings: list[dict[str, Any]]) -> list[int]:
    """Which strokes have a reading; says of the others why not, and of those kept what is odd about them."""
    kept = []
    for i, segment in enumerate(strokes.segments):
        values = {"measured": float(rate[i]), "duration_s": float(duration[i]), "least_s": SHORTEST_S}
        if unusable := strokes.unusable(i):
            warnings.append(unusable)
        elif not duration[i] >= SHORTEST_S:
            warnings.append(strokes.warning("rate_test.no_constant_rate", i, **values))
        else:
            kept.append(i)
            if abs(rate[i] - segment.set_point) > OFF_SPEED * abs(segment.set_point) + 1.0:
                warnings.append(strokes.warning("rate_test.off_speed", i, **values))
            elif duration[i] < 0.5 * (strokes.stop_s[i] - strokes.start_s[i]):
                warnings.append(strokes.warning("rate_test.short_stretch", i, **values))
    return kept


def _thesis(strokes: Strokes, recording: Recording, axis: str, at_s: F64, gyro_time: F64, rate: F64) -> tuple[F64, F64]:
    """(k,) the encoder's differences over 0.1 s up to ``at_s`` (k,), and the filtered gyro there; NaN where at_s is.

    As in the thesis, all readings of a set-point have one reference: the median.
    """
    time, angle = recording.position(axis)
    there = np.isfinite(at_s)
    reference, measured = np.full((2, len(at_s)), np.nan)
    last = np.searchsorted(time, at_s[there])
    first = np.searchsorted(time, time[last] - THESIS_SPAN_S)
    reference[there] = (angle[last] - angle[first]) / (time[last] - time[first])
    measured[there] = np.interp(at_s[there], gyro_time, filtered(recording.time_s, rate))
    for same in {(segment.test, segment.set_point) for segment in strokes.segments}:
        of = np.array([(segment.test, segment.set_point) == same for segment in strokes.segments]) & there
        if of.any():
            reference[of] = np.median(reference[of])
    return reference, measured
