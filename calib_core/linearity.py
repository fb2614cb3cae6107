"""What a rate test and a position test say of a gyro: straight line, repeatability, sample size (thesis 5.1-5.9).

One arithmetic for both tests and for the thesis' own readings; only units and full scale differ.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from calib_core.points import Points
from calib_core.uncertainty import coverage_factor

F64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Told = dict[str, Any]

CI = 0.25
"""The width of the confidence interval that the thesis asks of a mean, in the reading's unit (5.3-5.6)."""
FEWEST_TO_DROP = 5
"""From this many readings on the smallest and the largest are dropped; below it too little would be left."""
SUFFIX = {"rate": "dps", "position": "deg"}
UNIT = {"rate": "deg/s", "position": "deg"}


@dataclass(frozen=True, eq=False)
class Line:
    """y = slope * x + intercept by least squares; ``residual`` (n,) is y minus the line (5.1)."""

    slope: float
    intercept: float
    residual: F64
    slope_se: float
    intercept_se: float
    residual_sd: float


def line(x: F64, y: F64) -> Line:
    """Least-squares line through (n,) points, n >= 2 distinct x; centred, so that it keeps its digits (NIST norris)."""
    x_mean, y_mean = float(np.mean(x)), float(np.mean(y))
    u = x - x_mean
    sxx = float(u @ u)
    slope = float(u @ (y - y_mean)) / sxx
    intercept = y_mean - slope * x_mean
    residual = (y - y_mean) - slope * u
    freedom = len(x) - 2
    sd = float(np.sqrt(residual @ residual / freedom)) if freedom > 0 else float("nan")
    return Line(slope, intercept, residual, sd / sxx**0.5, sd * (1 / len(x) + x_mean**2 / sxx) ** 0.5, sd)


@dataclass(frozen=True, eq=False)
class SetPoint:
    """All readings of one set-point: gyro ``readings`` (m,) against the encoder's ``references`` (m,)."""

    set_point: float
    references: F64
    readings: F64
    used: Mask

    @property
    def reference(self) -> float:
        """x_true: the mean of the references in use."""
        return float(np.mean(self.references[self.used]))

    @property
    def n(self) -> int:
        return int(self.used.sum())

    @property
    def mean(self) -> float:
        return float(np.mean(self.readings[self.used]))

    @property
    def bias_error(self) -> float:
        """(5.7) mean minus true, signed; the thesis prints its magnitude."""
        return self.mean - self.reference

    @property
    def standard_deviation(self) -> float:
        """S of the readings less the table's own movement between repeats (the thesis prints one reference for all)."""
        error = (self.readings - self.references)[self.used]
        return float(np.std(error, ddof=1)) if len(error) > 1 else float("nan")

    @property
    def random_error(self) -> float:
        """(5.8)"""
        return 2.0 * self.standard_deviation


@dataclass(frozen=True, eq=False)
class Linearity:
    """The straight-line test: set-point means against their references (5.1, 5.2)."""

    points: tuple[SetPoint, ...]
    line: Line
    full_scale: float

    @property
    def max_error(self) -> float:
        """The residual of largest magnitude, with its sign, as the thesis prints it."""
        return float(self.line.residual[np.argmax(np.abs(self.line.residual))])

    @property
    def nonlinearity_pct_fs(self) -> float:
        return 100.0 * abs(self.max_error) / self.full_scale


@dataclass(frozen=True, eq=False)
class Repeatability:
    """The repeat test (5.7-5.9)."""

    points: tuple[SetPoint, ...]
    full_scale: float

    @property
    def worst(self) -> SetPoint:
        """The set-point of S_max."""
        return max(self.points, key=lambda point: point.standard_deviation)

    @property
    def max_standard_deviation(self) -> float:
        return self.worst.standard_deviation

    @property
    def max_random_error(self) -> float:
        return self.worst.random_error

    @property
    def max_bias_error(self) -> float:
        """The largest magnitude of (5.7), without sign, as the thesis prints it."""
        return max(abs(point.bias_error) for point in self.points)

    @property
    def repeatability_pct_fs(self) -> float:
        """(5.9)"""
        return 100.0 * self.max_random_error / self.full_scale

    @property
    def type_a(self) -> float:
        """(2.21) of the worst set-point: S_max / sqrt(n), a standard uncertainty."""
        return self.max_standard_deviation / math.sqrt(self.worst.n)


