"""The position test (thesis 5.1-5.9 on angles): the compensated gyro's integral against the encoder, rest to rest."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_core import linearity
from calib_core.points import Points
from calib_core.recording import Recording
from calib_core.sequence import PROFILES
from calib_core.strokes import F64, Readings, Strokes, filtered, find, integral_at

FULL_SCALE_DEG = 240.0
AT_REST_STEPS = 1.5
"""A rest may flicker between two codes; further from its level the table is moving."""
SETTLED = 0.5
"""The part of a rest nearest the move that is left out: the servo still creeps there, by less than a code."""
LEAST_REST_S = 0.05
OFF_TARGET_DEG = 2.0


def points(recording: Recording, axis: str, bias: float, scale_factor: float, profile: str = "standard") -> Points:
    """The readings (n,) of a position test on ``axis``; see ``readings``."""
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
    full_scale: float = FULL_SCALE_DEG,
    ci: float = linearity.CI,
) -> linearity.TestResult:
    """The whole position test of a recording. ``full_scale`` is r0 in deg, twice the range; ``*_u`` are standard.

    Type B is what more repeats cannot average away: the encoder at the two rests (one draw each, however often the
    table returns there), the bias, which the integral turns into bias_u * time, and the scale factor.
    """
    found = readings(recording, axis, bias, scale_factor, profile)
    drift = float(found.points.duration_s.max(initial=0.0)) * bias_u / scale_factor
    scale = float(np.abs(found.points.reference).max(initial=0.0)) * scale_factor_u / scale_factor
    encoder = float(found.reference_u.max(initial=0.0))
    return linearity.evaluate(
        found.points,
        full_scale,
        kind="position",
        type_b=math.hypot(encoder, drift, scale),
        ci=ci,
        expected=expected(profile, full_scale),
        warnings=found.warnings,
    )


def expected(profile: str, full_scale: float) -> Mapping[str, list[float]]:
    """The set-points that each half of the test should have, scaled with the range."""
    shape, scale = PROFILES[profile], full_scale / FULL_SCALE_DEG
    return {
        "linearity": [angle * scale for angle in shape.position_linearity],
        "repeat": [angle * scale for angle in shape.position_repeat],
    }


def readings(recording: Recording, axis: str, bias: float, scale_factor: float, profile: str = "standard") -> Readings:
    """Every move's angle by the encoder and by the gyro, compensated with bias and scale factor in the record's unit.

    Each rest is collapsed to one encoder reading; the integral runs from within the rest at 0 to within the rest at
    the set-point. ``duration_s`` is the time it runs. Profile thesis integrates the Kalman-filtered gyro.
    """
    strokes, warnings = find(recording, "position", axis)
    gyro = recording.gyro(axis)
    rate = (gyro.values - bias) / scale_factor
    if profile == "thesis":
        # The filter starts each reading from rest: the way back would still be in it.
        inside = recording.where(lambda name: name.startswith(f"position_{axis}/"))
        rate = filtered(recording.time_s, np.where(inside, rate, 0.0))
    rest = rests(strokes)
    with np.errstate(invalid="ignore"):  # infinite where there was no reading
        begin = rest.from_s + SETTLED * (rest.leave_s - rest.from_s)
    area = integral_at(recording.time_s + gyro.delay_s, rate, np.concatenate([begin, rest.until_s]))
    measured = area[len(strokes) :] - area[: len(strokes)]
    reference = rest.after_deg - rest.before_deg
    kept = _keep(strokes, reference, rest, warnings)
    # One draw of a step's uniform error at each rest (METHOD 2); the difference has both.
    u = np.full(len(strokes), strokes.step_deg / 12**0.5 * 2**0.5)
    return strokes.readings("position", kept, reference, measured, rest.until_s - begin, u, warnings)


@dataclass(frozen=True, eq=False)
class Rests:
    """Each move's (k,) rests as the encoder saw them: their levels, and when the table left and arrived.

    ``from_s`` and ``until_s`` are the encoder's first and last reading; NaN or inf where there is no move.
    """

    before_deg: F64
    after_deg: F64
    from_s: F64
    leave_s: F64
    arrive_s: F64
    until_s: F64


def rests(strokes: Strokes) -> Rests:
    """The rests before and after each move, each collapsed to one level."""
    time, angle, of = strokes.time_s, strokes.angle_deg, strokes.of
    everything = np.ones(len(time), bool)
    from_s, until_s = strokes.first(time, everything), strokes.last(time, everything)
    start, stop = (strokes.mean(angle, time == edge[of]) for edge in (from_s, until_s))
    tolerance = AT_REST_STEPS * strokes.step_deg
    leave = strokes.first(time, np.abs(angle - start[of]) > tolerance)
    arrive = strokes.last(time, np.abs(angle - stop[of]) > tolerance)
    with np.errstate(invalid="ignore"):
        settled = until_s - SETTLED * (until_s - arrive)
    before, after = strokes.mean(angle, time < leave[of]), strokes.mean(angle, time >= settled[of])
    return Rests(before, after, from_s, leave, arrive, until_s)


def _keep(strokes: Strokes, angle: F64, rest: Rests, warnings: list[dict[str, Any]]) -> list[int]:
    """Which moves have a reading; says of the others why not, and of those kept what is odd about them."""
    kept = []
    for i, segment in enumerate(strokes.segments):
        before_s = float(rest.leave_s[i]) - float(rest.from_s[i])
        after_s = float(rest.until_s[i]) - float(rest.arrive_s[i])
        values = {"before_s": before_s, "after_s": after_s, "least_s": LEAST_REST_S}
        if unusable := strokes.unusable(i):
            warnings.append(unusable)
        elif not np.isfinite(rest.leave_s[i]):
            warnings.append(strokes.warning("position_test.no_move", i))
        elif min(before_s, after_s) < LEAST_REST_S:
            warnings.append(strokes.warning("position_test.not_at_rest", i, **values))
        else:
            kept.append(i)
            if abs(angle[i] - segment.set_point) > OFF_TARGET_DEG:
                warnings.append(strokes.warning("position_test.off_target", i, measured=float(angle[i])))
    return kept
