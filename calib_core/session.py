"""A recording of the six states becomes certified numbers: states -> estimates -> tests -> the axes of CONTRACT 3.

Live, stored, imported and batch recordings all come through here. What a run was asked for stands in the
recording's header (profile, ranges, gyro_model); everything else is measured.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_core import adaptation, allan, integral_fit, kalman, position_test, rate_test, rig_check
from calib_core.certificate import FIELDS
from calib_core.gyro_models import PRESETS, GyroModel, Ranges, ranges_from_json
from calib_core.kalman import F64
from calib_core.problem import Problem
from calib_core.recording import Recording, parse_segment
from calib_core.reference import AxisCalibration
from calib_core.sequence import PROFILES, STATES
from calib_core.uncertainty import Budget, Contribution

FILTERPY_LIMIT_V = 1e-9
CLOCK_ERROR = 5e-5
"""Half-width of the DAQ clock's relative error: angles are the servo's, so its seconds go straight into S."""
NOISE_GREW = 2.0
"""Noise density in motion over the one at rest past which a fixed gain is wrong (METHOD 1)."""
LEAST_REST = 50
"""Rows of a hold that tell its noise."""
LEAST_ANSWER = 0.1
"""A scale factor below this part of the datasheet's is a gyro that is not connected, not a bad one."""
# Real, and of unknown size on a rig without calibration records of its own: named, never guessed.
EXCLUDED = {
    "bias_V": ("daq_gain_offset", "temperature"),
    "scale_factor_V_per_dps": ("encoder_scale", "daq_gain_offset", "alignment", "temperature"),
}
Result = dict[str, Any]


@dataclass(frozen=True)
class Estimate:
    """What compensates the rate and position tests of one axis, with standard uncertainties."""

    bias_V: float
    scale_factor_V_per_dps: float
    bias_u: float
    scale_factor_u: float

    @classmethod
    def of(cls, result: Mapping[str, Any]) -> "Estimate":
        """From the result of an estimate state."""
        bias, scale_factor = result["bias_V"], result["scale_factor_V_per_dps"]
        return cls(
            bias["value"], scale_factor["value"], bias["standard_uncertainty"], scale_factor["standard_uncertainty"]
        )


@dataclass(frozen=True)
class Session:
    """What a recording certifies: ``axes`` as in CONTRACT 3, each state's whole result, warnings with their state."""

    axes: dict[str, Result]
    states: dict[str, Result]
    warnings: list[Result]
    profile: str
    gyro_model: GyroModel


def analyse(recording: Recording, *, gyro_model: GyroModel | None = None, profile: str | None = None) -> Session:
    """Everything a recording holds, of whichever of the six states it holds.

    Gyro model and profile are the header's unless given. Raises Problem: session.no_state, session.no_estimate, and
    those of the analyses themselves.
    """
    profile = checked_profile(profile or recording.header.get("profile") or "standard")
    gyro_model = gyro_model or model_of(recording)
    present = states_of(recording)
    if not present:
        raise Problem("session.no_state", states=", ".join(STATES))
    check_states(present)
    states: dict[str, Result] = {}
    for state in present:
        known = estimates_of(states)
        states[state] = analyse_state(recording, state, profile=profile, gyro_model=gyro_model, estimates=known)
    told = [{**warning, "state": name} for name, result in states.items() for warning in result["warnings"]]
    return Session(axes_of(states), states, told, profile, gyro_model)


def analyse_state(
    recording: Recording, state: str, *, profile: str, gyro_model: GyroModel, estimates: Mapping[str, Estimate]
) -> Result:
    """The result of one state, ready for JSON; ``recording`` is the whole session or only that state's rows."""
    kind, axis = state.split("_")
    unit = recording.gyro(axis).unit
    if unit != "V":
        raise Problem("session.unit", axis=axis, unit=unit)
    if axis not in gyro_model.axes:
        raise Problem("plan.axis", axis=axis, gyro_model=gyro_model.id, allowed=", ".join(gyro_model.axes))
    if kind == "estimate":
        return _estimate(recording, axis, profile, gyro_model)
    if axis not in estimates:
        raise Problem("session.no_estimate", axis=axis, state=state)
    estimate = estimates[axis]
    test = rate_test.run if kind == "rate" else position_test.run
    result = test(
        recording,
        axis,
        bias=estimate.bias_V,
        scale_factor=estimate.scale_factor_V_per_dps,
        bias_u=estimate.bias_u,
        scale_factor_u=estimate.scale_factor_u,
        profile=profile,
        full_scale=_full_scale(recording, state, gyro_model),
    )
    return _document({"state": state, "axis": axis, **result.to_json()})


