"""Finds where what the thesis prints disagrees with its readings, or with itself.

Every finding comes out of a comparison: recomputed against printed at printed precision, summary against detail, one
printed value against another, readings against a grid. Where they differ, a few hypotheses are tried (truncated,
doubled twice, rounded line, other readings dropped, …) and the one that gives the printed value is named.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from calib_core import linearity
from calib_core.thesis.printed import LINES, SUMMARY, Cell, Key, as_number, step
from calib_core.thesis.tables import DECIMALS, Test
from calib_core.uncertainty import coverage_factor

STATISTICS = ("mean", "standard_deviation", "bias_error", "random_error")


@dataclass(frozen=True)
class Disagreement:
    """One printed value that does not follow; ``code`` and ``values`` are the sentence that says what was found."""

    key: Key
    unit: str
    printed: str
    recomputed: float | None
    code: str
    values: Mapping[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Place and figures, and all of them again among the sentence's ``values``."""
        key = self.key
        place = {"table": key.table, "board": key.board, "axis": key.axis, "row": key.row, "quantity": key.quantity}
        figures = {"printed": as_number(self.printed), "recomputed": self.recomputed, "unit": self.unit}
        said = {"printed": self.printed, "quantity": word(f"thesis_quantity.{key.quantity}")}
        values = {**place, **figures, **self.values, **said}
        return {**place, **figures, "code": f"finding.{self.code}", "values": values}


def word(code: str) -> dict[str, Any]:
    """A word inside a sentence, said in the reader's language."""
    return {"code": code, "values": {}}


Cells = Mapping[Key, Cell]
Values = Mapping[Key, float]


def disagreements(cells: Cells, values: Values, tests: list[Test]) -> list[Disagreement]:
    """All that comparing tables 5.3-5.18, 5.20, 5.21 and the lines with their readings finds."""
    found: list[Disagreement] = []
    for test in tests:
        found += statistics(cells, values, test)
        found += line(cells, values, test)
        found += residuals(cells, values, test)
        found += summary(cells, values, test)
    return found


def tell(cell: Cell, recomputed: float | None, code: str, **values: Any) -> Disagreement:
    return Disagreement(cell.key, cell.unit, cell.printed, recomputed, code, values)


def number(cell: Cell) -> float:
    value = cell.value
    assert value is not None, f"{cell.key} is printed as words"
    return value


def statistics(cells: Cells, values: Values, test: Test) -> Iterator[Disagreement]:
    """Mean, S, bias error and random error of each set-point, against the readings without their two extremes."""
    for point in test.repeat.points:
        row = test.repeat_table, test.board, test.axis, f"{point.set_point:g}"
        printed = {name: cells[Key(*row, name)] for name in STATISTICS}
        off = [name for name in STATISTICS if not printed[name].same(values[Key(*row, name)])]
        if not off:
            continue
        dropped = _other_drop(printed, point)
        for name in off:
            cell, value = printed[name], values[Key(*row, name)]
            if dropped is not None:
                extremes = point.readings[~point.used].tolist()
                yield tell(cell, value, "other_readings_dropped", dropped=dropped, extremes=extremes)
            elif off == ["bias_error"]:
                mean = number(printed["mean"])  # which is right, so the slip is in taking the difference
                yield tell(cell, value, "bias_error_alone", mean=mean, reference=point.reference)
            else:
                yield tell(cell, value, "not_reproduced")


def _other_drop(printed: Mapping[str, Cell], point: linearity.SetPoint) -> list[float] | None:
    """The two readings without which all four printed figures come out; None where no two do."""
    for pair in combinations(range(len(point.readings)), 2):
        used = np.ones(len(point.readings), bool)
        used[list(pair)] = False
        other = linearity.SetPoint(point.set_point, point.references, point.readings, used)
        figures = other.mean, other.standard_deviation, abs(other.bias_error), other.random_error
        if all(printed[name].same(figure) for name, figure in zip(STATISTICS, figures, strict=True)):
            return [float(point.readings[i]) for i in pair]
    return None


def line(cells: Cells, values: Values, test: Test) -> Iterator[Disagreement]:
    """Slope and intercept; where they do not come out, the one reference that would make them is looked for."""
    place = LINES[test.kind], test.board, test.axis, ""
    for name in ("slope", "intercept"):
        cell = cells[Key(*place, name)]
        if not cell.same(values[Key(*place, name)]):
            code, said = _why_line(cells, test)
            yield tell(cell, values[Key(*place, name)], code, **said)
    exact = linearity.linearity(test.straight.points, test.straight.full_scale).line
    for name, value in (("slope", exact.slope), ("intercept", exact.intercept)):
        cell = cells[Key(*place, name)]
        if cell.same(values[Key(*place, name)]) and not cell.same(value):
            yield tell(cell, value, "line_of_rounded_means", decimals=DECIMALS)