@dataclass(frozen=True)
class SampleSize:
    """Whether ``used`` readings pin the mean to a confidence interval of width ``ci`` (5.3-5.6)."""

    standard_deviation: float
    ci: float
    t: float
    used: int

    @property
    def d(self) -> float:
        """(5.6) half the interval; the thesis' worked case puts the whole of it here."""
        return self.ci / 2

    @property
    def needed(self) -> float:
        """(5.5) N = (t S / d)^2, not rounded up."""
        ratio = self.t * self.standard_deviation / self.d
        return ratio * ratio

    @property
    def enough(self) -> bool:
        return self.used >= self.needed

    def to_json(self, unit: str) -> dict[str, Any]:
        """CONTRACT keys and the verdict as a sentence's code; ``unit`` is that of the readings."""
        values = {"ci": self.ci, "d": self.d, "needed": int(np.ceil(self.needed)), "used": self.used, "t": self.t}
        code = "sample_size.enough" if self.enough else "sample_size.not_enough"
        return {
            **values,
            "enough": self.enough,
            "code": code,
            "values": {**values, "S": self.standard_deviation, "unit": unit},
        }


def sample_size(standard_deviation: float, ci: float, n: int, t: float | None = None) -> SampleSize:
    """The readings that (5.3-5.6) ask for after n >= 2 gave ``standard_deviation``; t at n - 1 unless given."""
    return SampleSize(standard_deviation, ci, coverage_factor(n - 1) if t is None else t, n)


@dataclass(frozen=True, eq=False)
class TestResult:
    """A rate or position test: either half is None where its readings are missing."""

    __test__ = False  # not a pytest class

    kind: str
    full_scale: float
    linearity: Linearity | None
    repeatability: Repeatability | None
    type_b: float
    ci: float = CI
    warnings: list[Told] = field(default_factory=list)

    @property
    def sample_size(self) -> SampleSize | None:
        repeat = self.repeatability
        return sample_size(repeat.max_standard_deviation, self.ci, repeat.worst.n) if repeat else None

    def to_json(self) -> dict[str, Any]:
        """CONTRACT 3's keys of ``rate`` / ``position``, and line, sample size, points; None where not measured."""
        unit = SUFFIX[self.kind]
        lin, rep, size = self.linearity, self.repeatability, self.sample_size
        return {
            "nonlinearity_pct_fs": lin and lin.nonlinearity_pct_fs,
            "repeatability_pct_fs": rep and rep.repeatability_pct_fs,
            f"max_linearity_error_{unit}": lin and lin.max_error,
            f"max_bias_error_{unit}": rep and rep.max_bias_error,
            f"max_random_error_{unit}": rep and rep.max_random_error,
            f"max_standard_deviation_{unit}": rep and rep.max_standard_deviation,
            f"uncertainty_type_a_{unit}": rep and rep.type_a,
            f"uncertainty_type_b_{unit}": self.type_b,
            "slope": lin and lin.line.slope,
            "intercept": lin and lin.line.intercept,
            "full_scale": self.full_scale,
            "sample_size": size and size.to_json(UNIT[self.kind]),
            "points": {
                "linearity": [
                    _point(point) | {"fit": point.mean - float(residual), "residual": float(residual)}
                    for point, residual in zip(lin.points, lin.line.residual, strict=True)
                ]
                if lin
                else [],
                "repeat": [
                    _point(point)
                    | {
                        "used": point.used.tolist(),
                        "standard_deviation": None if point.n < 2 else point.standard_deviation,
                        "bias_error": point.bias_error,
                        "random_error": None if point.n < 2 else point.random_error,
                    }
                    for point in (rep.points if rep else ())
                ],
            },
            "warnings": self.warnings,
        }


