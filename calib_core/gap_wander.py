"""A bias that wanders (rate random walk, IEEE Std 952): its evidence, and a model that lets it wander.

A wandering bias looks like a step here and a drift there, or like noise correlated over as long as noise may be. So
where either was found, a walk in place of all slow shapes is weighed against them, by likelihood. A random walk about
its own mean is a sum of cosines over the record (its Karhunen-Loève series) with independent coefficients of deviation
k·sqrt(2T)/(πj); as columns with that much known beforehand they may stand in any model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_core.effects.base import Acts
from calib_core.gap_search import RIVAL, Search
from calib_core.gap_space import Space, Term
from calib_core.gap_unknown import Unknown

F64 = NDArray[np.float64]

SLOW = ("bias_drift", "bias_step", "warm_up", "thermal_lag", "bias_temperature", "supply_sensitivity", "unknown")
"""Shapes that a walk may look like."""
NEAR_LIMIT = 0.5
"""Of the longest correlation that noise may have."""
FASTEST_S, MOST = 4.0, 60
"""The series ends at half waves of this length: what is faster is noise."""
STRONG, FORM = 300.0, 0.3
EVIDENCE, AT_LIMIT = 16.0, 6.0
"""2ΔlnL over noise that does not wander; over noise that is as slow as it may be, which wanders in all but name."""
WORTH = 6.0
"""2ΔlnL that each size and setting of a slow shape gains by standing where it does best."""


@dataclass(frozen=True)
class Walk:
    """The wandering of a bias."""

    k: float
    """Output unit per root second."""
    relative_uncertainty: float
    two_delta_lnL: float
    """Over noise that does not wander, beside the same model."""
    named: bool
    """Whether it explains the record better than the slow shapes."""
    rivals: tuple[str, ...]
    """The slow shapes that, together, explain the record about as well; none where one side is plainly better."""


def wandering(search: Search) -> Walk | None:
    """The walk that explains the record better than the slow shapes of ``search`` do, or as well. Where it is named the
    space has it in its base from then on; otherwise nothing has changed."""
    space, given = search.space, search.given
    kept = [t for k, t in enumerate(search.chosen) if k < given or t.name not in SLOW]
    slow = [t for t in search.chosen[given:] if t.name in SLOW]
    noise = space.noise.noise
    at_limit = noise.ar1 > 0.0 and noise.correlation_time_s > NEAR_LIMIT * space.noise.longest_s
    if len(kept) == len(search.chosen) and not at_limit:
        return None
    was, now = space.noise, search.deviance(search.chosen)
    space.refit_noise(kept)
    plain = search.deviance(kept)
    shapes, deviations = _series(space)
    names = tuple(f"c{k}" for k in range(len(deviations)))
    waves = Term(Unknown, (), names, space.over_rows(Acts.OUTPUT, shapes), np.zeros(len(names)))
    space.refit_noise([*kept, waves])
    size = np.linspace(math.log(1e-3), math.log(1e3), 61) + math.log(noise.white * 0.1)
    deviance = np.array([_deviance(search, kept, waves, math.exp(u) * deviations) for u in size])
    best = int(np.argmin(deviance))
    # Noise that would be slower if it could speaks for the walk itself.
    slowest = noise.ar1 > 0.0 and noise.correlation_time_s >= 0.99 * space.noise.longest_s
    margin = 0.0 if slowest else RIVAL
    # Of what strong slow shapes explain, a share is always their form, which a walk mends without being one.
    margin += FORM * max(plain - now - STRONG, 0.0)
    gain = now - float(deviance[best]) - margin
    # A walk's waves are weighed with all their sizes, shapes are at their best.
    fitted = sum(t.freedom + len(t.setting) for t in slow)
    near = bool(slow) and abs(gain + margin) < RIVAL + WORTH * fitted
    if (
        deviance[best] > plain - (AT_LIMIT if slowest else EVIDENCE)
        or not (gain > 0.0 or near)
        or not 0 < best < len(size) - 1
    ):
        space.use_noise(was)
        return None
    if gain <= 0.0:
        space.use_noise(was)
    else:
        space.extend(shapes, 1.0 / (math.exp(size[best]) * deviations))
    h = float(size[1] - size[0])
    bend = float(deviance[best - 1] - 2.0 * deviance[best] + deviance[best + 1]) / h**2
    relative = math.sqrt(2.0 / bend) if bend > 0.0 else math.nan
    evidence = float(plain - deviance[best])
    return Walk(math.exp(size[best]), relative, evidence, gain > 0.0, tuple(t.name for t in slow) if near else ())


def _series(space: Space) -> tuple[F64, F64]:
    """(k, q) the cosines at the samples, and (q,) the deviations of their coefficients for a walk of k = 1."""
    time = space.covariates.time_s
    end = float(time[-1])
    j = np.arange(1, int(np.clip(end / FASTEST_S, 2, MOST)) + 1)
    return np.cos(np.pi / end * time[:, None] * j), np.asarray(math.sqrt(2.0 * end) / (math.pi * j), float)


def _deviance(search: Search, kept: list[Term], waves: Term, deviations: F64) -> float:
    """-2lnL with the walk's coefficients integrated out, up to the same constant as ``search.deviance``."""
    gram = search.space.gram([*kept, waves])
    free = [k for k, name in enumerate((n for t in kept for n in t.names), 1 + gram.base) if name]
    places = list(range(len(gram.scale) - len(deviations), len(gram.scale)))
    projected = gram.without(free)
    size = gram.scale[places] * deviations
    block = projected[np.ix_(places, places)] * np.outer(size, size) + np.eye(len(places))
    score = projected[places, 0] * size * gram.scale[0]
    factor = np.linalg.cholesky(block)
    inside = np.linalg.solve(factor, score)
    rest = projected[0, 0] * gram.scale[0] ** 2 - float(inside @ inside)
    return float(rest) + 2.0 * float(np.log(np.diag(factor)).sum()) + search.space.whitener.log_determinant
