"""Model: what turns a table's motion into the gyro's output, in the order of the signal chain.

V = β + S·ω + effects + noise (thesis 3.1). The twin uses a Model as truth; fits return one as estimate.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib_core.effects.base import Acts, Chain, Covariates, Effect, Stage

F64 = NDArray[np.float64]

STILL_DPS = 1e-3
"""Slower than this a simulated table is at rest."""
REFERENCE = {"temperature_c": 25.0, "supply_v": 3.0}
"""Where a simulated gyro's temperature and supply effects count from."""
NOISE_RATE_HZ = 100.0
"""The sampling rate at which ``Noise.white`` is the standard deviation of one sample."""


@dataclass(frozen=True)
class Noise:
    """White noise plus a first-order autoregression, in the unit of the model's output."""

    white: float = 0.0
    """Standard deviation of a sample at 100 Hz: a density, so a sample at 1 kHz has √10 times as much."""
    ar1: float = 0.0
    """Standard deviation of the correlated part, at any sampling rate."""
    correlation_time_s: float = 0.5

    def source(self, rate_hz: float, rng: np.random.Generator) -> Callable[[int], F64]:
        """Draws the next n samples at ``rate_hz``; the correlated part goes on where the last call stopped."""
        white = self.white * np.sqrt(rate_hz / NOISE_RATE_HZ)
        if self.ar1 <= 0.0:
            return lambda n: white * rng.standard_normal(n)
        decay = 1.0 / (rate_hz * self.correlation_time_s)
        # Over more than about 30 time constants the powers below would overflow.
        longest = max(1, int(30.0 / decay))
        drive = self.ar1 * np.sqrt(-np.expm1(-2.0 * decay))
        last = self.ar1 * rng.standard_normal()

        def draw(n: int) -> F64:
            nonlocal last
            correlated = np.empty(n)
            for start in range(0, n, longest):
                part = correlated[start : start + longest]
                power = np.exp(-decay * np.arange(1, len(part) + 1))
                # x_k = φ·x_{k-1} + e_k, solved for all k at once: x_k = φᵏ·(x_0 + Σ e_i/φⁱ).
                part[:] = power * (last + np.cumsum(drive * rng.standard_normal(len(part)) / power))
                last = float(part[-1])
            return np.asarray(white * rng.standard_normal(n) + correlated)

        return draw


@dataclass(frozen=True)
class Truth:
    """A block of what really happens to the gyro: arrays (n,), rates and angles by axis."""

    time_s: F64
    rate_dps: Mapping[str, F64]
    position_deg: Mapping[str, F64] = field(default_factory=dict)
    temperature_c: F64 | None = None
    supply_v: F64 | None = None


@dataclass(frozen=True)
class Model:
    """One axis of a gyro: bias in ``unit``, scale factor in ``unit`` per deg/s, effects in any order, noise."""

    bias: float
    scale_factor: float
    unit: str = "V"
    noise: Noise = Noise()
    effects: Sequence[Effect] = ()

    def simulator(self, axis: str, rate_hz: float, rng: np.random.Generator) -> Callable[[Truth], F64]:
        """The gyro on ``axis`` as a function of successive blocks of truth sampled at ``rate_hz``.

        State (noise, and effects that remember) goes on from block to block, so the blocks' lengths do not matter.
        """
        noise = self.noise.source(rate_hz, rng)
        follow = Follower(axis, rate_hz)
        in_gyro = [e for e in self.effects if e.acts is not Acts.ANGLE]
        before = [e for e in in_gyro if e.acts is Acts.RATE and e.stage is not Stage.ACQUISITION]
        behind = [e for e in in_gyro if e not in before and e.stage is not Stage.ACQUISITION]
        converter = [e for e in in_gyro if e.stage is Stage.ACQUISITION]

        def output(truth: Truth) -> F64:
            rate = truth.rate_dps[axis]
            if not in_gyro:
                return self.bias + self.scale_factor * rate + noise(len(rate))
            chain = Chain(follow(truth), np.zeros(len(rate)), rate, np.zeros(len(rate)), self.scale_factor, rng)
            for effect in before:
                effect.apply(chain)
            chain.output = self.bias + self.scale_factor * chain.rate_dps
            for effect in behind:
                effect.apply(chain)
            chain.output = chain.output + noise(len(rate))
            for effect in converter:
                effect.apply(chain)
            return chain.output

        return output

    def encoder(self, axis: str, rate_hz: float, rng: np.random.Generator) -> Callable[[Truth], F64]:
        """What the encoder of ``axis`` adds to the true angle, in deg, for successive blocks of truth."""
        follow = Follower(axis, rate_hz)
        effects = [e for e in self.effects if e.acts is Acts.ANGLE]

        def error(truth: Truth) -> F64:
            none = np.zeros(len(truth.time_s))
            if effects and len(none):
                chain = Chain(follow(truth), none.copy(), none, none, self.scale_factor, rng)
                for effect in effects:
                    effect.apply(chain)
                return chain.encoder_deg
            return none

        return error

    def predict(self, rate_dps: F64) -> F64:
        """The output (n,) expected at these rates, without noise."""
        return self.bias + self.scale_factor * rate_dps

    def rate(self, output: F64) -> F64:
        """The rate (n,) in deg/s that this output means: compensation, thesis 3.23."""
        return (output - self.bias) / self.scale_factor


class Follower:
    """Covariates of successive blocks of truth: remembers what the last block ended with."""

    def __init__(self, axis: str, rate_hz: float) -> None:
        self.axis, self.interval_s = axis, 1.0 / rate_hz
        self.other = "z" if axis == "x" else "x"
        self.memory: dict[str, F64] = {}
        self.last_rate: float | None = None
        self.last_direction = 0.0

    def __call__(self, truth: Truth) -> Covariates:
        rate = truth.rate_dps[self.axis]
        none = np.zeros(len(rate))
        previous = np.concatenate([[rate[0] if self.last_rate is None else self.last_rate], rate[:-1]])
        turning = np.where(np.abs(rate) > STILL_DPS, np.sign(rate), 0.0)
        turned = np.flatnonzero(turning)
        if len(turned):
            last = np.searchsorted(turned, np.arange(len(rate)), side="right") - 1
            direction = np.where(last >= 0, turning[turned[np.maximum(last, 0)]], self.last_direction)
        else:
            direction = none + self.last_direction
        self.last_rate, self.last_direction = float(rate[-1]), float(direction[-1])
        return Covariates(
            axis=self.axis,
            time_s=truth.time_s,
            rate_dps=rate,
            position_deg=truth.position_deg.get(self.axis, none),
            acceleration_dps2=(rate - previous) / self.interval_s,
            direction=direction,
            interval_s=self.interval_s,
            temperature_c=truth.temperature_c,
            supply_v=truth.supply_v,
            other_rate_dps=truth.rate_dps.get(self.other),
            tilt_deg=truth.position_deg.get("x"),
            reference=REFERENCE,
            memory=self.memory,
        )