def estimates_of(results: Mapping[str, Mapping[str, Any]]) -> dict[str, Estimate]:
    """By axis, from the results of states."""
    return {result["axis"]: Estimate.of(result) for name, result in results.items() if name.startswith("estimate")}


def axes_of(states: Mapping[str, Result]) -> dict[str, Result]:
    """The certified numbers of each axis, those of FIELDS, from the results of its states."""
    axes: dict[str, Result] = {}
    for name, result in states.items():
        kind = name.split("_")[0]
        tree = {kind: result} if kind != "estimate" else result
        figures = axes.setdefault(result["axis"], {})
        for field in FIELDS:
            if field.of(tree) is not None:
                _copy(tree, field.path, figures)
    return axes


def states_of(recording: Recording) -> list[str]:
    """Which of the six states a recording holds, in their order."""
    found = set()
    for code in np.unique(recording.segment_codes):
        name = recording.segment_names[code]
        segment = parse_segment(name)
        found.add(segment.state if segment else name)
    return [state for state in STATES if state in found]


def check_states(states: Iterable[str], estimated: Iterable[str] = ()) -> None:
    """Raises Problem where a test would have no estimate of its axis to compensate with."""
    known = set(estimated)
    for state in sorted(states, key=STATES.index):
        kind, axis = state.split("_")
        if kind == "estimate":
            known.add(axis)
        elif axis not in known:
            raise Problem("session.no_estimate", axis=axis, state=state)


def checked_profile(profile: str) -> str:
    if profile not in PROFILES:
        raise Problem("plan.profile", given=profile, allowed=", ".join(PROFILES))
    return profile


def model_of(recording: Recording) -> GyroModel:
    """The gyro model in the header, else the preset it names, else the thesis' own."""
    given = recording.header.get("gyro_model", "")
    if given.startswith("{"):
        return GyroModel.from_json(_json_header(recording, "gyro_model"))
    return PRESETS.get(given, PRESETS["LPY503AL-OUT"])


# --- estimate states ---------------------------------------------------------------------------------------------
def _estimate(recording: Recording, axis: str, profile: str, gyro_model: GyroModel) -> Result:
    """Integral fit and adaptive estimate of the last ``estimate_<axis>``, with the hold before it."""
    whole, motion = motion_of(recording, axis)
    fit = integral_fit.fit(whole, axis)
    _check_answer(fit, axis, gyro_model)
    datasheet = gyro_model.axes[axis]
    interval_s = float(np.median(np.diff(motion.time_s)))
    v = motion.gyro(axis)
    moving = kalman.noise_density(v.values, interval_s)
    hold = whole.gyro(axis).values[: len(whole) - len(motion)]
    rest = kalman.noise_density(hold, interval_s) if np.isfinite(hold).sum() > LEAST_REST else moving
    adaptive = adaptation.estimate(
        motion.time_s + v.delay_s,
        v.values,
        *motion.position(axis),
        form="thesis" if profile == "thesis" else "matched",
        frequency_hz=PROFILES[profile].sine_hz,
        start=(datasheet.bias_V, datasheet.scale_factor_V_per_dps),
        rest_density=rest or moving,
    )
    difference_V = kalman.filterpy_difference(v.values[:1000], interval_s, adaptive.gain)
    bias, scale_factor = _budgets(fit, adaptive, profile, recording.reference_calibration(axis))
    step, warnings = _step_check(recording, axis, profile, gyro_model)
    warnings += [dict(warning) for warning in fit.warnings]
    if not difference_V <= FILTERPY_LIMIT_V:
        values = {"difference_V": difference_V, "limit_V": FILTERPY_LIMIT_V}
        warnings.append({"code": "session.filterpy", "values": values})
    if moving > NOISE_GREW * rest > 0:
        warnings.append({"code": "session.noise_grew", "values": {"ratio": moving / rest}})
    if fit.scale_factor * datasheet.scale_factor_V_per_dps < 0:
        warnings.append({"code": "session.reversed", "values": {"axis": axis}})
    return _document(
        {
            "state": f"estimate_{axis}",
            "axis": axis,
            "bias_V": _measured(bias),
            "scale_factor_V_per_dps": _measured(scale_factor),
            "adaptive": {
                "bias_V": adaptive.bias_V,
                "scale_factor_V_per_dps": adaptive.scale_factor_V_per_dps,
                "form": adaptive.form,
            },
            "integral_fit": {"bias_V": fit.bias, "scale_factor_V_per_dps": fit.scale_factor},
            "datasheet": {
                "bias_V": datasheet.bias_V,
                "scale_factor_V_per_dps": datasheet.scale_factor_V_per_dps,
                "bias_difference_pct": _difference_pct(bias.value, datasheet.bias_V),
                "scale_factor_difference_pct": _difference_pct(scale_factor.value, datasheet.scale_factor_V_per_dps),
            },
            "delay_s": _delay(fit),
            "noise": {name: fit.noise[name] for name in ("white_dps", "correlation_time_s")},
            "still": _still(hold / fit.scale_factor, 1.0 / interval_s),
            "chi2_per_row": fit.chi2 / fit.rows,
            "kalman": {
                "k1": adaptive.gain.k1,
                "k2": adaptive.gain.k2,
                "whiteness_p": adaptive.whiteness.p,
                "noise_ratio": moving / rest if rest else None,
                "variance_ratio": adaptive.whiteness.variance_ratio,
                "filterpy_difference": difference_V,
            },
            "step_check": step,
            "budget": {"bias": bias.to_json(), "scale_factor": scale_factor.to_json()},
            "warnings": warnings,
        }
    )


