"""Recordings with a known hidden effect, for judging the diagnosis.

Written apart from ``calib_core``: the motion, the physics, the noise and the encoder below share no line with the
library, so that what the diagnosis recovers is not its own arithmetic. Strengths follow METHOD 2's scale, on which 0.6
is plain to see in a residual plot made right and 0.1 is not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

FINE_HZ = 1000
ROW_HZ = 100
ENCODER_STEP_DEG = 300.0 / 1023.0
ADC_STEP_V = 5.0 / 4096.0
SCALE_FACTOR = 0.0059


@dataclass(frozen=True)
class Motion:
    """True rates of both axes at 1 kHz, deg/s, and what the table was doing."""

    rate_dps: dict[str, F64]
    segments: list[tuple[str, int]]


@dataclass(frozen=True)
class Record:
    """Columns of a ``gyro-recording 1`` and the truth behind them.

    ``gyro_noise_dps`` is the output less what it would be without noise, ``encoder_error_deg`` the encoder's rounding.
    """

    columns: dict[str, F64]
    segments: list[str]
    truth: dict[str, object] = field(default_factory=dict)
    gyro_noise_dps: F64 = field(default_factory=lambda: np.empty(0))
    encoder_error_deg: F64 = field(default_factory=lambda: np.empty(0))
    clipped: Mask = field(default_factory=lambda: np.empty(0, bool))
    effects: Mapping[str, float] = field(default_factory=dict)


class _Path:
    """Appends commanded stretches of motion; the table follows through two lags, as a servo's loop does."""

    def __init__(self, moving: str, servo_s: tuple[float, float]) -> None:
        self.moving, self.other = moving, "z" if moving == "x" else "x"
        self.parts: dict[str, list[F64]] = {"x": [], "z": []}
        self.segments: list[tuple[str, int]] = []
        self.servo_s = servo_s

    def add(self, name: str, rate: F64, *, other: F64 | None = None) -> None:
        self.parts[self.moving].append(rate)
        self.parts[self.other].append(np.zeros_like(rate) if other is None else other)
        self.segments.append((name, len(rate)))

    def hold(self, seconds: float) -> None:
        self.add("hold", np.zeros(round(seconds * FINE_HZ)))

    def go(self, degrees: float, rate: float) -> None:
        count = max(1, round(abs(degrees) / rate * FINE_HZ))
        self.add(f"rate:{np.sign(degrees) * rate:+g}", np.full(count, degrees * FINE_HZ / count))

    def wave(self, amplitudes: list[float], frequencies: list[float], seconds: float, *, other: bool = False) -> None:
        t = (np.arange(round(seconds * FINE_HZ)) + 0.5) / FINE_HZ
        rate = np.zeros_like(t)
        for amplitude, frequency in zip(amplitudes, frequencies, strict=True):
            rate += amplitude * 2 * np.pi * frequency * np.cos(2 * np.pi * frequency * t)
        name = "sine:" + "+".join(f"{f:g}" for f in frequencies)
        self.add(name, np.zeros_like(rate) if other else rate, other=rate if other else None)

    @property
    def turned_deg(self) -> float:
        return float(sum(rate.sum() for rate in self.parts[self.moving])) / FINE_HZ

    def done(self) -> Motion:
        rates = {axis: np.concatenate(parts) for axis, parts in self.parts.items()}
        for tau in self.servo_s:
            rates = {axis: _lag(rate, tau) for axis, rate in rates.items()}
        return Motion(rates, self.segments)


def first_plan(axis: str, *, locked: bool) -> Motion:
    """The mixed motion of METHOD 2: sine, rate staircase both ways, poses, three fast sines, the other axis."""
    f = [0.25, 1.0, 2.0, 4.0, 0.4] if locked else [0.2513, 1.0137, 2.0171, 4.0313, 0.4019]
    path = _Path(axis, servo_s=(0.012, 0.025))
    path.hold(6)
    path.wave([30], [f[0]], 10 / f[0])
    for rate, reach in ((100, 120), (80, 120), (60, 120), (40, 120), (20, 40), (10, 40)):
        path.go(-reach, 60)
        path.go(2 * reach, rate)
        path.hold(0.5)
        path.go(-2 * reach, rate)
        path.go(reach, 60)
        path.hold(0.7)
    for angle in (80, -80, -120, 40, 120, -40):
        path.go(angle, 50)
        path.hold(1.5)
        path.go(-angle, 50)
        path.hold(0.5)
    for amplitude, frequency in ((12, f[1]), (5, f[2]), (2, f[3])):
        path.wave([amplitude], [frequency], round(12 * frequency) / frequency)
    path.wave([25], [f[4]], 8 / f[4], other=True)
    path.hold(8)
    return path.done()


