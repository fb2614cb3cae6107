"""The thesis' published readings, every table recomputed from them, and what does not agree.

Source: master's thesis on automatic calibration of low-cost two-axis gyroscopes, Suranaree University of Technology,
2013. Facts only: readings and printed figures.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any

from calib_core.thesis import compare, consistency, simulation
from calib_core.thesis.printed import BOARD_AXES, KINDS, LINEARITY, LINES, REPEAT, SUMMARY, Cell, Key, as_number, cells
from calib_core.thesis.tables import recompute, tests

SEEDS = 20


def report(seeds: int = SEEDS, *, progress: simulation.Progress | None = None) -> dict[str, Any]:
    """What `gyrobench thesis --json` prints; sentences are codes with values. ``seeds`` of the simulation of 4.2."""
    printed, made = cells(), tests()
    simulated = simulation.study(seeds, progress=progress)
    values = {**recompute(made), **_simulated(simulated)}
    found = compare.disagreements(printed, values, made)
    found += consistency.inconsistencies(printed, made)
    found += consistency.simulation_differs(printed, values)
    found.sort(key=lambda one: _order(one.key.table))
    return {
        "statistics": _count(cell.same(values[key]) for key, cell in printed.items() if key.table in _REPEATS),
        "lines": _count(_line_agrees(printed, values, table, axis) for table, axis in _lines(printed)),
        "disagreements": [one.to_json() for one in found],
        "tables": _tables(printed, values, simulated),
        "simulation": {"seeds": seeds, "frequency_hz": simulation.FREQUENCY_HZ, "duration_s": simulation.DURATION_S},
    }


_REPEATS = {table for kind in KINDS for table in REPEAT[kind]}


def _count(agrees: Iterator[bool]) -> dict[str, int]:
    listed = list(agrees)
    return {"printed": len(listed), "reproduced": sum(listed)}


def _lines(printed: Mapping[Key, Cell]) -> list[tuple[str, tuple[str, str]]]:
    return [(key.table, (key.board, key.axis)) for key in printed if key.quantity == "slope"]


def _line_agrees(printed: Mapping[Key, Cell], values: Mapping[Key, float], table: str, axis: tuple[str, str]) -> bool:
    keys = [Key(table, *axis, "", name) for name in ("slope", "intercept")]
    return all(printed[key].same(values[key]) for key in keys)


def _simulated(study: simulation.Study) -> dict[Key, float]:
    return {
        Key("4.2", "", "", "set", "bias"): simulation.BIAS_V,
        Key("4.2", "", "", "set", "scale_factor"): simulation.SCALE_FACTOR,
        Key("4.2", "", "", "mean", "bias"): float(study.bias_V["thesis"].mean()),
        Key("4.2", "", "", "mean", "scale_factor"): float(study.scale_factor["thesis"].mean()),
    }


def _tables(printed: Mapping[Key, Cell], values: Mapping[Key, float], study: simulation.Study) -> list[dict[str, Any]]:
    """Each table's rows with printed and recomputed side by side; recomputed is None where there are no readings."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for key, cell in printed.items():
        value = values.get(key)
        rows.setdefault(key.table, []).append(
            {
                "board": key.board,
                "axis": key.axis,
                "row": key.row,
                "quantity": key.quantity,
                "unit": cell.unit,
                "decimals": cell.decimals,
                "printed": as_number(cell.printed),
                "recomputed": value,
                "same": None if value is None else cell.same(value),
            }
        )
    for name in simulation.ESTIMATORS[1:]:
        for quantity_name, unit, decimals, mean in (
            ("bias", "V", 6, study.bias_V[name].mean()),
            ("scale_factor", "V/(deg/s)", 8, study.scale_factor[name].mean()),
        ):
            quantity = {"board": "", "axis": "", "row": f"mean, {name}", "quantity": quantity_name, "unit": unit}
            more = {"decimals": decimals, "printed": None, "recomputed": float(mean), "same": None}
            rows["4.2"].append(quantity | more)
    return [{"table": table, "title": _title(table), "rows": rows[table]} for table in sorted(rows, key=_order)]


def _title(table: str) -> dict[str, Any]:
    """The text that names a table; detail tables say whose they are."""
    for kind in KINDS:
        for test, named in (("linearity", LINEARITY), ("repeat", REPEAT)):
            if table in named[kind]:
                board, axis = BOARD_AXES[named[kind].index(table)]
                return {"code": f"thesis_table.{kind}_{test}", "values": {"board": board, "axis": axis}}
        for name, single in (("summary", SUMMARY), ("lines", LINES)):
            if table == single[kind]:
                return {"code": f"thesis_table.{kind}_{name}", "values": {}}
    return {"code": "thesis_table." + re.sub(r"\W+", "_", table), "values": {}}


def _order(table: str) -> tuple[int, float, str]:
    """Numbered tables first, by number; then figures, equations and sections."""
    number = re.fullmatch(r"(\d+)\.(\d+)", table)
    return (int(number[1]), int(number[2]), table) if number else (99, 0, table)
