"""The rig's own calibration: what its encoders read against a better angle, and how readings are corrected by it.

The encoder of an RX servo is a converter on a potentiometer: its gain and linearity are unknown, and the gain goes
straight into every scale factor (HARDWARE). A record holds, for each axis, pairs of what the encoder read and what the
angle truly was (a protractor, a better encoder). A polynomial without constant term is fitted through them: an offset
turns no rate and no difference of angles wrong. Recordings keep raw readings; the record stands in their header.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core.problem import Problem

F64 = NDArray[np.float64]

HEADER = "reference_calibration"
LEAST_SPAN_DEG = 30.0
MOST_POINTS = 200
LONGEST_TEXT = 200
WORST_SCALE = 0.2
"""An encoder whose gain is off by more than this is broken, or the pairs are exchanged."""


@dataclass(frozen=True)
class AxisCalibration:
    """Pairs (encoder, true angle) in deg of one axis, and the standard uncertainty of each true angle in deg."""

    points: tuple[tuple[float, float], ...]
    standard_uncertainty_deg: float

    @property
    def degree(self) -> int:
        """As many terms as the pairs can carry: a gain from two, a quadratic from four, a cubic from six."""
        return min(3, max(1, len(self.points) // 2))

    @property
    def coefficients(self) -> F64:
        """(degree,) of θ = c₁θₑ + c₂θₑ² + c₃θₑ³, with θₑ in deg."""
        return self._fit()[0]

    @property
    def scale(self) -> float:
        """c₁: true degrees for one of the encoder's, around 0°."""
        return float(self.coefficients[0])

    @property
    def scale_uncertainty(self) -> float:
        """Relative standard uncertainty of the mean gain over the pairs' span: their own, or their scatter's."""
        encoder, _ = np.array(self.points).T
        _, covariance = self._fit()
        half = float(np.ptp(encoder)) / 2.0
        ends = np.array([half**k if k % 2 else 0.0 for k in range(1, self.degree + 1)]) / half
        return math.sqrt(float(ends @ covariance @ ends)) / abs(self.scale)

    def apply(self, angle_deg: F64) -> F64:
        """True angles (m,) of encoder readings (m,)."""
        true: F64 = np.polynomial.polynomial.polyval(angle_deg, np.concatenate([[0.0], self.coefficients]))
        return true

    def _fit(self) -> tuple[F64, NDArray[np.float64]]:
        """Coefficients without the constant (degree,) and their covariance, by least squares."""
        encoder, true = np.array(self.points).T
        unit = float(np.abs(encoder).max())
        design = np.vander(encoder / unit, self.degree + 1, increasing=True)
        found, *_ = np.linalg.lstsq(design, true, rcond=None)
        spare = len(true) - self.degree - 1
        scatter = float(np.sum((true - design @ found) ** 2) / spare) if spare > 0 else 0.0
        variance = max(self.standard_uncertainty_deg**2, scatter)
        powers = unit ** -np.arange(1.0, self.degree + 1)
        covariance = variance * np.linalg.pinv(design.T @ design)[1:, 1:]
        return found[1:] * powers, covariance * np.outer(powers, powers)


@dataclass(frozen=True)
class ReferenceCalibration:
    """When, by what and by whom the encoders were calibrated, and each axis that was."""

    date: str
    means: str
    by: str
    axes: Mapping[str, AxisCalibration]

    @property
    def name(self) -> str:
        """What a certificate calls it."""
        return ", ".join(part for part in (self.means, self.date, self.by) if part)

    def to_json(self) -> dict[str, Any]:
        return {
            "date": self.date,
            "means": self.means,
            "by": self.by,
            "axes": {
                axis: {
                    "points": [list(point) for point in found.points],
                    "standard_uncertainty_deg": found.standard_uncertainty_deg,
                }
                for axis, found in self.axes.items()
            },
        }

    @classmethod
    def from_json(cls, given: Mapping[str, Any]) -> "ReferenceCalibration":
        """Raises Problem `reference.…` for what cannot be a record."""
        date, means, by = (" ".join(str(given.get(name, "")).split()) for name in ("date", "means", "by"))
        if not date or not means:
            raise Problem("reference.words")
        if max(len(date), len(means), len(by)) > LONGEST_TEXT:
            raise Problem("reference.long", longest=LONGEST_TEXT)
        axes = {axis: _axis(axis, found) for axis, found in dict(given.get("axes") or {}).items() if found}
        if not axes:
            raise Problem("reference.no_axis")
        return cls(date, means, by, axes)

    @classmethod
    def of(cls, header: Mapping[str, str]) -> "ReferenceCalibration | None":
        """The record a recording was made with; None where its encoder was not calibrated."""
        text = header.get(HEADER, "")
        return _parsed(text) if text.startswith("{") else None


@cache
def _parsed(text: str) -> ReferenceCalibration:
    try:
        return ReferenceCalibration.from_json(json.loads(text))
    except (ValueError, TypeError, AttributeError) as error:
        if isinstance(error, Problem):
            raise
        raise Problem("reference.unreadable") from error


def _axis(axis: str, given: Mapping[str, Any]) -> AxisCalibration:
    try:
        points = tuple((float(encoder), float(true)) for encoder, true in given["points"])
        uncertainty = float(given["standard_uncertainty_deg"])
    except (KeyError, TypeError, ValueError) as error:
        raise Problem("reference.points", axis=axis) from error
    values = np.array(points).reshape(-1, 2)
    if axis not in ("x", "y", "z") or not 2 <= len(points) <= MOST_POINTS or not np.isfinite(values).all():
        raise Problem("reference.points", axis=axis)
    if not 0.0 < uncertainty < 10.0:
        raise Problem("reference.uncertainty", axis=axis, given=uncertainty)
    if np.ptp(values[:, 0]) < LEAST_SPAN_DEG or len(np.unique(values[:, 0])) < 2:
        raise Problem("reference.span", axis=axis, least=LEAST_SPAN_DEG)
    found = AxisCalibration(points, uncertainty)
    if abs(found.scale - 1.0) > WORST_SCALE:
        raise Problem("reference.scale", axis=axis, scale=found.scale)
    return found
