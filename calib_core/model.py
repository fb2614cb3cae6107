"""Model: what turns a table's motion into the gyro's output, in the order of the signal chain.

V = β + S·ω + effects + noise (thesis 3.1). The twin uses a Model as truth; fits return one as estimate.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

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
            return white * rng.standard_normal(n) + correlated

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
    """One axis of a gyro: bias in ``unit``, scale factor in ``unit`` per deg/s, noise."""

    bias: float
    scale_factor: float
    unit: str = "V"
    noise: Noise = Noise()

    def simulator(self, axis: str, rate_hz: float, rng: np.random.Generator) -> Callable[[Truth], F64]:
        """The gyro on ``axis`` as a function of successive blocks of truth sampled at ``rate_hz``.

        State (noise, and effects that remember) goes on from block to block, so the blocks' lengths do not matter.
        """
        noise = self.noise.source(rate_hz, rng)

        def output(truth: Truth) -> F64:
            rate = truth.rate_dps[axis]
            return self.bias + self.scale_factor * rate + noise(len(rate))

        return output

    def predict(self, rate_dps: F64) -> F64:
        """The output (n,) expected at these rates, without noise."""
        return self.bias + self.scale_factor * rate_dps

    def rate(self, output: F64) -> F64:
        """The rate (n,) in deg/s that this output means: compensation, thesis 3.23."""
        return (output - self.bias) / self.scale_factor
