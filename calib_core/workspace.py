"""One recording's axis, made ready once, in which models are tried by hand: the diagnosis' own arithmetic, no search.

workspace = Workspace.of(recording, "x")
fitted = workspace.fit(["bias_temperature"])
fitted.error.held_out_rms_dps, fitted.parameters, fitted.residual_dps, workspace.gains(fitted)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core.effects import Effect, library
from calib_core.gap import begin
from calib_core.gap_error import Error, Explanation, Failure
from calib_core.gap_report import parameters
from calib_core.gap_search import Search
from calib_core.gap_space import Term
from calib_core.problem import Problem
from calib_core.recording import Recording

F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model of base and chosen effects, fitted: what it says, and what it leaves."""

    explanation: Explanation
    two_delta_lnL: float
    """What the effects explain beside the base."""

    @property
    def effects(self) -> tuple[str, ...]:
        return tuple(term.name for term in self.explanation.terms)

    @cached_property
    def parameters(self) -> list[dict[str, Any]]:
        """CONTRACT 3's list: name, value, unit, standard uncertainty (None where the value is taken for granted)."""
        return parameters(self.explanation)

    @cached_property
    def error(self) -> Error:
        """RMS on blocks that were not seen, and the noise's part of it, in deg/s."""
        return self.explanation.error()

    @property
    def middle_s(self) -> F64:
        """(w,) the middle of each window of 1 s, from the first sample."""
        return self.explanation.middle_s

    @cached_property
    def residual_dps(self) -> F64:
        """(w,) measured less model."""
        return np.asarray(self.explanation.residual(self.explanation.solution[0]), np.float64)

    @cached_property
    def spread_dps(self) -> F64:
        """(w,) the standard deviation that noise gives each window."""
        return self.explanation.spread

    @cached_property
    def along(self) -> Mapping[str, F64]:
        """What to look at the residual against, by name: means over the windows."""
        return self.explanation.along()

    def failures(self) -> list[Failure]:
        """The worst stretch of each covariate, worst first."""
        return self.explanation.failures()


class Workspace:
    """Rows, noise and columns of one axis. The noise is that of base and best suspects, whatever is tried."""

    def __init__(self, search: Search) -> None:
        self.space, self._search = search.space, search
        search.prepare()

    @classmethod
    def of(cls, recording: Recording, axis: str, suspects: Mapping[str, type[Effect]] | None = None) -> Workspace:
        """Raises Problem for an axis that is not there, without a reference, too short or stuck."""
        pool = library() if suspects is None else dict(suspects)
        return cls(begin(recording, axis, pool, np.random.default_rng(0)))

    @property
    def effects(self) -> tuple[str, ...]:
        """The suspects that this recording has data for, and that have a shape."""
        return tuple(self._search.suspects)

    @property
    def axis(self) -> str:
        return self.space.covariates.axis

    @property
    def unit(self) -> str:
        return self.space.design.averages.samples.unit

    @property
    def noise(self) -> dict[str, float | None]:
        """CONTRACT 3's: of one sample, in deg/s."""
        noise, scale = self.space.noise.noise, abs(self.space.scale_factor) or 1.0
        return {
            "white_dps": noise.white / scale,
            "ar1_dps": noise.ar1 / scale,
            "correlation_time_s": noise.correlation_time_s if noise.ar1 > 0.0 else None,
        }

    def admit(self, effect: type[Effect]) -> None:
        """Takes one more suspect, a user's own; another of the same name makes room for it."""
        self._search.suspects[effect.name] = effect
        self._search.columns.pop(effect.name, None)
        self._search.terms()

    def fit(self, effects: Sequence[str] = (), fixed: Mapping[str, float] | None = None) -> Fitted:
        """Base and ``effects``, fitted together; those of their parameters that are in ``fixed``, by full name
        (``bias_V``, ``warm_up.tau``), keep the value given there.

        Raises Problem diagnosis.effect_not_possible for an effect that is not among the workspace's.
        """
        fixed = dict(fixed or {})
        search = Search(self.space, self._search.suspects, self._search.rng, columns=self._search.columns)
        for name in effects:
            if name not in self.effects:
                raise Problem("diagnosis.effect_not_possible", effect=name)
            search.chosen.append(self._first(search, name, fixed))
        for _ in range(2 if len(effects) > 1 else 1):
            for k, term in enumerate(search.chosen):
                if term.effect.about or set(term.effect.nonlinear()) - _own(fixed, term):
                    others = [*search.chosen[:k], *search.chosen[k + 1 :]]
                    search.chosen[k], _ = search.refined(term, others, _own(fixed, term))
        explanation = Explanation(self.space, search.chosen, fixed)
        return Fitted(explanation, search.chi2([]) - explanation.chi2)

    def gains(self, fitted: Fitted) -> dict[str, float]:
        """2ΔlnL of every other effect beside those of ``fitted``, each at its best point of the grid; best first."""
        terms = list(fitted.explanation.terms)
        search = Search(self.space, self._search.suspects, self._search.rng, chosen=terms, columns=self._search.columns)
        _, ranking = search.scan()
        return {s.term.name: s.gain for s in sorted(ranking, key=lambda s: -s.gain)}

    def _first(self, search: Search, name: str, fixed: Mapping[str, float]) -> Term:
        """The effect where it does best on its grid, beside those before it; where fixed, there."""
        effect = search.suspects[name]
        given = {k: fixed[f"{name}.{p}"] for k, p in enumerate(effect.nonlinear()) if f"{name}.{p}" in fixed}
        if effect.about and f"{name}.{effect.linear()[0]}" in fixed:
            return self.space.term(effect, [fixed[f"{name}.{effect.linear()[0]}"]])
        grid = search.columns[name]
        if given:
            settings = {tuple(given.get(k, v) for k, v in enumerate(t.setting)) for t in grid}
            grid = [self.space.term(effect, s) for s in sorted(settings)]
        return min(grid, key=lambda t: search.chi2([*search.chosen, t])) if len(grid) > 1 else grid[0]


def _own(fixed: Mapping[str, float], term: Term) -> set[str]:
    prefix = f"{term.name}."
    return {name.removeprefix(prefix) for name in fixed if name.startswith(prefix)}