def second_plan(axis: str, rng: np.random.Generator, *, locked: bool) -> Motion:
    """A walk through random poses at random speeds with two multisines, a slow servo, and both axes in turn."""
    path = _Path(axis, servo_s=(0.03, 0.05))
    base = np.array([0.3, 0.7, 1.5, 3.0]) if locked else np.array([0.3071, 0.7193, 1.5307, 3.0713])
    path.hold(float(rng.uniform(4, 7)))
    here = 0.0
    for index in range(34):
        speed = float(rng.choice([8, 15, 30, 45, 70, 90, 100]))
        target = float(rng.uniform(-118, 118))
        if abs(target - here) < 0.3 * speed:
            target = here - np.sign(here or 1.0) * 0.5 * speed
        path.go(target - here, speed)
        here = target
        if index % 3 == 2:
            path.hold(float(rng.uniform(0.8, 2.5)))
        if index == 11:
            path.wave([6, 4, 2.0, 0.9], list(base), 20.0 if locked else 3 / 0.3071 * 2)
        if index == 22:
            path.wave([20], [0.5 if locked else 0.5039], 10 / (0.5 if locked else 0.5039), other=True)
    path.go(-here, 40)
    path.hold(1.0)
    path.wave([1.8, 1.2], [base[3], base[2]], 14.0)
    path.go(-path.turned_deg, 10)
    path.hold(6)
    return path.done()


def sine_plan(axis: str, *, locked: bool) -> Motion:
    """One slow sine between short rests: it cannot tell one lateness from another."""
    path = _Path(axis, servo_s=(0.012, 0.025))
    f = 0.25 if locked else 0.2513
    path.hold(3)
    path.wave([30], [f], 25 / f)
    path.hold(3)
    return path.done()


def one_rate_plan(axis: str) -> Motion:
    """Strokes of one speed in both directions: |rate| and its square are the same column."""
    path = _Path(axis, servo_s=(0.012, 0.025))
    path.hold(5)
    path.go(-60, 50)
    for _ in range(12):
        path.go(120, 50)
        path.hold(1.5)
        path.go(-120, 50)
        path.hold(1.5)
    path.go(60, 50)
    path.hold(5)
    return path.done()


def _lag(signal: F64, tau_s: float) -> F64:
    """First-order lag at 1 kHz, exact for a signal that is a straight line between samples; starts settled."""
    from scipy.signal import lfilter

    a = np.exp(-1 / (FINE_HZ * tau_s))
    late = tau_s * FINE_HZ * (1 - a)
    return np.asarray(lfilter([1 - late, late - a], [1, -a], signal, zi=[late * signal[0]])[0])


def _direction(rate: F64) -> F64:
    """Sign of the last motion, +1 before the first."""
    moving = np.where(np.abs(rate) > 1e-6, np.sign(rate), 0.0)
    last = np.maximum.accumulate(np.where(moving != 0, np.arange(len(rate)), 0))
    held = moving[last]
    return np.where(held == 0, 1.0, held)


def temperature(rng: np.random.Generator, t: F64) -> F64:
    """A room and a board that swing about 6 °C, not in step with anything else."""
    waves = sum(
        float(rng.uniform(0.5, 1.2)) * np.sin(2 * np.pi * t / period + float(rng.uniform(0, 6.28)))
        for period in (float(rng.uniform(90, 140)), float(rng.uniform(150, 260)))
    )
    swing = 6.0 / max(float(np.ptp(waves)), 1e-9)
    return np.asarray(25 + swing * waves)


def heating(rng: np.random.Generator, t: F64) -> F64:
    """A steady rise of 6 °C: it cannot be told from time."""
    return np.asarray(float(rng.uniform(20, 25)) + 6.0 * t / t[-1])