def _why_line(cells: Cells, test: Test) -> tuple[str, dict[str, Any]]:
    """The code and values of a line that does not come out.

    The printed fit column betrays what the thesis fitted: where one row is off the line through the others, its
    reference must have been another one. If the line through that one is the printed line, this is why.
    """
    points = test.straight.points
    reference = np.array([point.reference for point in points])
    fitted = np.array([number(_detail(cells, test, point, "fit")) for point in points])
    for i, point in enumerate(points):
        others = np.arange(len(points)) != i
        rest = linearity.line(reference[others], fitted[others])
        if np.abs(rest.residual).max() > 2e-4 or abs(fitted[i] - (rest.slope * reference[i] + rest.intercept)) < 2e-3:
            continue
        instead = reference.copy()
        instead[i] = (fitted[i] - rest.intercept) / rest.slope
        other = linearity.line(instead, np.round([point.mean for point in points], DECIMALS))
        place = LINES[test.kind], test.board, test.axis, ""
        if all(cells[Key(*place, name)].same(getattr(other, name)) for name in ("slope", "intercept")):
            said = {"set_point": point.set_point, "reference": point.reference, "instead": float(instead[i])}
            return "line_of_other_reference", said | {"steps": float(instead[i]) / step(test.kind)}
    return "not_reproduced", {}


def _detail(cells: Cells, test: Test, point: linearity.SetPoint, quantity: str) -> Cell:
    return cells[Key(test.linearity_table, test.board, test.axis, f"{point.set_point:g}", quantity)]


def residuals(cells: Cells, values: Values, test: Test) -> Iterator[Disagreement]:
    """The residual column, told once a table at its largest entry."""
    column = [_detail(cells, test, point, "residual") for point in test.straight.points]
    off = [cell for cell in column if not cell.same(values[cell.key])]
    if not off:
        return
    worst = max(column, key=lambda cell: abs(number(cell)))
    values_said = {"rows": len(off), "of": len(column)}
    exact = test.straight.line
    slope, intercept = round(exact.slope, DECIMALS), round(exact.intercept, DECIMALS)
    rounded = all(
        abs(number(_detail(cells, test, point, "fit")) - (slope * point.reference + intercept)) < 10.0**-DECIMALS
        for point in test.straight.points
    )
    code = "residuals_of_rounded_line" if rounded else "residuals_of_printed_line"
    yield tell(worst, values[worst.key], code, slope=slope, intercept=intercept, **values_said)


def summary(cells: Cells, values: Values, test: Test) -> Iterator[Disagreement]:
    """One axis' line of table 5.20 or 5.21 against its readings and against the detail tables it sums up."""
    for cell in cells.values():
        key = cell.key
        if (key.table, key.board, key.axis) != (SUMMARY[test.kind], test.board, test.axis):
            continue
        value = values[key]
        table, detail = _summed_up(cells, test, key.quantity)
        follows = cell.same(detail)
        if key.quantity == "uncertainty_type_a":
            if not cell.same(value):
                t = coverage_factor(test.repeat.worst.n - 1)
                yield tell(cell, value, "type_a_expanded", t=t, gives=t * value, off=abs(t * value - number(cell)))
        elif cell.same(value) and follows:
            continue
        elif cell.truncated(value) or cell.truncated(detail):
            yield tell(cell, value, "truncated", full=value)
        elif follows:
            yield tell(cell, value, "follows_detail", detail_table=table, detail=detail)
        elif abs(number(cell) - 2.0 * value) <= 2.0 * 10.0**-cell.decimals:
            yield tell(cell, value, "doubled_twice", detail_table=table, detail=detail)
        else:
            yield tell(cell, value, "summary_differs", detail_table=table, detail=detail)


def _summed_up(cells: Cells, test: Test, quantity: str) -> tuple[str, float]:
    """The detail table that a summary figure comes from, and what its printed columns give."""
    source = {
        "max_linearity_error": (test.linearity_table, "residual", 1.0),
        "nonlinearity": (test.linearity_table, "residual", 100.0 / test.straight.full_scale),
        "max_bias_error": (test.repeat_table, "bias_error", 1.0),
        "max_random_error": (test.repeat_table, "random_error", 1.0),
        "repeatability": (test.repeat_table, "random_error", 100.0 / test.repeat.full_scale),
        "max_standard_deviation": (test.repeat_table, "standard_deviation", 1.0),
        "uncertainty_type_a": (test.repeat_table, "standard_deviation", test.repeat.worst.n**-0.5),
    }
    table, column, factor = source[quantity]
    worst = max((number(cell) for key, cell in cells.items() if (key.table, key.quantity) == (table, column)), key=abs)
    return table, factor * (abs(worst) if quantity == "nonlinearity" else worst)
