"""The effect library: one file an effect, found by the package (METHOD 4)."""

import importlib
import pkgutil
from functools import cache

from calib_core.effects.base import Acts, Chain, Covariates, Effect, Param, Stage

__all__ = ["Acts", "Chain", "Covariates", "Effect", "Param", "Stage", "library"]


@cache
def library() -> dict[str, type[Effect]]:
    """Every effect by its public name, in alphabetical order."""
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")
    own = [effect for effect in Effect.__subclasses__() if effect.__module__.startswith(f"{__name__}.")]
    return {effect.name: effect for effect in sorted(own, key=lambda effect: effect.name)}
