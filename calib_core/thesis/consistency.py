"""Printed values against one another, and readings against the grids that their instruments leave in them."""

from collections.abc import Iterator, Mapping
from itertools import product

import numpy as np
import numpy.typing as npt

from calib_core import linearity
from calib_core.thesis.compare import Cells, Disagreement, number, tell, word
from calib_core.thesis.printed import BOARD_AXES, Key, step
from calib_core.thesis.tables import Test

F64 = npt.NDArray[np.float64]

CONVERTER_MV = 5000.0 / 4096.0
"""The USB-6008's step: 12 bits over +-2.5 V."""
GRID_DPS = (0.12, 0.30)
"""Where a step of raw converter codes is looked for: 0.7 to 1.8 mV at 5.9 mV/(deg/s)."""
ON_GRID = 0.98
"""|mean of exp(2 pi i y / step)|: 1 on a grid, about 1/sqrt(n) off it; no chance reaches this with 36 readings."""


def state_list(cells: Cells) -> Iterator[Disagreement]:
    """Each axis is estimated, rate tested and position tested once; the printed list of states is held against that."""
    listed = [cell for cell in cells.values() if cell.key.table == "list of states"]
    missing = set(product(("estimate", "rate", "position"), "xz"))
    for cell in listed:
        if (cell.printed, cell.key.axis) in missing:
            missing.remove((cell.printed, cell.key.axis))
        else:
            first = next(c.key.row for c in listed if (c.printed, c.key.axis) == (cell.printed, cell.key.axis))
            kind = sorted(missing)[0][0]
            named, left = (word(f"state.{kind}_{cell.key.axis}") for kind in (cell.printed, kind))
            yield tell(cell, None, "state_named_twice", first=first, named=named, missing=left)


def same_gyro(cells: Cells) -> Iterator[Disagreement]:
    """Table 5.2 against 5.19: the axis whose bias is the same gyro's should have its scale factor too."""
    bias, scale = (cells[Key("5.2", "", "", "estimated", name)] for name in ("bias", "scale_factor"))
    for board, axis in BOARD_AXES:
        other_bias, other = (cells[Key("5.19", board, axis, "", name)] for name in ("bias", "scale_factor"))
        if other_bias.same(number(bias)) and not scale.same(number(other)):
            yield tell(scale, number(other), "printed_twice", other_table="5.19", other_board=board, other_axis=axis)


def worked_sample_size(cells: Cells) -> Iterator[Disagreement]:
    """The worked case of (5.3-5.6): what N is with d = CI/2, and which slip gives the printed one."""
    s, ci, t, n, printed = (
        cells[Key("equations 5.3-5.6", "", "", "worked case", name)]
        for name in ("standard_deviation", "ci", "t", "readings", "sample_size")
    )
    case = linearity.sample_size(number(s), number(ci), int(number(n)), number(t))
    if not printed.same(case.needed):
        slip = linearity.sample_size(number(s), 2.0 * number(ci), int(number(n)), number(t))
        code = "interval_for_half" if printed.same(slip.needed) else "not_reproduced"
        yield tell(printed, case.needed, code, ci=case.ci, d=case.d, readings=case.used, t=case.t)


def encoder_grid(test: Test) -> Iterator[Disagreement]:
    """References that no whole number of encoder steps gives."""
    size = step(test.kind)
    off = [
        (point, nearest)
        for point in test.straight.points
        if abs(point.reference - (nearest := size * round(point.reference / size))) > 1e-3
    ]
    if off:
        said = {"set_points": [p.set_point for p, _ in off], "step": size, "nearest": [round(n, 4) for _, n in off]}
        key = Key(test.linearity_table, test.board, test.axis, "", "reference")
        printed = ", ".join(f"{point.reference:.4f}" for point, _ in off)
        yield Disagreement(key, linearity.UNIT[test.kind], printed, None, "reference_off_grid", said)


def code_grid(cells: Cells, test: Test) -> Iterator[Disagreement]:
    """Tables whose gyro readings are raw converter codes rather than the filtered rate of (3.23)."""
    if test.kind != "rate":
        return
    scale = number(cells[Key("5.19", test.board, test.axis, "", "scale_factor")])
    for table, points in ((test.linearity_table, test.straight.points), (test.repeat_table, test.repeat.points)):
        readings = np.concatenate([point.readings for point in points])
        size, coherence = grid(readings)
        if coherence >= ON_GRID:
            yield Disagreement(
                Key(table, test.board, test.axis, "", "gyro"), linearity.UNIT["rate"], "", size, "raw_codes",
                {"step_mV": 1e3 * size * scale, "converter_mV": CONVERTER_MV, "readings": len(readings)},
            )  # fmt: skip


def grid(readings: F64) -> tuple[float, float]:
    """The step whose multiples (plus an offset) ``readings`` (n,) lie nearest to, and how near: 1 is on it."""
    low, high = GRID_DPS
    fine = 0.1 * low**2 / float(np.ptp(readings))  # a tenth of the peak's width
    for _ in range(2):
        steps = np.arange(low, high, fine)
        coherence = np.abs(np.exp(2j * np.pi * readings / steps[:, None]).mean(axis=1))
        best = int(np.argmax(coherence))
        low, high, fine = steps[best] - fine, steps[best] + fine, fine / 20
    return float(steps[best]), float(coherence[best])


def inconsistencies(cells: Cells, tests: list[Test]) -> list[Disagreement]:
    """All of the above."""
    found = [*state_list(cells), *same_gyro(cells), *worked_sample_size(cells)]
    for test in tests:
        found += [*encoder_grid(test), *code_grid(cells, test)]
    return found


def simulation_differs(cells: Cells, values: Mapping[Key, float]) -> Iterator[Disagreement]:
    """The study of 4.2: how far the printed and the simulated means are from what was set, in percent."""
    for name in ("bias", "scale_factor"):
        true, cell = number(cells[Key("4.2", "", "", "set", name)]), cells[Key("4.2", "", "", "mean", name)]
        value = values[cell.key]
        if not cell.same(value):
            off = {"printed_pct": 100.0 * (number(cell) / true - 1.0), "simulated_pct": 100.0 * (value / true - 1.0)}
            yield tell(cell, value, "simulation_differs", set=true, **off)
