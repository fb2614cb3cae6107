"""The certified numbers: what they are called, how they are written, and what a specification says of them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from calib_core.problem import Problem

MEASURED = ("value", "standard_uncertainty", "expanded_uncertainty")
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Field:
    """One certified number of an axis.

    ``path`` leads to it from the axis (CONTRACT 3 ``axes``), ``text`` is its name's key in the texts, ``unit`` what it
    is printed in, after multiplying by ``factor``. A measured one is an object with its own uncertainties, which give
    its digits; one that is an ``uncertainty`` itself has two significant digits; any other has ``decimals``.
    """

    path: tuple[str, ...]
    text: str
    unit: str
    factor: float = 1.0
    decimals: int | None = None
    uncertainty: bool = False

    @property
    def measured(self) -> bool:
        return self.decimals is None and not self.uncertainty

    def of(self, axis: Mapping[str, Any]) -> float | None:
        """The number in its stored unit; None where this axis has no such figure."""
        node: Any = axis
        for key in (*self.path, "value") if self.measured else self.path:
            node = node.get(key) if isinstance(node, Mapping) else None
        return None if node is None else float(node)

    def written(self, axis: Mapping[str, Any]) -> str:
        """As printed, in ``unit``: ``5.9482(31)`` or ``0.0213``; a dash where there is none."""
        value = self.of(axis)
        if value is None:
            return "–"
        if self.uncertainty:
            return two_digits(value * self.factor) if value > 0 else "0"
        if not self.measured:
            return f"{value * self.factor:.{self.decimals}f}"
        node: Any = axis
        for key in self.path:
            node = node[key]
        return concise(value * self.factor, node["standard_uncertainty"] * self.factor)


TEST_DECIMALS = {"rate": 4, "position": 3}
"""Of a test's errors: a mean of 20 readings is good to some 0.005 deg/s, and to 0.02 deg."""


def _test(kind: str, unit: str) -> tuple[Field, ...]:
    decimals = TEST_DECIMALS[kind]
    figures: tuple[tuple[str, str, int | None], ...] = (
        ("nonlinearity_pct_fs", "%FS", 3),
        ("repeatability_pct_fs", "%FS", 3),
        (f"max_linearity_error_{unit}", "", decimals),
        (f"max_bias_error_{unit}", "", decimals),
        (f"max_random_error_{unit}", "", decimals),
        (f"max_standard_deviation_{unit}", "", decimals),
        (f"uncertainty_type_a_{unit}", "", None),
        (f"uncertainty_type_b_{unit}", "", None),
    )
    shown = {"dps": "deg/s", "deg": "deg"}[unit]
    return tuple(
        Field((kind, name), f"figure.{name.removesuffix('_' + unit)}", given or shown, 1.0, places, places is None)
        for name, given, places in figures
    )


# One entry per certified number: JSON, CSV, PDF, pages and specifications all follow from this list.
FIELDS: tuple[Field, ...] = (
    Field(("bias_V",), "figure.bias", "V"),
    Field(("scale_factor_V_per_dps",), "figure.scale_factor", "mV/(deg/s)", 1e3),
    Field(("delay_s",), "figure.delay", "ms", 1e3),
    Field(("adaptive", "bias_V"), "figure.adaptive_bias", "V", decimals=5),
    Field(("adaptive", "scale_factor_V_per_dps"), "figure.adaptive_scale_factor", "mV/(deg/s)", 1e3, decimals=4),
    *_test("rate", "dps"),
    *_test("position", "deg"),
    Field(("step_check", "rate_error_pct"), "figure.step_rate_error", "%", decimals=3),
    Field(("step_check", "position_error_pct"), "figure.step_position_error", "%", decimals=3),
)


def concise(value: float, uncertainty: float) -> str:
    """``5.9482(31)``, ``45.6(1.2)``: the value, its standard uncertainty in units of its last two digits."""
    if not (math.isfinite(uncertainty) and uncertainty > 0):
        return f"{value:.6g}"
    decimals = _decimals(uncertainty)
    if decimals < 0:
        return f"{round(value, decimals):.0f}({round(uncertainty, decimals):.0f})"
    digits = two_digits(uncertainty)
    return f"{value:.{decimals}f}({digits.removeprefix('0.').lstrip('0') if digits < '1' else digits})"


def scaled(value: float, uncertainty: float) -> str:
    """``concise``, small values by a power of a thousand, as a person writes them: ``-4.45(48)e-6``."""
    power = max(0, -3 * math.floor(math.log10(abs(value)) / 3.0)) if 0.0 < abs(value) < 1e-3 else 0
    return concise(value * 10.0**power, uncertainty * 10.0**power) + (f"e-{power}" if power else "")


