"""What a motion would add to the data in hand: its path imagined, its rows, and effects' columns over them.

The imagined record goes the same way as a real one (rows, covariates, whitening), with the bias, scale factor and noise
of the record in hand, so that all that METHOD 2 knows of codes and noise weighs here too. Records share no error, so
their whitened rows may be put below each other.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core import covariates
from calib_core.effects.base import Acts, Covariates, Effect
from calib_core.effects.clock_skew import ClockSkew
from calib_core.effects.saturation import Saturation
from calib_core.excitation import Excitation, commanded, steps, warming
from calib_core.gap_space import Space, Term
from calib_core.integral_fit import Design
from calib_core.noise_fit import NoiseFit
from calib_core.recording import Recording

F64 = NDArray[np.float64]

FINE_HZ, ROW_HZ = 1000.0, 100.0
SERVO_LAG_S = 0.045
"""How far a servo runs behind its goal (twin_servo); it also rounds fast sines off."""
PAUSE_S = 1.0
"""Between the data in hand and the motion, where nothing else is known."""
ENCODER_DEG = 300.0 / 1023.0


@dataclass(frozen=True, eq=False)
class Hand:
    """The data in hand: its record, its space, and the terms that are in the model whatever comes."""

    recording: Recording
    space: Space
    kept: tuple[Term, ...] = ()

    @property
    def axis(self) -> str:
        return self.space.covariates.axis

    @property
    def end_s(self) -> float:
        return float(self.space.covariates.time_s[-1])


@dataclass(eq=False)
class Prospect(Space):
    """The space of an imagined record that goes on where the data in hand end. Its noise is known."""

    before: Covariates
    known: NoiseFit

    def __post_init__(self) -> None:
        values = self.values
        super().__post_init__()
        self.values = values
        if not self.design.moves:  # a motion that never turns still knows the scale factor
            self.base = np.column_stack([self.base, np.zeros((len(self.base), len(values) - 1))])
            self.prior = np.zeros(len(values))
        self.use_noise(self.known)

    def refit_noise(self, terms: object) -> None:  # noqa: ARG002
        """The noise is that of the data in hand."""
        self.use_noise(self.known)

    def _shapes(self, effect: type[Effect], setting: Sequence[float]) -> tuple[tuple[str, ...], Acts, F64]:
        """Shapes of effects that remember (time, direction, a slow temperature) begin in the data in hand."""
        own, k = self.covariates, len(self.covariates.time_s)
        if effect is Saturation:
            return _clipped(self, setting)
        if effect.curvature is not None:
            return super()._shapes(effect, setting)
        self.covariates = _joined(self.before, own)
        names, acts, shapes = super()._shapes(effect, setting)
        self.covariates = own
        return names, acts, shapes[-k:]

    def _retimed(self, skew: float) -> tuple[Acts, F64]:  # noqa: ARG002
        """To first order: what is imagined is known no better."""
        change = ClockSkew.columns(self.covariates)["skew"]
        return Acts.RATE, np.column_stack([np.zeros_like(change), change])


def clipping(space: Space, setting: Sequence[float]) -> Term:
    """What limits (low, high) take from the output that the base predicts, as a term of known size."""
    names, acts, shapes = _clipped(space, setting)
    return Term(Saturation, tuple(setting), names, space.over_rows(acts, shapes), slack=np.zeros(1))


def _clipped(space: Space, setting: Sequence[float]) -> tuple[tuple[str, ...], Acts, F64]:
    output = space.values[0] + space.scale_factor * space.covariates.rate_dps
    low, high = setting
    return ("",), Acts.OUTPUT, (np.clip(output, low, high) - output)[:, None]


def imagine(hand: Hand, motion: Sequence[Excitation], values: F64) -> Prospect:
    """The space of ``motion`` done after the data in hand, for bias and scale factor ``values`` (2,)."""
    recording = _record(hand, motion, values)
    design = Design.of(recording, hand.axis)
    c = covariates.of(recording, hand.axis, design, *values.tolist())
    c = replace(c, time_s=c.time_s + hand.end_s + PAUSE_S, reference=hand.space.covariates.reference)
    known = hand.space.noise
    return Prospect(design, c, values, before=hand.space.covariates, known=known)


def _record(hand: Hand, motion: Sequence[Excitation], values: F64) -> Recording:
    """The imagined record, with the columns that the data in hand have, and gyro noise."""
    axis, c = hand.axis, hand.space.covariates
    plan = steps(motion, "")
    true = {name: _followed(angle) for name, angle in commanded(plan, FINE_HZ).items()}
    per_row = round(FINE_HZ / ROW_HZ)
    rows = slice(per_row // 2, None, per_row)
    rate = np.gradient(true[axis], 1.0 / FINE_HZ)
    n = len(rate[rows])
    time = np.asarray((np.arange(n) + 0.5) / ROW_HZ, float)
    rng = np.random.default_rng(0)
    noise = hand.space.noise.noise
    output = rate[rows] if not hand.recording.header.get("gyro_average_s") else rate.reshape(-1, per_row).mean(axis=1)
    unit = {"V": "v", "deg/s": "dps", "counts": "counts"}[hand.space.design.averages.samples.unit]
    columns = {f"{axis}_gyro_{unit}": values[0] + values[1] * output + noise.white * rng.standard_normal(n)}
    readings = hand.space.design.readings
    step = readings.step_deg if readings is not None else ENCODER_DEG
    for name, angle in true.items():
        if f"{name}_position_deg" in hand.recording.columns or hand.recording.stationary:
            columns[f"{name}_position_deg"] = np.round(angle[rows] / step) * step if step else angle[rows]
    if readings is None and not hand.recording.stationary:
        columns[f"{axis}_rate_dps"] = rate[rows]
    after = time + PAUSE_S
    if c.temperature_c is not None:
        # What the room does, goes on; a heater comes on top.
        slope = float(np.polyfit(c.time_s, c.temperature_c, 1)[0])
        columns["temperature_c"] = c.temperature_c[-1] + slope * after + warming(plan, FINE_HZ)[rows]
    if c.supply_v is not None:
        columns["supply_v"] = np.full(n, c.supply_v[-1])
    if c.specific_force_g is not None:
        columns |= _gravity(c, true["x"][rows])
    header = {k: v for k, v in hand.recording.header.items() if k in ("reference", "gyro_average_s")}
    if header.get("reference") == "stationary":
        header = {}
    return Recording(time, columns, np.zeros(n, np.int32), ("experiment",), header)


def _followed(angle: F64) -> F64:
    """The shaft that a critically damped servo turns when it is sent to ``angle`` (n,)."""
    from scipy.signal import lfilter

    pole = math.exp(-2.0 / (SERVO_LAG_S * FINE_HZ))
    for _ in range(2):
        angle, _ = lfilter([1.0 - pole], [1.0, -pole], angle, zi=np.array([pole * angle[0]]))
    return np.asarray(angle)


def _gravity(c: Covariates, tilt_deg: F64) -> dict[str, F64]:
    """The specific force measured last, turned about x."""
    force = {a: float(values[-1]) for a, values in (c.specific_force_g or {}).items()}
    s, k = np.sin(np.radians(tilt_deg)), np.cos(np.radians(tilt_deg))
    y, z = force.get("y", 0.0), force.get("z", 0.0)
    turned = {"x": np.full(len(s), force.get("x", 0.0)), "y": k * y + s * z, "z": k * z - s * y}
    return {f"{a}_acceleration_g": turned[a] for a in force}


def _joined(first: Covariates, second: Covariates) -> Covariates:
    """One after the other; what only one of them knows, neither does."""
    joined: dict[str, Any] = {}
    for f in fields(Covariates):
        a, b = getattr(first, f.name), getattr(second, f.name)
        if isinstance(a, np.ndarray):
            joined[f.name] = None if b is None else np.concatenate([a, b])
    forces = None
    if first.specific_force_g and second.specific_force_g:
        both = first.specific_force_g.keys() & second.specific_force_g.keys()
        forces = {a: np.concatenate([first.specific_force_g[a], second.specific_force_g[a]]) for a in sorted(both)}
    return replace(first, **joined, specific_force_g=forces, memory={})
