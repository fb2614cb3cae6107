"""The thesis' tables computed again from its readings, through the functions that serve the instrument."""

from collections.abc import Mapping
from dataclasses import dataclass

from calib_core import linearity
from calib_core.thesis.printed import (
    BOARD_AXES,
    FULL_SCALE,
    KINDS,
    LINEARITY,
    LINES,
    REPEAT,
    SUMMARY,
    Key,
    Kind,
    readings,
)

DECIMALS = 4
"""The thesis' lines go through means as its tables print them."""


@dataclass(frozen=True, eq=False)
class Test:
    """One axis' rate or position test: where it is printed, and its result."""

    __test__ = False  # not a pytest class

    kind: Kind
    board: str
    axis: str
    linearity_table: str
    repeat_table: str
    straight: linearity.Linearity
    repeat: linearity.Repeatability


def tests() -> list[Test]:
    """The eight tests of tables 5.3-5.18."""
    found = []
    for kind in KINDS:
        for (board, axis), straight, repeat in zip(BOARD_AXES, LINEARITY[kind], REPEAT[kind], strict=True):
            result = linearity.evaluate(readings(kind, board, axis), FULL_SCALE[kind], kind=kind)
            assert result.linearity
            assert result.repeatability
            line = linearity.linearity(result.linearity.points, FULL_SCALE[kind], DECIMALS)
            found.append(Test(kind, board, axis, straight, repeat, line, result.repeatability))
    return found


def recompute(of: list[Test]) -> Mapping[Key, float]:
    """Every value that follows from readings: tables 5.3-5.18, 5.20, 5.21, the lines and the worked sample size."""
    found: dict[Key, float] = {}
    for test in of:
        axis = test.board, test.axis
        line = test.straight.line
        for point, residual in zip(test.straight.points, line.residual.tolist(), strict=True):
            row = test.linearity_table, *axis, f"{point.set_point:g}"
            found[Key(*row, "mean")] = point.mean
            found[Key(*row, "fit")] = line.slope * point.reference + line.intercept
            found[Key(*row, "residual")] = residual
        for point in test.repeat.points:
            row = test.repeat_table, *axis, f"{point.set_point:g}"
            found[Key(*row, "mean")] = point.mean
            found[Key(*row, "standard_deviation")] = point.standard_deviation
            found[Key(*row, "bias_error")] = abs(point.bias_error)
            found[Key(*row, "random_error")] = point.random_error
        found[Key(LINES[test.kind], *axis, "", "slope")] = line.slope
        found[Key(LINES[test.kind], *axis, "", "intercept")] = line.intercept
        summary = {
            "max_linearity_error": test.straight.max_error,
            "nonlinearity": test.straight.nonlinearity_pct_fs,
            "max_standard_deviation": test.repeat.max_standard_deviation,
            "repeatability": test.repeat.repeatability_pct_fs,
            "max_bias_error": test.repeat.max_bias_error,
            "max_random_error": test.repeat.max_random_error,
            "uncertainty_type_a": test.repeat.type_a,
        }
        found |= {Key(SUMMARY[test.kind], *axis, "", name): value for name, value in summary.items()}
    return found