def supply(rng: np.random.Generator, t: F64) -> F64:
    """3 V that wanders by tens of millivolts."""
    return np.asarray(
        3.0
        + 0.03 * np.sin(2 * np.pi * t / float(rng.uniform(25, 45)) + float(rng.uniform(0, 6)))
        + 0.015 * np.sin(2 * np.pi * t / float(rng.uniform(7, 13)) + float(rng.uniform(0, 6)))
    )


@dataclass
class _World:
    """Truth at 1 kHz while effects are laid on it, in the order of the signal chain."""

    t: F64
    rate: F64
    other_rate: F64
    theta: F64
    tilt: F64
    temperature: F64
    supply: F64
    rng: np.random.Generator
    sensed: F64
    volts: F64
    encoder: F64
    delay_s: float = 0.0
    skew: float = 0.0
    step_V: float = ADC_STEP_V
    clip_dps: float | None = None


def _sign(w: _World) -> float:
    return float(w.rng.choice([-1.0, 1.0]))


def _between(w: _World, low: float, high: float) -> float:
    return float(w.rng.uniform(low, high))


def _add_volts(shape: Callable[[_World], F64]) -> Callable[[_World, float], None]:
    def apply(w: _World, strength: float) -> None:
        w.volts += strength * shape(w)

    return apply


def _add_rate(shape: Callable[[_World], F64]) -> Callable[[_World, float], None]:
    def apply(w: _World, strength: float) -> None:
        w.sensed += strength * shape(w)

    return apply


def _dead_band(w: _World, strength: float) -> None:
    w.sensed = np.sign(w.sensed) * np.maximum(np.abs(w.sensed) - 2.0 * strength, 0)


def _bandwidth_lag(w: _World, strength: float) -> None:
    w.sensed = _lag(w.sensed, 0.006 * strength)


def _time_offset(w: _World, strength: float) -> None:
    w.delay_s += 0.006 * strength


def _clock_skew(w: _World, strength: float) -> None:
    w.skew += 8e-5 * strength * _sign(w)


def _coarse(w: _World, strength: float) -> None:
    w.step_V = max(9.77e-3 * strength, ADC_STEP_V)


def _saturation(w: _World, strength: float) -> None:
    w.clip_dps = 100.0 - 12.0 * strength


def _eccentricity(w: _World, strength: float) -> None:
    phase = _between(w, 0, 2 * np.pi)
    w.encoder += 0.5 * strength * (np.sin(np.radians(w.theta) + phase) - np.sin(phase))


def _backlash(w: _World, strength: float) -> None:
    w.encoder += 0.25 * strength * _direction(w.rate)


def _potentiometer(w: _World, strength: float) -> None:
    turned = w.theta / 120.0
    w.encoder += strength * (0.4 * _sign(w) * turned**2 + 0.4 * _sign(w) * (turned**3 - turned))


def _g(w: _World) -> F64:
    phase = _between(w, 0, 2 * np.pi)
    return np.asarray(8e-4 * np.sin(np.radians(w.tilt) + phase))


def _g_squared(w: _World) -> F64:
    phase = _between(w, 0, 2 * np.pi)
    return np.asarray(8e-4 * np.sin(np.radians(2 * w.tilt) + phase))


def _wander(w: _World) -> F64:
    return np.asarray(np.cumsum(w.rng.normal(0, 3e-4 / np.sqrt(FINE_HZ), len(w.t))))


def _step(w: _World) -> F64:
    at = _between(w, 0.25, 0.75) * w.t[-1]
    return np.asarray(1.2e-3 * _sign(w) * (w.t > at))


