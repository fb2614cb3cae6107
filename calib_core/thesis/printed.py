"""What the thesis prints, and its readings, as data files beside this module."""

import csv
import math
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Literal

from calib_core import points

Kind = Literal["rate", "position"]
KINDS: tuple[Kind, ...] = ("rate", "position")
BOARD_AXES = (("1", "x"), ("1", "z"), ("2", "x"), ("2", "z"))
"""The order of the thesis' tables within a kind of test."""
LINEARITY = {"rate": ("5.3", "5.4", "5.5", "5.6"), "position": ("5.11", "5.12", "5.13", "5.14")}
REPEAT = {"rate": ("5.7", "5.8", "5.9", "5.10"), "position": ("5.15", "5.16", "5.17", "5.18")}
SUMMARY = {"rate": "5.20", "position": "5.21"}
LINES = {"rate": "fig 5.10-5.13", "position": "fig 5.14-5.17"}
FULL_SCALE = {"rate": 200.0, "position": 240.0}
ENCODER_STEP_DEG = 300.0 / 1023.0
DIFFERENCE_S = 0.1
LINE_DIGITS = 4
"""Significant digits of the printed lines; all else is printed to a number of decimals."""


@dataclass(frozen=True)
class Key:
    """Where a value stands: ``row`` is the set-point or the row's name, "" where a table has one row an axis."""

    table: str
    board: str
    axis: str
    row: str
    quantity: str


@dataclass(frozen=True)
class Cell:
    """One printed value with its unit and the decimals it is printed to."""

    key: Key
    unit: str
    printed: str
    decimals: int

    @property
    def value(self) -> float | None:
        """The printed number, None where a table has words."""
        number = as_number(self.printed)
        return number if isinstance(number, float) else None

    def same(self, value: float | None) -> bool:
        """Whether ``value`` rounds to what is printed; a tie may round either way."""
        if self.value is None or value is None:
            return False
        return abs(value - self.value) <= 0.5 * 10.0**-self.decimals + 1e-9

    def truncated(self, value: float) -> bool:
        """Whether what is printed is ``value`` cut off where rounding would have raised it."""
        unit = 10.0**-self.decimals
        cut = math.copysign(math.floor(abs(value) / unit + 1e-9) * unit, value)
        return self.value is not None and not self.same(value) and abs(cut - self.value) < 0.5 * unit


def as_number(printed: str) -> float | str:
    try:
        return float(printed)
    except ValueError:
        return printed


def step(kind: Kind) -> float:
    """The step of a reference: one of the encoder's for angles, one over 0.1 s for rates."""
    return ENCODER_STEP_DEG / (DIFFERENCE_S if kind == "rate" else 1.0)


@cache
def cells() -> dict[Key, Cell]:
    """Every printed value, in the thesis' order."""
    text = _data("printed.csv").decode()
    listed = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    # Printers drop trailing zeros, so a column is as precise as its most precise entry.
    decimals: dict[tuple[str, str, str], int] = {}
    for row in listed:
        column = row["table"], row["quantity"], row["unit"]
        decimals[column] = max(decimals.get(column, 0), len(row["printed"].partition(".")[2]))
    found = {}
    for row in listed:
        key = Key(row["table"], row["board"], row["axis"], row["row"], row["quantity"])
        places = decimals[row["table"], row["quantity"], row["unit"]]
        if row["table"] in LINES.values():
            places = LINE_DIGITS - 1 - math.floor(math.log10(abs(float(row["printed"]))))
        found[key] = Cell(key, row["unit"], row["printed"], places)
    return found


@cache
def every_reading(kind: Kind) -> points.Points:
    """The thesis' readings of a kind, as this project's own ``gyro-points 1``."""
    return points.read(_data(f"{kind}.csv"))


def readings(kind: Kind, board: str, axis: str) -> points.Points:
    """One axis' readings of both tests of a kind, straight line and repeats."""
    every = every_reading(kind)
    return every.take((every.board == board) & (every.axis == axis))


def _data(name: str) -> bytes:
    return (resources.files("calib_core.thesis") / "data" / name).read_bytes()
