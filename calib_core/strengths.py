"""How strong a hidden effect is: METHOD 2's scale in physical parameters, and what a surprise may hold.

Strength 1 is what METHOD 2 gives for S = 5.9 mV/(deg/s) and 1.2 mV of noise: there 0.6 is plain to see in a residual
plot made right, and 0.1 is not.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np

from calib_core.problem import Problem

Values = dict[str, float]
Rng = np.random.Generator

STRONGEST = 5.0
DIFFICULTIES: Mapping[str, tuple[float, float, tuple[float, ...]]] = {
    "easy": (1.6, 2.4, (0.0, 1.0)),
    "medium": (0.8, 1.2, (1 / 6, 5 / 6)),
    "hard": (0.3, 0.5, (1 / 6, 1 / 2, 1 / 3)),
}
"""Least and greatest strength, and how likely nothing, one and two effects are."""
KIN = (
    {"bandwidth_lag", "time_offset", "angular_acceleration", "clock_skew"},
    {"bias_temperature", "thermal_lag"},
    {"warm_up", "bias_drift", "bias_step", "bias_random_walk"},
    {"scale_factor_quadratic", "scale_factor_asymmetry"},
    {"scale_factor_cubic", "saturation"},
    {"hysteresis", "backlash", "dead_band"},
    {"g_sensitivity", "g_squared_sensitivity", "encoder_eccentricity", "encoder_nonlinearity"},
)
"""Effects that pass for each other: no surprise hides two of one family."""


def _signed(name: str, size: float) -> Callable[[float, Rng], Values]:
    return lambda strength, rng: {name: float(rng.choice([-1.0, 1.0])) * size * strength}


def _positive(name: str, size: float) -> Callable[[float, Rng], Values]:
    return lambda strength, _: {name: size * strength}


def _turned(first: str, second: str, size: float) -> Callable[[float, Rng], Values]:
    """A sine of this size with any phase, as its two parts."""

    def draw(strength: float, rng: Rng) -> Values:
        phase = rng.uniform(0.0, 2.0 * math.pi)
        return {first: size * strength * math.cos(phase), second: size * strength * math.sin(phase)}

    return draw


def _with(draw: Callable[[float, Rng], Values], name: str, low: float, high: float) -> Callable[[float, Rng], Values]:
    return lambda strength, rng: draw(strength, rng) | {name: float(rng.uniform(low, high))}


def _potentiometer(strength: float, rng: Rng) -> Values:
    """As much as 0.4° at 120° by each of its terms."""
    signs = rng.choice([-1.0, 1.0], 2)
    return {"k2": float(signs[0]) * 0.4 * strength / 120.0**2, "k3": float(signs[1]) * 0.4 * strength / 120.0**3}


SCALE: Mapping[str, Callable[[float, Rng], Values]] = {
    "adc_quantization": _positive("step", 9.77e-3),
    "angular_acceleration": _signed("k", 6e-3),
    "backlash": _positive("b", 0.5),
    "bandwidth_lag": _positive("tau", 6e-3),
    "bias_drift": _signed("r", 8e-6),
    "bias_random_walk": _positive("k", 3e-4),
    "bias_step": _with(_signed("a", 1.2e-3), "t1", 30.0, 90.0),
    "bias_temperature": _signed("k1", 2.5e-4),
    "clock_skew": _signed("skew", 8e-5),
    "cross_axis": _signed("k", 8e-3),
    "dead_band": _positive("d", 2.0),
    "encoder_eccentricity": _turned("a", "b", 0.5),
    "encoder_nonlinearity": _potentiometer,
    "g_sensitivity": _turned("k_s", "k_c", 8e-4),
    "g_squared_sensitivity": _turned("k_s", "k_c", 8e-4),
    "hysteresis": _signed("h", 6e-4),
    "mains_hum": _with(_turned("A", "B", 1.1e-3), "f", 49.8, 50.2),
    "saturation": lambda strength, _: {"clip_dps": 100.0 - 12.0 * strength},
    "scale_factor_asymmetry": _signed("k", 4e-3),
    "scale_factor_cubic": _signed("k", 1.2e-6),
    "scale_factor_quadratic": _signed("k", 6e-5),
    "scale_factor_temperature": _signed("k", 8e-4),
    "thermal_lag": _with(_signed("k", 4e-4), "tau", 15.0, 40.0),
    "time_offset": _positive("delay", 6e-3),
    "warm_up": _with(_signed("a", 4.5e-3), "tau", 20.0, 60.0),
}
"""Every effect that a simulated bench can hide. Its supply stands still, and a loaded input hides in bias and scale
factor, so those two are not here."""
SURPRISES = tuple(name for name in SCALE if name not in ("adc_quantization", "bias_random_walk", "clock_skew"))
"""What a surprise is drawn from: effects with a shape that minutes on the bench can show."""


def parameters(name: str, strength: float, rng: Rng, *, bias: float, scale_factor: float) -> Values:
    """The parameters of an effect of this strength on a gyro with this bias (V) and scale factor (V per deg/s).

    Signs, phases and time constants are drawn. Raises Problem for an effect that a simulated bench cannot hide.
    """
    if name not in SCALE:
        raise Problem("effects.not_hidden", given=name, allowed=", ".join(SCALE))
    values = SCALE[name](strength, rng)
    if "clip_dps" in values:
        reach = abs(scale_factor) * values["clip_dps"]
        values = {"V_lo": bias - reach, "V_hi": bias + reach}
    return values


def checked(name: str, values: Mapping[str, float]) -> Values:
    """Parameters as a person gave them. Raises Problem for an effect, a parameter or a size that cannot be."""
    if name not in SCALE:
        raise Problem("effects.not_hidden", given=name, allowed=", ".join(SCALE))
    from calib_core.effects import library

    known = library()[name].parameters()
    for parameter, value in values.items():
        if parameter not in known:
            raise Problem("effects.parameter", given=parameter, effect=name, allowed=", ".join(known))
        low, high = known[parameter].bounds
        low = max(low, 0.0) if name == "time_offset" else low  # a simulated gyro cannot answer before it moves
        if not low <= value <= high:
            raise Problem("effects.value", given=f"{name}.{parameter}:{value:g}", lowest=low, highest=high)
    return dict(values)


def surprise(difficulty: str, rng: Rng) -> dict[str, float]:
    """None, one or two effects with their strengths."""
    low, high, odds = DIFFICULTIES[difficulty]
    names: list[str] = []
    for _ in range(int(rng.choice(len(odds), p=odds))):
        taken = {name for kin in KIN if kin & {*names} for name in kin} | {*names}
        names.append(str(rng.choice([name for name in SURPRISES if name not in taken])))
    return {name: float(rng.uniform(low, high)) for name in names}
