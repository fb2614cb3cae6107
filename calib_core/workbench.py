"""A recording made ready to be looked at: what is missing, and any model fitted in a moment, with its pictures.

The diagnosis is made once; its noise stays for every model, so that floors and bands do not move between them. What a
picture needs comes as short columns: the signal at as many instants as a screen shows, residuals in windows of one
second (METHOD 2's weak form: good for pictures), their noise, and what they may depend on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calib_core.effects import Acts, Effect, library
from calib_core.gap import BY_ITSELF, Diagnosis, diagnose
from calib_core.gap_error import Error, Explanation, Failure, covariate_columns
from calib_core.gap_search import Search, equivalent_z
from calib_core.gap_space import Space, Term
from calib_core.problem import Problem
from calib_core.recording import Recording

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_MODELS = 64
"""So many fitted models are kept: an undo or a comparison costs nothing."""
SPECTRUM_SAMPLES = 1024
BINS = 16


@dataclass(frozen=True, eq=False)
class Fitted:
    """Base and effects on one recording."""

    effects: tuple[str, ...]
    explanation: Explanation
    space: Space

    @cached_property
    def _solution(self) -> tuple[F64, F64]:
        return self.explanation.solution()

    @cached_property
    def error(self) -> Error:
        return self.explanation.error()

    @cached_property
    def residual_dps(self) -> F64:
        """(w,) measured less modelled, mean rates in windows of one second."""
        return np.asarray(self.explanation.residual(self._solution[0]))

    @cached_property
    def spread_dps(self) -> F64:
        """(w,) one standard deviation of what noise gives each window."""
        return np.asarray(self.explanation.spread())

    @property
    def middle_s(self) -> F64:
        return np.asarray(self.explanation.middle_s)

    @cached_property
    def along(self) -> Mapping[str, F64]:
        """(w,) each covariate that moved, as the windows see it."""
        e = self.explanation
        at = {
            name: e.windows.mean(values[:, None])[e.first, 0]
            for name, values in covariate_columns(self.space).items()
            if name != "time_s"
        }
        return {name: values for name, values in at.items() if np.ptp(values) > 0.0}

    def failures(self) -> list[Failure]:
        return self.explanation.failures()

    @cached_property
    def modelled(self) -> F64:
        """(k,) what the model says the output was, at the samples."""
        space, values = self.space, self._solution[0]
        output = space.values[0] + values[0] + np.zeros(len(space.covariates.time_s))
        if len(space.values) > 1:
            output += (space.values[1] + values[1]) * space.covariates.rate_dps
        scale = space.scale_factor or 1.0
        at = space.base.shape[1]
        for term in self.explanation.terms:
            acts, shapes = space.shapes(term)
            shape = shapes @ values[at : at + shapes.shape[1]]
            if acts is Acts.ANGLE:
                output -= scale * np.gradient(shape, space.covariates.interval_s)
            else:
                output += shape * (scale if acts is Acts.RATE else 1.0)
            at += shapes.shape[1]
        return np.asarray(output)


@dataclass(eq=False)
class Workbench:
    """One axis of one recording. Raises Problem where it has no such axis, or no reference."""

    recording: Recording
    axis: str
    suspects: Mapping[str, type[Effect]] = field(default_factory=library)
    _models: dict[tuple[str, ...], Fitted] = field(default_factory=dict)
    _own: dict[str, type[Effect]] = field(default_factory=dict)

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """Of the base alone."""
        return diagnose(self.recording, self.axis, suspects=dict(self.suspects))

    @cached_property
    def space(self) -> Space:
        return self._search.space

    @cached_property
    def _search(self) -> Search:
        if self.diagnosis.search is None:
            failed = next(check for check in self.diagnosis.checks if check.blocking and not check.ok)
            raise Problem(failed.code, **failed.values)
        return self.diagnosis.search

    @cached_property
    def _shaped(self) -> dict[str, type[Effect]]:
        c = self.space.covariates
        return {n: e for n, e in self.suspects.items() if n not in BY_ITSELF and not e.missing(c)}

    @property
    def effects(self) -> tuple[str, ...]:
        """Those that can be put into a model of this recording."""
        return tuple(self._shaped)

    def own(self, effect: type[Effect]) -> None:
        """A user's own effect; one of the same name is forgotten, and every model with it."""
        before = self._own.get(effect.name)
        if before is not None and before.card() != effect.card():
            self._models = {names: f for names, f in self._models.items() if effect.name not in names}
        self._own[effect.name] = effect

    def fit(self, effects: Sequence[str] = ()) -> Fitted:
        """Base and ``effects``, nonlinear parameters refined. Raises Problem for one that cannot be here."""
        names = tuple(dict.fromkeys(effects))
        if names not in self._models:
            fitted = Fitted(names, Explanation(self.space, self._terms(names)), self.space)
            if len(self._models) >= MOST_MODELS:
                del self._models[next(iter(self._models))]
            self._models[names] = fitted
        return self._models[names]

    def _terms(self, names: tuple[str, ...]) -> list[Term]:
        if not names:
            return []
        effect = self._effect(names[-1])
        before = self.fit(names[:-1]).explanation.terms
        known = self._search._columns
        columns = {effect.name: known[effect.name]} if effect.name in known else {}
        search = Search(self.space, {effect.name: effect}, self._search.rng, chosen=[*before], _columns=columns)
        _, ranking = search.scan()
        grid = [t for t in search.terms() if t.name == effect.name]
        if not grid:
            raise Problem("diagnosis.effect_not_possible", effect=effect.name)
        term = ranking[0].term if ranking else grid[0]
        if ranking and (effect.nonlinear() or effect.curvature is not None):
            term, _ = search.refined(term, before)
        search.chosen = [*before, term]
        return search.chosen

    def _effect(self, name: str) -> type[Effect]:
        effect = self._own.get(name) or self._shaped.get(name)
        if effect is None or effect.missing(self.space.covariates):
            raise Problem("diagnosis.effect_not_possible", effect=name)
        return effect

    def ranked(self, effects: Sequence[str] = ()) -> dict[str, tuple[float, float]]:
        """2ΔlnL and equivalent |z| of every other effect beside base and ``effects``."""
        chosen = [*self.fit(effects).explanation.terms]
        search = Search(self.space, self._shaped, self._search.rng, chosen=chosen, _columns=self._search._columns)
        _, ranking = search.scan()
        return {s.term.name: (s.gain, float(equivalent_z(s.gain, len(s.term.names)))) for s in ranking}

    @property
    def threshold(self) -> float:
        """The |z| that noise alone reaches once in a hundred recordings, over every effect tried."""
        return self._search.threshold