def _still(rate_dps: F64, rate_hz: float) -> dict[str, Any] | None:
    """Allan deviation of the hold before the motion, and the angle random walk it shows; None where it has gaps."""
    if len(rate_dps) < allan.LEAST or not np.isfinite(rate_dps).all():
        return None
    measured, walk = allan.deviation(rate_dps, rate_hz), allan.terms(rate_dps, rate_hz).angle_random_walk
    return {
        "tau_s": measured.tau_s.tolist(),
        "deviation_dps": measured.deviation.tolist(),
        "standard_uncertainty_dps": measured.standard_uncertainty.tolist(),
        # 60: from deg/s/√Hz to deg/√h, as datasheets print it.
        "angle_random_walk_deg_per_sqrt_h": 60.0 * walk.value if walk.seen else None,
        "angle_random_walk_standard_uncertainty": 60.0 * walk.standard_uncertainty,
    }


def motion_of(recording: Recording, axis: str) -> tuple[Recording, Recording]:
    """The last ``estimate_<axis>`` with the hold before it, and without."""
    runs = recording.runs()
    last = max((i for i, run in enumerate(runs) if run.name == f"estimate_{axis}"), default=None)
    if last is None:
        raise Problem("session.no_motion", axis=axis)
    start = runs[last - 1].start if last and runs[last - 1].name in ("hold", "rest") else runs[last].start
    return recording.take(slice(start, runs[last].stop)), recording.take(runs[last].rows)


def _check_answer(fit: integral_fit.Fit, axis: str, gyro_model: GyroModel) -> None:
    """A floating DAQ input looks like a gyro at rest (HARDWARE): the output has to have followed the table."""
    promised = abs(gyro_model.axes[axis].scale_factor_V_per_dps)
    if not abs(fit.scale_factor) >= LEAST_ANSWER * promised:
        found = 0.0 if math.isnan(fit.scale_factor) else abs(fit.scale_factor)
        raise Problem("session.no_answer", axis=axis, found=1e3 * found, datasheet=1e3 * promised)


