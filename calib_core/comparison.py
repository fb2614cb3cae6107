"""The thesis' comparison pictures (4.17-4.18, 5.7-5.9): rate and angle of the gyro against the encoder, once with the
datasheet's bias and scale factor and once with the estimated ones."""

from typing import Any

import numpy as np
import numpy.typing as npt

from calib_core import session
from calib_core.adaptation import encoder_rate
from calib_core.gyro_models import GyroModel
from calib_core.recording import Recording

F64 = npt.NDArray[np.float64]
SPAN_S = 0.2
"""Both rates are means over this span: one encoder step is 1.5 deg/s then, and the gyro is averaged alike."""


def of_session(
    recording: Recording, axis: str, *, gyro_model: GyroModel | None = None, max_points: int = 2000
) -> dict[str, Any]:
    """The estimate motion of an axis as at most ``max_points`` of each curve, and RMS errors over all of it.

    {"axis", "state", "time_s", "encoder": {"rate_dps", "angle_deg"}, "estimated": {"rate_dps", "angle_deg",
    "rate_rms_dps", "angle_rms_deg", "bias_V", "scale_factor_V_per_dps"}, "datasheet": the same}; times from the start
    of the motion, None where there is no value. Raises Problem as session.analyse_state.
    """
    gyro_model = gyro_model or session.model_of(recording)
    profile = session.checked_profile(recording.header.get("profile") or "standard")
    state = f"estimate_{axis}"
    result = session.analyse_state(recording, state, profile=profile, gyro_model=gyro_model, estimates={})
    estimate, datasheet = session.Estimate.of(result), gyro_model.axes[axis]
    _, motion = session.motion_of(recording, axis)
    at = motion.time_s
    reading_s, angle = motion.position(axis)
    shown = np.linspace(0, len(at) - 1, min(max_points, len(at))).round().astype(int)
    encoder_dps = encoder_rate(reading_s, angle, at, SPAN_S)
    found: dict[str, Any] = {
        "axis": axis,
        "state": state,
        "time_s": _listed(at - at[0], shown),
        "encoder": {
            "rate_dps": _listed(encoder_dps, shown),
            "angle_deg": _listed(np.interp(at, reading_s, angle), shown),
        },
    }
    for name, bias, scale_factor in (
        ("estimated", estimate.bias_V, estimate.scale_factor_V_per_dps),
        ("datasheet", datasheet.bias_V, datasheet.scale_factor_V_per_dps),
    ):
        turned = _angle(motion, axis, bias, scale_factor)
        turned += angle[0] - np.interp(reading_s[0], at, turned)
        rate_dps = encoder_rate(at, turned, at, SPAN_S)
        found[name] = {
            "rate_dps": _listed(rate_dps, shown),
            "angle_deg": _listed(turned, shown),
            "rate_rms_dps": _rms(rate_dps - encoder_dps),
            "angle_rms_deg": _rms(np.interp(reading_s, at, turned) - angle),
            "bias_V": bias,
            "scale_factor_V_per_dps": scale_factor,
        }
    return found


def _angle(motion: Recording, axis: str, bias: float, scale_factor: float) -> F64:
    """(n,) integral of the compensated rate at the rows' times, deg, from 0; gaps are bridged by straight lines."""
    gyro = motion.gyro(axis)
    there = np.isfinite(gyro.values)
    rate = (np.interp(motion.time_s, motion.time_s[there] + gyro.delay_s, gyro.values[there]) - bias) / scale_factor
    return np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(motion.time_s))])


def _rms(error: F64) -> float:
    return float(np.sqrt(np.nanmean(error**2)))


def _listed(values: F64, shown: Any) -> list[float | None]:
    return [None if value != value else round(value, 6) for value in values[shown].tolist()]
