"""The position test (thesis 5.1-5.9 on angles): the compensated gyro's integral against the encoder, rest to rest."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from calib_core import linearity
from calib_core.points import Points
from calib_core.rate_test import Readings
from calib_core.recording import Recording
from calib_core.sequence import PROFILES
from calib_core.strokes import F64, Strokes, filtered, find, integral_at

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
        type_b=float(np.hypot(np.hypot(encoder, drift), scale)),
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
    before, after, leave, arrive = rests(strokes)
    begin = strokes.start_s + SETTLED * np.maximum(leave - strokes.start_s, 0.0)
    end = strokes.stop_s
    area = integral_at(recording.time_s + gyro.delay_s, rate, np.concatenate([begin, end]))
    measured = area[len(strokes) :] - area[: len(strokes)]
    reference = after - before
    wanted = np.array([segment.set_point for segment in strokes.segments])
    kept = _keep(strokes, reference, wanted, leave, arrive, warnings)
    taken = [strokes.segments[i] for i in kept]
    # One draw of a step's uniform error at each rest (METHOD 2); the difference has both.
    u = strokes.step_deg / 12**0.5 * 2**0.5
    return Readings(
        Points(
            board=np.full(len(kept), recording.header.get("board", "")),
            axis=np.full(len(kept), axis),
            kind="position",
            test=np.array([segment.test for segment in taken], dtype=str),
            set_point=wanted[kept],
            reference=reference[kept],
            gyro=measured[kept],
            reading=np.array([segment.reading for segment in taken], dtype=np.int64),
            duration_s=(end - begin)[kept],
        ),
        np.full(len(kept), u),
        warnings,
    )


def rests(strokes: Strokes) -> tuple[F64, F64, F64, F64]:
    """(k,) the encoder at the rest before and after each move, the time the table leaves and the time it arrives."""
    time, of = strokes.time_s, strokes.of
    first, last = (
        np.isin(time, edge) for edge in (strokes.first(time, time == time), strokes.last(time, time == time))
    )
    tolerance = AT_REST_STEPS * strokes.step_deg
    start = strokes.mean(strokes.angle_deg, first)
    stop = strokes.mean(strokes.angle_deg, last)
    leave = strokes.first(time, np.abs(strokes.angle_deg - start[of]) > tolerance)
    arrive = strokes.last(time, np.abs(strokes.angle_deg - stop[of]) > tolerance)
    settled_from = strokes.stop_s - SETTLED * (strokes.stop_s - arrive)
    before = strokes.mean(strokes.angle_deg, time < leave[of])
    after = strokes.mean(strokes.angle_deg, time >= settled_from[of])
    return before, after, leave, arrive


def _keep(
    strokes: Strokes, angle: F64, wanted: F64, leave: F64, arrive: F64, warnings: list[dict[str, Any]]
) -> list[int]:
    """Which moves have a reading; says of the others why not, and of those kept what is odd about them."""
    kept = []
    for i in range(len(strokes)):
        values = {"measured": float(angle[i]), "least_s": LEAST_REST_S}
        before_s, after_s = float(leave[i] - strokes.start_s[i]), float(strokes.stop_s[i] - arrive[i])
        if strokes.holed[i]:
            warnings.append(strokes.warning("position_test.gyro_missing", i))
        elif not (np.isfinite(leave[i]) and np.isfinite(arrive[i])):
            warnings.append(strokes.warning("position_test.no_move", i))
        elif min(before_s, after_s) < LEAST_REST_S:
            values |= {"before_s": before_s, "after_s": after_s}
            warnings.append(strokes.warning("position_test.not_at_rest", i, **values))
        else:
            kept.append(i)
            if abs(angle[i] - wanted[i]) > OFF_TARGET_DEG:
                warnings.append(strokes.warning("position_test.off_target", i, **values))
    return kept