def two_digits(uncertainty: float) -> str:
    """An uncertainty > 0 to two significant digits, without an exponent: 0.000084, 0.10, 1.2, 120."""
    decimals = _decimals(uncertainty)
    return f"{round(uncertainty, decimals):.{max(0, decimals)}f}"


def _decimals(uncertainty: float) -> int:
    """Decimals that show two significant digits, and two still when 0.0996 rounds up to 0.10."""
    return 1 - math.floor(math.log10(float(f"{uncertainty:.1e}")))


# --- specification (CONTRACT 2) ----------------------------------------------------------------------------------
@dataclass(frozen=True)
class Limit:
    axis: str
    path: tuple[str, ...]
    low: float | None
    high: float | None


def _tree() -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for field in FIELDS:
        node = tree
        for key in field.path[:-1]:
            node = node.setdefault(key, {})
        node[field.path[-1]] = dict.fromkeys(MEASURED, "limit") if field.measured else "limit"
    return tree


def limits(spec: object) -> list[Limit]:
    """The limits of a specification. Raises Problem naming the key, what is allowed there and what was given."""
    whole = _mapping(spec, "spec")
    _known(whole, ("name", "axes"), "spec")
    if not isinstance(whole.get("name", ""), str):
        raise Problem("spec.name", given=whole["name"])
    axes = _mapping(whole.get("axes"), "axes")
    _known(axes, AXES, "axes")
    found = [limit for axis, node in axes.items() for limit in _limits(axis, (), node, _tree())]
    if not found:
        raise Problem("spec.empty")
    return found


def _limits(axis: str, path: tuple[str, ...], node: object, tree: Mapping[str, Any]) -> Iterator[Limit]:
    """Walks the spec beside the tree of certified numbers; a limit on a measured number applies to its ``value``."""
    where = ".".join(("axes", axis, *path))
    given = _mapping(node, where)
    if given and set(given) <= {"min", "max"} and set(tree) <= set(MEASURED):
        yield _limit(axis, (*path, "value"), given, where)
        return
    _known(given, tuple(tree), where)
    for key, child in given.items():
        if tree[key] == "limit":
            yield _limit(axis, (*path, key), _mapping(child, f"{where}.{key}"), f"{where}.{key}")
        else:
            yield from _limits(axis, (*path, key), child, tree[key])


def _limit(axis: str, path: tuple[str, ...], given: Mapping[str, object], where: str) -> Limit:
    _known(given, ("min", "max"), where)
    bounds: list[float | None] = []
    for key in ("min", "max"):
        bound = given.get(key)
        if bound is not None and (
            not isinstance(bound, int | float) or isinstance(bound, bool) or not math.isfinite(bound)
        ):
            raise Problem("spec.not_a_number", path=f"{where}.{key}", given=str(bound))
        bounds.append(None if bound is None else float(bound))
    low, high = bounds
    if low is None and high is None:
        raise Problem("spec.no_limit", path=where)
    if low is not None and high is not None and low > high:
        raise Problem("spec.crossed", path=where, low=low, high=high)
    return Limit(axis, path, low, high)


def _mapping(node: object, where: str) -> Mapping[str, Any]:
    if not isinstance(node, Mapping):
        raise Problem("spec.not_an_object", path=where)
    return node


def _known(given: Mapping[str, object], allowed: Sequence[str], where: str) -> None:
    for key in given:
        if key not in allowed:
            raise Problem("spec.unknown_key", path=f"{where}.{key}", allowed=", ".join(allowed))


def judge(axes: Mapping[str, Mapping[str, Any]], spec: object | None) -> tuple[str, list[dict[str, Any]]]:
    """Verdict "pass", "fail" or, without a spec, "issued"; and a row per limit.

    Simple acceptance: the value itself is compared, the magnitude of a signed error, uncertainty not deducted. A limit
    whose number was not measured is not met.
    """
    if spec is None:
        return "issued", []
    rows: list[dict[str, Any]] = []
    for limit in limits(spec):
        node: Any = axes.get(limit.axis)
        for key in limit.path:
            node = node.get(key) if isinstance(node, Mapping) else None
        value = None if node is None else float(node)
        # Errors have signs that depend on the direction of turning; a limit on one is a limit on its size.
        size = abs(value) if value is not None and "error" in limit.path[-1] else value
        ok = (
            size is not None and (limit.low is None or size >= limit.low) and (limit.high is None or size <= limit.high)
        )
        rows.append(
            {
                "axis": limit.axis,
                "path": list(limit.path),
                "min": limit.low,
                "max": limit.high,
                "value": value,
                "ok": ok,
            }
        )
    return ("pass" if all(row["ok"] for row in rows) else "fail"), rows