def _budgets(
    fit: integral_fit.Fit, adaptive: adaptation.Adaptive, profile: str, encoder: AxisCalibration | None
) -> tuple[Budget, Budget]:
    """GUM budgets of the certified bias and scale factor.

    The thesis' estimator is certified as it is; what it is off by, seen beside the integral fit of the same rows, is
    its uncertainty (a known bias that is not corrected, GUM F.2.4.5).
    """

    def budget(name: str, fitted: float, adapted: float, *more: Contribution) -> Budget:
        sources = (*fit.contributions(name), *more)
        excluded = tuple(source for source in EXCLUDED[name] if source not in {known.name for known in sources})
        if profile != "thesis":
            return Budget(fitted, sources, excluded)
        return Budget(adapted, (*sources, Contribution("estimator", abs(adapted - fitted))), excluded)

    gains = [Contribution("clock", CLOCK_ERROR, distribution="uniform", sensitivity=fit.scale_factor)]
    if encoder is not None:
        gains.append(Contribution("encoder_scale", encoder.scale_uncertainty, sensitivity=fit.scale_factor))
    return (
        budget("bias_V", fit.bias, adaptive.bias_V),
        budget("scale_factor_V_per_dps", fit.scale_factor, adaptive.scale_factor_V_per_dps, *gains),
    )


def _step_check(
    recording: Recording, axis: str, profile: str, gyro_model: GyroModel
) -> tuple[Result | None, list[Result]]:
    """The table's own check, where the recording has it. It says nothing about the gyro, so it only warns."""
    ranges = _ranges(recording, axis, gyro_model)
    # As the plan asks for it: slower where the set-points are, and inside the sensor's range.
    asked_dps = PROFILES[profile].step_dps * min(ranges.rate_dps / Ranges().rate_dps, 1.0)
    try:
        step = rig_check.step(recording, axis, ranges.position_deg, min(asked_dps, gyro_model.axes[axis].range_dps))
    except Problem as problem:
        return None, [{"code": problem.code, "values": problem.values}]
    return dict(step.to_json()) if step else None, []


def _measured(budget: Budget) -> Result:
    return {
        "value": budget.value,
        "standard_uncertainty": budget.standard_uncertainty,
        "expanded_uncertainty": budget.expanded_uncertainty(),
        "coverage_factor": budget.coverage_factor(),
    }


def _delay(fit: integral_fit.Fit) -> Result | None:
    if math.isnan(fit.delay_s):
        return None
    u = fit.delay_uncertainty_s
    return {"value": fit.delay_s, "standard_uncertainty": u, "expanded_uncertainty": 1.96 * u}


def _difference_pct(value: float, promised: float) -> float | None:
    return 100.0 * (value / promised - 1.0) if promised else None


# --- odds and ends -------------------------------------------------------------------------------------------------
def _full_scale(recording: Recording, state: str, gyro_model: GyroModel) -> float:
    """r0, the span: twice the range that the header says the plan used, else twice the largest set-point there is."""
    kind, axis = state.split("_")
    if "ranges" in recording.header:
        ranges = _ranges(recording, axis, gyro_model)
        return 2.0 * (ranges.rate_dps if kind == "rate" else ranges.position_deg)
    segments = [segment for segment in map(parse_segment, recording.segment_names) if segment]
    return 2.0 * max(abs(segment.set_point) for segment in segments if segment.state == state)


def _ranges(recording: Recording, axis: str, gyro_model: GyroModel) -> Ranges:
    """What the plan used, by the header; else the gyro model's."""
    given = _json_header(recording, "ranges").get(axis) if "ranges" in recording.header else None
    return ranges_from_json(given, gyro_model.ranges[axis])


def _json_header(recording: Recording, key: str) -> Mapping[str, Any]:
    try:
        given = json.loads(recording.header[key])
    except ValueError:
        given = None
    if not isinstance(given, dict):
        raise Problem("session.header", key=key)
    return given


def _copy(tree: Mapping[str, Any], path: Sequence[str], to: Result) -> None:
    *parents, last = path
    for key in parents:
        tree, to = tree[key], to.setdefault(key, {})
    to[last] = tree[last]


def _document(result: Mapping[str, Any]) -> Result:
    return {key: _plain(value) for key, value in result.items()}


def _plain(node: Any) -> Any:
    """The same tree as JSON has it: Python numbers, and null where a number is not finite."""
    if isinstance(node, Mapping):
        return {key: _plain(child) for key, child in node.items()}
    if isinstance(node, list | tuple | np.ndarray):
        return [_plain(child) for child in node]
    if isinstance(node, np.generic):
        node = node.item()
    return None if isinstance(node, float) and not math.isfinite(node) else node
