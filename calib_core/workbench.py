"""A recording laid out to be looked at: models fitted in a moment, and the short columns that their pictures need.

A picture shows the signal at as many instants as a screen has, residuals in windows of one second (METHOD 2's weak
form: good for pictures, not for decisions), what noise does to them, and what they may depend on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core import gap, gap_saturation, gap_spectrum
from calib_core.effects import Acts, Effect, library
from calib_core.gap_search import equivalent_z
from calib_core.gap_space import Space
from calib_core.noise_fit import NoiseFit
from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.whitening import RowNoise
from calib_core.workspace import Fitted, Workspace

F64 = NDArray[np.float64]

BY_THEMSELVES = ("saturation", "mains_hum")
"""Effects without a column that a model can have all the same: samples on a limit say nothing; a line is subtracted."""
MOST_MODELS = 64
"""So many fitted models are kept: an undo or a comparison costs nothing."""


@dataclass(frozen=True, eq=False)
class Model:
    """Base and effects on one recording, in the order in which they came."""

    effects: tuple[str, ...]
    fitted: Fitted
    clip: gap_saturation.Clip | None = None
    hum: gap_spectrum.Hum | None = None

    @property
    def space(self) -> Space:
        return self.fitted.explanation.space

    @property
    def parameters(self) -> list[dict[str, Any]]:
        """CONTRACT 3's list."""
        unit = self.space.design.averages.samples.unit
        found: list[tuple[str, float, str, float | None]] = []
        if self.clip is not None:
            limits = {"V_lo": self.clip.low, "V_hi": self.clip.high}
            found += [(f"saturation.{name}", value, unit, None) for name, value in limits.items() if value is not None]
        if self.hum is not None:
            found.append(("mains_hum.amplitude", self.hum.amplitude, unit, self.hum.amplitude_uncertainty))
            found.append(("mains_hum.f", self.hum.frequency_hz, "Hz", self.hum.frequency_uncertainty_hz))
        names = ("name", "value", "unit", "standard_uncertainty")
        return [*self.fitted.parameters, *(dict(zip(names, row, strict=True)) for row in found)]

    @cached_property
    def output(self) -> F64:
        """(k,) what the model says that the output was, at the samples."""
        space, values = self.space, self.fitted.explanation.solution[0]
        c = space.covariates
        output = np.full(len(c.time_s), space.values[0] + values[0])
        if len(space.values) > 1:
            output += (space.values[1] + values[1]) * c.rate_dps
        scale, at = space.scale_factor or 1.0, space.base.shape[1]
        for term in self.fitted.explanation.terms:
            acts, shapes = space.shapes(term)
            shape = shapes @ values[at : at + shapes.shape[1]]
            at += shapes.shape[1]
            if acts is Acts.ANGLE:
                output -= scale * np.gradient(shape, c.interval_s)
            else:
                output += shape * (scale if acts is Acts.RATE else 1.0)
        if self.hum is not None and np.isfinite(self.hum.A):
            phase = 2.0 * np.pi * self.hum.alias_hz * c.time_s
            output += self.hum.A * np.sin(phase) + self.hum.B * np.cos(phase)
        return output


@dataclass(eq=False)
class Workbench:
    """One axis of one recording. Raises Problem where it has no such axis, or no reference."""

    recording: Recording
    axis: str
    _models: dict[tuple[str, ...], Model] = field(default_factory=dict)
    _own: dict[str, type[Effect]] = field(default_factory=dict)
    _noise: RowNoise | None = None

    @cached_property
    def _parts(self) -> tuple[Workspace, Workspace | None, gap_saturation.Clip | None]:
        """All samples; those that are on no limit, and the limits, where these explain more than any other effect."""
        rng = np.random.default_rng(0)
        whole = gap.begin(self.recording, self.axis, library(), rng)
        clip = gap_saturation.find(self.recording, self.axis, whole.space.design, whole.space.rough_noise)
        made = Workspace(whole)
        if clip is None:
            return made, None, None
        kept = gap.begin(self.recording, self.axis, library(), rng, ~clip.clipped)
        if gap.clip_gain(whole, kept) is None:
            return made, None, None
        return made, Workspace(kept), clip

    @property
    def _whole(self) -> Workspace:
        return self._parts[0]

    @cached_property
    def _hum(self) -> gap_spectrum.Hum | None:
        design = self._whole.space.design
        found = gap_spectrum.find_hum(design.averages.samples, moving=design.moves)
        return found if found is not None and found.found else None

    @property
    def effects(self) -> tuple[str, ...]:
        """Those that a model of this recording can have."""
        return (*self._whole.effects, *BY_THEMSELVES)

    def settle(self, noise: NoiseFit) -> None:
        """Judges by this noise from now on: a search knows it beside all that it found, named or not."""
        if noise.noise == self._noise:
            return
        for workspace in filter(None, self._parts[:2]):
            workspace.space.use_noise(noise)
        self._noise = noise.noise
        self._models.clear()

    def own(self, effect: type[Effect]) -> None:
        """A user's own effect; models with another of the same name are forgotten."""
        before = self._own.get(effect.name)
        if before is not None and before.card() == effect.card():
            return
        if effect.missing(self._whole.space.covariates):
            raise Problem("diagnosis.effect_not_possible", effect=effect.name)
        self._own[effect.name] = effect
        self._models = {names: model for names, model in self._models.items() if effect.name not in names}
        for workspace in filter(None, self._parts[:2]):
            workspace.admit(effect)

    def fit(self, effects: Sequence[str] = ()) -> Model:
        """Raises Problem ``diagnosis.effect_not_possible`` for an effect that cannot be here."""
        names = tuple(dict.fromkeys(effects))
        if names not in self._models:
            if len(self._models) >= MOST_MODELS:
                del self._models[next(iter(self._models))]
            whole, kept, clip = self._parts
            clip = clip if "saturation" in names else None
            fitted = (kept if kept is not None and clip is not None else whole).fit(
                [name for name in names if name not in BY_THEMSELVES]
            )
            self._models[names] = Model(names, fitted, clip, self._hum if "mains_hum" in names else None)
        return self._models[names]

    def ranked(self, effects: Sequence[str] = ()) -> dict[str, tuple[float, float]]:
        """2ΔlnL and equivalent |z| of every other effect beside base and ``effects``."""
        model = self.fit(effects)
        whole, kept, _ = self._parts
        workspace = kept if kept is not None and model.clip is not None else whole
        freedom = {name: max(1, len(effect.linear())) for name, effect in {**library(), **self._own}.items()}
        gains = workspace.gains(model.fitted)
        return {name: (gain, float(equivalent_z(gain, freedom[name]))) for name, gain in gains.items()}
