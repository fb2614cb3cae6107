"""Measurement uncertainty: a GUM budget (JCGM 100) and its Monte Carlo check (JCGM 101)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_core.problem import Problem

F64 = NDArray[np.float64]

DIVISORS = {"normal": 1.0, "uniform": math.sqrt(3.0), "triangular": math.sqrt(6.0), "arcsine": math.sqrt(2.0)}
"""Half-width (or, for "normal", standard uncertainty) over standard uncertainty: GUM 4.3.7, 4.3.9, H.1.7."""


def coverage_factor(dof: float, probability: float = 0.95) -> float:
    """Student's t for a two-sided interval (GUM G.3); ``dof`` may be infinite."""
    from scipy.special import ndtri, stdtrit

    upper = (1.0 + probability) / 2.0
    return float(ndtri(upper) if math.isinf(dof) else stdtrit(max(dof, 1.0), upper))


@dataclass(frozen=True)
class Contribution:
    """One source of uncertainty. ``size`` is a standard uncertainty ("normal") or a half-width, in its own unit."""

    name: str
    size: float
    kind: str = "B"
    distribution: str = "normal"
    sensitivity: float = 1.0
    """Change of the result per change of this input."""
    dof: float = math.inf

    def __post_init__(self) -> None:
        if self.distribution not in DIVISORS or self.kind not in ("A", "B") or not self.size >= 0.0:
            raise Problem("uncertainty.contribution", name=self.name, size=self.size, distribution=self.distribution)

    @property
    def standard_uncertainty(self) -> float:
        """|sensitivity|·size/divisor, in the unit of the result."""
        return abs(self.sensitivity) * self.size / DIVISORS[self.distribution]


@dataclass(frozen=True)
class Budget:
    """Uncorrelated contributions to one result, and the sources that are left out because nobody knows their size."""

    value: float
    contributions: tuple[Contribution, ...]
    excluded: tuple[str, ...] = ()

    @property
    def standard_uncertainty(self) -> float:
        """Combined: the root of the sum of squares (GUM 5.1.2)."""
        return math.hypot(*(c.standard_uncertainty for c in self.contributions))

    @property
    def dof(self) -> float:
        """Effective degrees of freedom by Welch and Satterthwaite (GUM G.4)."""
        spread = sum(c.standard_uncertainty**4 / c.dof for c in self.contributions)
        return self.standard_uncertainty**4 / spread if spread > 0.0 else math.inf

    def coverage_factor(self, probability: float = 0.95) -> float:
        """k for this budget: the effective degrees of freedom are truncated to a whole number (GUM G.4.1)."""
        dof = self.dof
        return coverage_factor(dof if math.isinf(dof) else math.floor(dof), probability)

    def expanded_uncertainty(self, probability: float = 0.95) -> float:
        return self.coverage_factor(probability) * self.standard_uncertainty

    def to_json(self) -> list[dict[str, object]]:
        """The rows of the budget for a certificate, excluded sources last and without a number."""
        known: list[dict[str, object]] = [
            {
                "name": c.name,
                "kind": c.kind,
                "distribution": c.distribution,
                "size": c.size,
                "sensitivity": c.sensitivity,
                "standard_uncertainty": c.standard_uncertainty,
                "dof": None if math.isinf(c.dof) else c.dof,
            }
            for c in self.contributions
        ]
        return known + [{"name": name, "excluded": True} for name in self.excluded]


def propagate(
    function: Callable[[F64], F64], means: Sequence[float], covariance: NDArray[np.float64]
) -> tuple[F64, F64]:
    """Values (q,) and covariance (q, q) of a vector function of correlated inputs (p,): GUM 5.2 and H.2.

    Sensitivities are central differences over one standard uncertainty.
    """
    x = np.asarray(means, float)
    step = np.sqrt(np.diag(covariance))
    columns = [
        (function(x + e) - function(x - e)) / (2.0 * e[k]) if step[k] > 0.0 else 0.0 * function(x)
        for k, e in enumerate(np.diag(step))
    ]
    jacobian = np.stack(columns, axis=1)
    return function(x), jacobian @ covariance @ jacobian.T


def monte_carlo(
    function: Callable[[F64], F64], draws: Callable[[int, np.random.Generator], F64], n: int, rng: np.random.Generator
) -> tuple[float, float, tuple[float, float]]:
    """Mean, standard uncertainty and shortest 95 % interval of ``function`` over ``draws`` (JCGM 101, 7.6 and 7.7).

    ``draws(n, rng)`` gives inputs (p, n); ``function`` maps them to (n,).
    """
    out = np.sort(function(draws(n, rng)))
    inside = round(0.95 * n)
    widths = out[inside:] - out[: n - inside]
    low = int(np.argmin(widths))
    return float(out.mean()), float(out.std(ddof=1)), (float(out[low]), float(out[low + inside]))
