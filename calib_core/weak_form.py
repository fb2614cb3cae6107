"""The weak form: residuals in deg/s over windows of one second, from integrals only (METHOD 2).

With a smooth test function ψ that vanishes at both ends of its window, ∫ψ·ω dt = -∫ψ'·θ dt, so the encoder is never
differentiated. Good for pictures and for the error that is quoted; decisions are made on the whitened rows.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

WINDOW_S = 1.0


@dataclass(frozen=True, eq=False)
class Windows:
    """Overlapping windows over k samples at a steady interval."""

    samples: int
    interval_s: float

    @property
    def width(self) -> int:
        return max(8, round(WINDOW_S / self.interval_s))

    @cached_property
    def first(self) -> Ints:
        """(w,) the first sample of each window; each overlaps the next by half."""
        return np.arange(0, max(self.samples - self.width, 0) + 1, max(1, self.width // 2))

    @cached_property
    def bump(self) -> F64:
        """ψ (width,), of unit integral."""
        shape = np.sin(np.pi * (np.arange(self.width) + 0.5) / self.width) ** 2
        return np.asarray(shape / (shape.sum() * self.interval_s))

    @cached_property
    def slope(self) -> F64:
        """ψ' (width,), exactly orthogonal to a constant and with unit response to a steady rate."""
        middle = np.arange(self.width) - (self.width - 1) / 2.0
        shape = np.sin(2.0 * np.pi * (np.arange(self.width) + 0.5) / self.width)
        shape -= shape.mean()
        return np.asarray(-shape / (shape @ middle * self.interval_s**2))

    def mean(self, rates: F64) -> F64:
        """(w, p) ψ-weighted means of rates (k, p)."""
        return self._apply(rates, self.bump)

    def rate(self, angles: F64) -> F64:
        """(w, p) the same means of the rates whose integrals are ``angles`` (k, p)."""
        return -self._apply(angles, self.slope)

    def _apply(self, values: F64, weights: F64) -> F64:
        view = np.lib.stride_tricks.sliding_window_view(values, self.width, axis=0)[self.first]
        return np.asarray(view @ weights * self.interval_s)

    @property
    def steepness(self) -> float:
        """The square that independent errors of the angle, each of 1 deg, bring into a window."""
        return float(np.sum((self.slope * self.interval_s) ** 2))

    def spread(self, white: float, ar1: float, correlation_time_s: float) -> float:
        """The standard deviation that a gyro's noise gives a window: ``white`` and ``ar1`` of one sample, deg/s."""
        lag = np.arange(self.width)
        bump = self.bump * self.interval_s
        covariance = ar1**2 * np.exp(-np.abs(lag[:, None] - lag) * self.interval_s / correlation_time_s)
        return float(np.sqrt(white**2 * float(bump @ bump) + float(bump @ covariance @ bump)))