def decimated(values: F64, most: int) -> Ints:
    """Indices of at most ``most`` values (k,): the lowest and the highest of each stretch, in order of time."""
    if len(values) <= most:
        return np.arange(len(values))
    stretches = max(1, most // 2)
    edges = np.linspace(0, len(values), stretches + 1).astype(int)
    picked = [b + np.array([values[b:e].argmin(), values[b:e].argmax()]) for b, e in pairwise(edges.tolist())]
    return np.unique(np.concatenate(picked))


def stretches(at: F64, residual: F64, spread: F64) -> tuple[F64, F64, F64]:
    """Middle, mean residual and its standard deviation (noise alone) in up to ``BINS`` parts of the covariate."""
    order = np.argsort(at, kind="stable")
    least = float(np.ptp(at)) / (3.0 * BINS)
    rows, begin = [], 0
    for end in [*(np.arange(1, BINS) * len(order) // BINS), len(order)]:
        part = order[begin:end]
        if len(part) > 3 and (at[part[-1]] - at[part[0]] >= least or end == len(order)):
            # Windows overlap by half: two neighbours count as one and a half.
            sigma = np.sqrt(np.mean(spread[part] ** 2) / len(part)) * 1.2
            rows.append((at[part].mean(), residual[part].mean(), sigma))
            begin = end
    table = np.array(rows).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2]


def spectrum(values: F64, interval_s: float) -> tuple[F64, F64]:
    """Frequencies (f,) in Hz and amplitude density (f,) per √Hz, by Welch's mean over Hann windows half overlapped."""
    n = min(SPECTRUM_SAMPLES, len(values))
    window = np.hanning(n)
    pieces = np.lib.stride_tricks.sliding_window_view(values, n)[:: max(1, n // 2)]
    power = np.mean(np.abs(np.fft.rfft((pieces - pieces.mean(axis=1, keepdims=True)) * window)) ** 2, axis=0)
    density = np.sqrt(2.0 * power * interval_s / np.sum(window**2))
    return np.asarray(np.fft.rfftfreq(n, interval_s)[1:]), np.asarray(density[1:], np.float64)