EFFECTS: Mapping[str, Callable[[_World, float], None]] = {
    "encoder_eccentricity": _eccentricity,
    "encoder_nonlinearity": _potentiometer,
    "backlash": _backlash,
    "cross_axis": _add_rate(lambda w: 0.008 * _sign(w) * w.other_rate),
    "angular_acceleration": _add_rate(lambda w: 6e-3 * _sign(w) * np.gradient(w.rate, 1.0 / FINE_HZ)),
    "bandwidth_lag": _bandwidth_lag,
    "dead_band": _dead_band,
    "scale_factor_quadratic": _add_rate(lambda w: 6e-5 * _sign(w) * w.rate**2),
    "scale_factor_cubic": _add_rate(lambda w: 1.2e-6 * _sign(w) * w.rate**3),
    "scale_factor_asymmetry": _add_rate(lambda w: 4e-3 * _sign(w) * np.abs(w.rate)),
    "scale_factor_temperature": _add_rate(lambda w: 8e-4 * _sign(w) * (w.temperature - 25) * w.rate),
    "hysteresis": _add_volts(lambda w: 6e-4 * _sign(w) * _direction(w.rate)),
    "g_sensitivity": _add_volts(_g),
    "g_squared_sensitivity": _add_volts(_g_squared),
    "bias_temperature": _add_volts(lambda w: 2.5e-4 * _sign(w) * (w.temperature - 25)),
    "thermal_lag": _add_volts(lambda w: 4e-4 * _sign(w) * _lag(w.temperature - 25, _between(w, 15, 40))),
    "warm_up": _add_volts(lambda w: 4.5e-3 * _sign(w) * np.exp(-w.t / _between(w, 20, 60))),
    "bias_drift": _add_volts(lambda w: 8e-6 * _sign(w) * w.t),
    "bias_step": _add_volts(_step),
    "bias_random_walk": _add_volts(_wander),
    "mains_hum": _add_volts(lambda w: 1.1e-3 * np.sin(2 * np.pi * _between(w, 49.8, 50.2) * w.t + _between(w, 0, 6))),
    "supply_sensitivity": _add_volts(lambda w: 0.04 * _sign(w) * (w.supply - 3.0)),
    "time_offset": _time_offset,
    "clock_skew": _clock_skew,
    "adc_quantization": _coarse,
    "saturation": _saturation,
    # In no library: what the diagnosis must flag without giving it a library's name.
    "cogging_7_per_rev": _add_volts(lambda w: 6e-4 * np.sin(np.radians(7 * w.theta) + _between(w, 0, 6))),
    "rate_notch": _add_rate(lambda w: 0.9 * _sign(w) * np.exp(-(((np.abs(w.rate) - 45) / 6) ** 2))),
    "rate_ripple": _add_rate(lambda w: 0.35 * np.sin(w.rate / 6.0 + _between(w, 0, 6))),
    "pose_notch": _add_volts(lambda w: 2e-3 * _sign(w) * np.exp(-(((w.theta - 35) / 15) ** 2))),
    "temperature_kink": _add_volts(lambda w: 8e-4 * _sign(w) * np.maximum(w.temperature - 25.5, 0) ** 0.5),
}
OUTSIDE_THE_LIBRARY = ("cogging_7_per_rev", "rate_notch", "rate_ripple", "pose_notch", "temperature_kink")


def _motion(plan: str, axis: str, rng: np.random.Generator, *, locked: bool) -> Motion:
    if plan == "second":
        return second_plan(axis, rng, locked=locked)
    if plan == "one_rate":
        return one_rate_plan(axis)
    return (sine_plan if plan == "sine" else first_plan)(axis, locked=locked)


def _coloured(rng: np.random.Generator, count: int, std: float, phi: float) -> F64:
    from scipy.signal import lfilter

    drive = rng.normal(0, std * np.sqrt(1 - phi * phi), count)
    return np.asarray(lfilter([1], [1, -phi], drive, zi=[phi * rng.normal(0, std)])[0])


