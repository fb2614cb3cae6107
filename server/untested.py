"""What a recording could not test, and why, in words: a verdict holds no further than its motion went."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

Words = dict[str, Any]

NEVER = ("input_loading",)
"""No recording shows it: it hides in bias and scale factor, and only the datasheet tells of it."""
TOLD_BY = {
    "temperature": ("bias_temperature", "thermal_lag", "scale_factor_temperature"),
    "supply": ("supply_sensitivity",),
    "other_rate": ("cross_axis",),
    "rate": ("scale_factor_quadratic", "scale_factor_cubic", "scale_factor_asymmetry", "saturation"),
    "angle": (
        "g_sensitivity", "g_squared_sensitivity", "encoder_eccentricity", "encoder_nonlinearity",
    ),
    "quick": ("bandwidth_lag", "time_offset", "angular_acceleration", "clock_skew"),
    "turns": ("dead_band", "hysteresis", "backlash"),
    "time": ("bias_drift", "bias_step", "warm_up", "bias_random_walk", "mains_hum", "adc_quantization"),
}  # fmt: skip
"""What a motion has to do enough of for these effects to show."""
WARMED_DEGC = 2.0
"""Past this it is not the temperature that was missing, but rates at several of them."""
RECORDED = ("temperature", "supply", "other_rate")
"""What a recording may not have at all."""


def rows(candidates: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Of the diagnosis' candidates those that another recording could test."""
    return [row for row in candidates if row["status"] != "tested" and row["effect"] not in NEVER]


def why(row: Mapping[str, Any], reach: Mapping[str, Any]) -> Words:
    """Why the recording could not test this candidate: a code and what it is filled with."""
    told_by = next((name for name, effects in TOLD_BY.items() if row["effect"] in effects), "other")
    if row["status"] == "no_data":
        return {"code": f"untested.no_{told_by if told_by in RECORDED else 'other'}", "values": {}}
    if row["effect"] == "scale_factor_temperature" and (reach["temperature_degC"] or 0.0) > WARMED_DEGC:
        told_by = "warm_rates"
    values = {name: None if size is None else float(f"{size:.2g}") for name, size in reach.items()}
    return {"code": f"untested.{told_by}", "values": values}


def reasons(candidates: Iterable[Mapping[str, Any]], reach: Mapping[str, Any]) -> list[Words]:
    """Each reason once, in the order of ``TOLD_BY``."""
    found = {said["code"]: said for said in (why(row, reach) for row in rows(candidates))}
    order = [f"untested.{part}{name}" for name in (*TOLD_BY, "warm_rates", "other") for part in ("no_", "")]
    return sorted(found.values(), key=lambda said: order.index(said["code"]))


def needed(candidates: Iterable[Mapping[str, Any]]) -> Iterator[Words]:
    """What a recording would have to hold beside this one's columns."""
    lacking = {row["effect"] for row in candidates if row["status"] == "no_data"}
    for name in RECORDED:
        if lacking & {*TOLD_BY[name]}:
            yield {"code": f"untested.needed.{name}", "values": {}}
