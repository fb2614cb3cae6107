"""Hidden effects of a simulated gyro as text: ``bandwidth_lag.tau:0.006;z.bias_drift.r:1e-5`` (in a rig's address)."""

from collections.abc import Mapping
from dataclasses import replace

from calib_core.effects import Effect, library
from calib_core.model import Model
from calib_core.problem import Problem

AXES = ("x", "z")


def parse(text: str, own: Mapping[str, type[Effect]] | None = None) -> dict[str, list[Effect]]:
    """Effects by axis, of the library or a user's ``own``. Each part is ``[axis.]effect.parameter:value``; without an
    axis it holds for both.

    Raises Problem for an effect or parameter that does not exist, and a value that is no number or out of bounds.
    """
    effects = {**library(), **(own or {})}
    given: dict[str, dict[str, dict[str, float]]] = {axis: {} for axis in AXES}
    for part in filter(None, (p.strip() for p in text.split(";"))):
        path, _, number = part.partition(":")
        *axes, name, parameter = path.split(".") if path.count(".") in (1, 2) else ("", "", "")
        if name not in effects or (axes and axes[0] not in AXES):
            raise Problem("effects.unknown", given=part, allowed=", ".join(effects))
        known = effects[name].parameters()
        if parameter not in known:
            raise Problem("effects.parameter", given=part, effect=name, allowed=", ".join(known))
        low, high = known[parameter].bounds
        try:
            value = float(number)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise Problem("effects.value", given=part, lowest=low, highest=high)
        for axis in axes or AXES:
            given[axis].setdefault(name, {})[parameter] = value
    return {axis: [effects[name](**values) for name, values in named.items()] for axis, named in given.items()}


def with_effects(models: Mapping[str, Model], effects: Mapping[str, list[Effect]]) -> dict[str, Model]:
    """The same gyro with these effects as truth."""
    return {axis: replace(model, effects=tuple(effects.get(axis, ()))) for axis, model in models.items()}
