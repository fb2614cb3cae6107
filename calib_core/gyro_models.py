"""Gyro models: what the datasheet promises of each axis, and the ranges its tests run over."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from calib_core.problem import Problem


@dataclass(frozen=True)
class Datasheet:
    """One axis as its datasheet gives it: zero-rate output, scale factor, range (± deg/s)."""

    bias_V: float
    scale_factor_V_per_dps: float
    range_dps: float


@dataclass(frozen=True)
class Ranges:
    """Largest set-points of one axis. %FS refers to the span, twice these: the thesis' 200 deg/s and 240°."""

    rate_dps: float = 100.0
    position_deg: float = 120.0
    sine_deg: float = 30.0


@dataclass(frozen=True)
class GyroModel:
    """A kind of gyro: per axis the datasheet and the test ranges; limits of its output in V."""

    id: str
    name: str
    axes: Mapping[str, Datasheet]
    ranges: Mapping[str, Ranges]
    output_min_V: float = 0.0
    output_max_V: float = 3.0
    preset: bool = False

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, given: Mapping[str, Any]) -> "GyroModel":
        """The inverse of `to_json`; what `ranges` leaves out is the thesis' value.

        Raises `Problem` where a value is missing, not a number or not possible.
        """
        sheets, ranges = given.get("axes"), given.get("ranges") or {}
        if not isinstance(sheets, Mapping) or not sheets or not isinstance(ranges, Mapping):
            raise Problem("gyro_model.no_axes")
        low = _number(given, "output_min_V", 0.0)
        high = _number(given, "output_max_V", 3.0)
        if high <= low:
            raise Problem("gyro_model.value", name="output_max_V", given=high)
        return cls(
            id=str(given.get("id") or ""),
            name=str(given.get("name") or given.get("id") or ""),
            axes={axis: _datasheet(axis, sheet) for axis, sheet in sheets.items()},
            ranges={axis: ranges_from_json(ranges.get(axis)) for axis in sheets},
            output_min_V=low,
            output_max_V=high,
            preset=bool(given.get("preset", False)),
        )


def ranges_from_json(given: object, default: Ranges = Ranges()) -> Ranges:
    """`{"rate_dps": 100, …}` with any key left out taken from `default`; raises `Problem`."""
    if isinstance(given, Ranges):
        return given
    named = given if isinstance(given, Mapping) else {}
    return Ranges(**{name: _positive(named, name, value) for name, value in asdict(default).items()})


def _datasheet(axis: str, given: object) -> Datasheet:
    if axis not in ("x", "y", "z"):
        raise Problem("gyro_model.axis", given=axis)
    named = given if isinstance(given, Mapping) else {}
    scale_factor = _number(named, "scale_factor_V_per_dps")
    if scale_factor == 0.0:
        raise Problem("gyro_model.value", name="scale_factor_V_per_dps", given=0)
    return Datasheet(_number(named, "bias_V"), scale_factor, _positive(named, "range_dps"))


def _number(given: Mapping[str, Any], name: str, default: float | None = None) -> float:
    value = given.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise Problem("gyro_model.value", name=name, given="" if value is None else str(value))
    return float(value)


def _positive(given: Mapping[str, Any], name: str, default: float | None = None) -> float:
    value = _number(given, name, default)
    if value <= 0.0:
        raise Problem("gyro_model.value", name=name, given=value)
    return value


def _lpy503al(output: str, scale_factor: float, range_dps: float, ranges: Ranges) -> GyroModel:
    sheet = Datasheet(1.23, scale_factor, range_dps)
    return GyroModel(
        f"LPY503AL-{output}",
        f"ST LPY503AL, {output}",
        {"x": sheet, "z": sheet},
        {"x": ranges, "z": ranges},
        preset=True,
    )


# The 4xOUT output ends at ±30 deg/s: a 0.25 Hz sine may swing 19° at most, so its own ranges are smaller.
PRESETS: Mapping[str, GyroModel] = {
    model.id: model
    for model in (
        _lpy503al("OUT", 0.0083, 120.0, Ranges()),
        _lpy503al("4XOUT", 0.0333, 30.0, Ranges(rate_dps=25.0, position_deg=120.0, sine_deg=15.0)),
    )
}