def _point(point: SetPoint) -> dict[str, Any]:
    return {
        "set_point": point.set_point,
        "reference": point.reference,
        "readings": point.readings.tolist(),
        "mean": point.mean,
    }


def set_points(points: Points, test: str, *, drop_extremes: bool) -> tuple[SetPoint, ...]:
    """The readings of one test ("linearity" or "repeat") grouped by set-point, ascending.

    ``drop_extremes`` leaves out the smallest and the largest reading of a set-point (METHOD 1), from five readings on.
    """
    chosen = points.take(points.test == test)
    found = []
    for value in np.unique(chosen.set_point):
        here = chosen.set_point == value
        readings, references = chosen.gyro[here], chosen.reference[here]
        used = np.ones(len(readings), bool)
        if drop_extremes and len(readings) >= FEWEST_TO_DROP:
            order = np.argsort(readings - references, kind="stable")
            used[order[[0, -1]]] = False
        found.append(SetPoint(float(value), references, readings, used))
    return tuple(found)


def linearity(points: tuple[SetPoint, ...], full_scale: float, decimals: int | None = None) -> Linearity:
    """The line through the means of two or more set-points; ``decimals`` rounds the means first, as a table does."""
    mean = np.array([point.mean for point in points])
    reference = np.array([point.reference for point in points])
    return Linearity(points, line(reference, mean if decimals is None else np.round(mean, decimals)), full_scale)


def evaluate(
    points: Points,
    full_scale: float,
    *,
    kind: str,
    type_b: float = 0.0,
    ci: float = CI,
    expected: Mapping[str, Sequence[float]] | None = None,
    warnings: Sequence[Told] = (),
) -> TestResult:
    """Everything that thesis 5.1-5.9 says of one axis' readings.

    ``kind`` is "rate" (deg/s) or "position" (deg); ``full_scale`` is r0 in that unit; ``expected`` names the set-points
    that each test should have. What is missing is said in ``warnings``; nothing raises for want of readings.
    """
    told = list(warnings)
    straight = set_points(points, "linearity", drop_extremes=False)
    repeats = set_points(points, "repeat", drop_extremes=True)
    for test, present in (("linearity", straight), ("repeat", repeats)):
        told += _missing(test, present, (expected or {}).get(test, ()), UNIT[kind])
    repeats = tuple(point for point in repeats if point.n > 1)
    result = TestResult(
        kind,
        full_scale,
        linearity(straight, full_scale) if len(straight) > 1 else None,
        Repeatability(repeats, full_scale) if repeats else None,
        type_b,
        ci,
        told,
    )
    if (size := result.sample_size) and not size.enough:
        told.append({"code": "test.too_few_repeats", "values": size.to_json(UNIT[kind])["values"]})
    return result


def word(test: str) -> Told:
    """The name of a test inside a sentence, said in the reader's language."""
    return {"code": f"test_name.{test}", "values": {}}


def _missing(test: str, present: tuple[SetPoint, ...], expected: Sequence[float], unit: str) -> list[Told]:
    there = {round(point.set_point, 6) for point in present}  # what a segment's name resolves
    absent = [at for at in expected if round(at, 6) not in there]
    named = {"test": word(test), "unit": unit}
    told = []
    if absent:
        told.append({"code": "test.set_points_missing", "values": {**named, "set_points": absent}})
    most = max([len(point.readings) for point in present] + [2 if test == "repeat" else 1])
    for point in present:
        if len(point.readings) < most:
            values = {**named, "set_point": point.set_point, "got": len(point.readings), "of": most}
            told.append({"code": "test.readings_missing", "values": values})
    return told