def record(
    seed: int,
    effects: Mapping[str, float],
    *,
    axis: str = "x",
    plan: str = "first",
    warming: bool = False,
    locked: bool = False,
    reference: str = "encoder",
    white_V: float = 1.2e-3,
    ar1_V: float = 0.0,
    phi: float = 0.0,
    board: tuple[float, float] | None = None,
) -> Record:
    """One recording at 100 Hz with the ``effects`` (name: strength) hidden in ``axis``.

    ``plan`` is ``first``, ``second``, ``sine`` or ``one_rate``, ``locked`` ties the sines to the sample clock, with
    ``warming`` temperature rises steadily, ``reference`` is ``encoder`` (quantised to 0.2933 deg) or ``rate`` (exact).
    Noise is white plus AR(1) with ``phi`` at 100 Hz. ``board`` is bias and scale factor, where not drawn.
    """
    rng = np.random.default_rng(np.random.SeedSequence([20261122, seed]))
    motion = _motion(plan, axis, rng, locked=locked)
    other = "z" if axis == "x" else "x"
    bias = float(rng.uniform(1.235, 1.285))
    scale = SCALE_FACTOR * float(rng.uniform(0.96, 1.04))
    bias, scale = board or (bias, scale)
    per_row = FINE_HZ // ROW_HZ
    rate, other_rate = motion.rate_dps[axis], motion.rate_dps[other]
    t = np.arange(len(rate)) / FINE_HZ
    # A sample's angle is the integral up to it; the rate above is the mean of the millisecond that follows.
    theta = np.concatenate([[0.0], np.cumsum(rate)[:-1]]) / FINE_HZ
    other_theta = np.concatenate([[0.0], np.cumsum(other_rate)[:-1]]) / FINE_HZ
    world = _World(
        t=t,
        rate=rate,
        other_rate=other_rate,
        theta=theta,
        tilt=theta if axis == "x" else other_theta,
        temperature=heating(rng, t) if warming else temperature(rng, t),
        supply=supply(rng, t),
        rng=rng,
        sensed=rate.copy(),
        volts=np.full(len(t), bias),
        encoder=theta.copy(),
    )
    for name in [name for name in EFFECTS if name in effects]:
        EFFECTS[name](world, effects[name])
    unknown = set(effects) - set(EFFECTS)
    if unknown:
        raise ValueError(f"no such effect: {sorted(unknown)}; there are {sorted(EFFECTS)}")
    rows = np.arange(0, len(t) - per_row, per_row)
    # The sampled rate is the mean around the instant, so that the instants of its jumps carry no bias.
    sensed = scale * np.concatenate([[world.sensed[0]], (world.sensed[1:] + world.sensed[:-1]) / 2])
    volts = sensed + world.volts
    clean = np.interp(t[rows] * (1.0 - world.skew) - world.delay_s, t, volts)
    if world.clip_dps is not None:
        clean = np.clip(clean, bias - scale * world.clip_dps, bias + scale * world.clip_dps)
    noise = rng.normal(0, white_V, len(rows))
    if ar1_V:
        noise += _coloured(rng, len(rows), ar1_V, phi)
    measured = np.round((clean + noise) / world.step_V) * world.step_V
    clipped = np.zeros(len(rows), bool)
    if world.clip_dps is not None:
        limit = scale * world.clip_dps
        clipped = np.abs(clean - bias) >= limit
        measured = np.round(np.clip(clean + noise, bias - limit, bias + limit) / ADC_STEP_V) * ADC_STEP_V
    phase = float(rng.uniform(-0.5, 0.5)) * ENCODER_STEP_DEG
    angle = np.round((world.encoder[rows] + phase) / ENCODER_STEP_DEG) * ENCODER_STEP_DEG
    other_angle = np.round(other_theta[rows] / ENCODER_STEP_DEG) * ENCODER_STEP_DEG
    mean_rate = np.concatenate([[rate[0]], (rate[1:] + rate[:-1]) / 2])[rows]
    names = np.repeat([name for name, _ in motion.segments], [count for _, count in motion.segments])[rows]
    columns = {
        "time_s": t[rows],
        f"{axis}_gyro_v": measured,
        f"{other}_position_deg": other_angle,
        "temperature_c": np.round(world.temperature[rows] + rng.normal(0, 0.03, len(rows)), 2),
        "supply_v": np.round(world.supply[rows] + rng.normal(0, 0.001, len(rows)), 4),
    }
    columns[f"{axis}_position_deg" if reference == "encoder" else f"{axis}_rate_dps"] = (
        angle if reference == "encoder" else mean_rate
    )
    if reference == "rate":
        columns[f"{axis}_position_deg"] = angle
    return Record(
        columns=columns,
        segments=[str(name) for name in names],
        truth={
            "effects": dict(effects),
            "axis": axis,
            "reference": reference,
            "bias_V": bias,
            "scale_factor_V_per_dps": scale,
            "seed": seed,
        },
        gyro_noise_dps=(measured - clean) / scale,
        encoder_error_deg=angle - phase - world.encoder[rows],
        clipped=clipped,
        effects=dict(effects),
    )
