"""The whitened space in which models of one record are compared: rows, base, suspects' columns, and their Gram.

One pass whitens the output, the base and every candidate column and forms their Gram matrix; everything after it (gains
by Schur complement, thresholds, refits) is small. METHOD 3, steps 2 and 3.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_core.effects.base import Acts, Covariates, Effect
from calib_core.integral_fit import Design
from calib_core.noise_fit import NoiseFit, first_guess, fit_noise
from calib_core.whitening import RowNoise, Whitener

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


OVERSTATED = 2.0
FEIGNED_STEPS = 0.014
"""A shape of this size, RMS in encoder steps, may come from the codes themselves."""


@dataclass(frozen=True, eq=False)
class Term:
    """One effect at one setting of its nonlinear parameters, as columns (n, p) over the rows."""

    effect: type[Effect]
    setting: tuple[float, ...]
    names: tuple[str, ...]
    """The linear parameters that the columns belong to; ("",) where the effect's size is its setting."""
    columns: F64
    slack: F64
    """(p,) variance of each coefficient that the encoder's codes may feign: their error is not quite noise."""

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def fixed(self) -> bool:
        """Whether the coefficient is known to be one: the setting says all."""
        return self.names == ("",)


@dataclass(eq=False)
class Space:
    """The rows of one record, linear about a base model, and the noise that whitens them.

    The residual uses the encoder as it is, whose error the noise model knows. The base's rate column does not: it comes
    from the position that gyro and encoder tell together, so it shares no error with the residual and needs no
    correction for errors in variables, and no smooth column can pass for the difference of the two.
    """

    design: Design
    covariates: Covariates
    values: F64
    """(b,) bias and, where something moved, scale factor."""
    base: F64 = field(init=False)
    """(n, b') their columns, and that of what sampling hides."""
    prior: F64 = field(init=False)
    """(b',) one over the standard deviation that a coefficient is known to have; 0 where nothing is known."""
    noise: NoiseFit = field(init=False)
    whitener: Whitener = field(init=False)

    def __post_init__(self) -> None:
        design = self.design
        if design.readings is not None:
            # A motion that repeats the same codes does not average their error: each counts as one.
            variance = design.rows.reading_variance * design.readings.recurrence
            self.design = design = replace(design, rows=replace(design.rows, reading_variance=variance))
        one = np.ones((len(design.rows), 1))
        self.values = self.values[: 2 if design.moves else 1]
        rate = design.rate[:, None]
        if design.readings is not None:
            rate = self.over_rows(Acts.ANGLE, self.covariates.position_deg[:, None]) / -(self.scale_factor or 1.0)
        self.base = np.column_stack([one, rate]) if design.moves else one
        self.prior = np.zeros(self.base.shape[1])
        samples = design.averages.samples
        if design.readings is not None and design.moves and samples.average_s == 0.0:
            # Between point samples the output is a guess, wrong by about h²/8·ω'' where motion begins and ends: as much
            # as tells a lag from a delay of 3 ms. A column of that shape, with that size as its standard deviation.
            bend = np.gradient(self._felt(), samples.interval_s)[:, None]
            self.base = np.column_stack([self.base, self.over_rows(Acts.ANGLE, bend)])
            self.prior = np.append(self.prior, 8.0 / samples.interval_s**2)
        self._output = design.output(0.0)
        third = np.abs(np.diff(design.averages.samples.output, 3))
        self._rough_noise = max(float(np.median(third)) / (0.6745 * math.sqrt(20.0)), 1e-12)
        self.refit_noise([])
        for _ in range(2):
            step, _ = self.gram([]).coefficients([])
            self.values = self.values + step[: len(self.values)]

    @property
    def scale_factor(self) -> float:
        """Output per deg/s; 0 where nothing moved."""
        return float(self.values[1]) if len(self.values) > 1 else 0.0

    @property
    def residual(self) -> F64:
        """(n,) output less the base model's."""
        residual: F64 = self._output - self.values[0] - self.scale_factor * self.design.rate
        return residual

    def refit_noise(self, terms: Iterable[Term]) -> None:
        """REML with the base and ``terms`` in the model, so that no effect poses as noise; whitens anew.

        The codes' error is a sawtooth, not white; overstated, it leaves nothing for AR(1) noise to pose as.
        """
        columns = np.column_stack([self.base, *(t.columns for t in terms)])
        rows, residual = self.design.rows, self.residual
        rows = replace(rows, reading_variance=OVERSTATED * rows.reading_variance)
        noise = fit_noise(rows, residual, columns, self.scale_factor, RowNoise(first_guess(rows, residual)))
        least = math.log(0.9 * self._rough_noise)
        if noise.logarithms[0] < least:
            # Without rests the encoder's error hides the gyro's noise, but not from the output's own scatter.
            logarithms, covariance = noise.logarithms.copy(), noise.covariance.copy()
            logarithms[0], covariance[0], covariance[:, 0] = least, 0.0, 0.0
            noise = replace(noise, logarithms=logarithms, covariance=covariance)
        self.use_noise(noise)

    def use_noise(self, noise: NoiseFit) -> None:
        """Whitens with this noise from now on."""
        self.noise = noise
        self.whitener = Whitener(self.design.rows, self.scale_factor, noise.noise)

    @property
    def doubt(self) -> float:
        """Relative standard uncertainty of the noise where effects live: its density at low frequency."""
        noise, interval = self.noise.noise, self.design.averages.samples.interval_s
        white, slow = noise.white**2 * interval, 2.0 * noise.ar1**2 * noise.correlation_time_s
        share = {"white": 2.0 * white, "ar1": 2.0 * slow, "correlation_time_s": slow}
        slope = np.array([share.get(name, 0.0) for name in self.noise.fields]) / (white + slow)
        return math.sqrt(max(float(slope @ self.noise.covariance @ slope), 0.0))

    def term(self, effect: type[Effect], setting: Sequence[float] = ()) -> Term:
        """The effect's columns over the rows."""
        names, acts, shapes = self._shapes(effect, setting)
        slack = np.zeros(len(names))
        if acts is Acts.ANGLE and self.design.readings is not None:
            moving = shapes[self.covariates.rate_dps != 0.0]
            size = FEIGNED_STEPS * self.design.readings.step_deg
            slack = size**2 / np.maximum(moving.var(axis=0), 1e-300)
        return Term(effect, tuple(setting), names, self.over_rows(acts, shapes), slack)

    def shapes(self, term: Term) -> tuple[Acts, F64]:
        """The term's columns (k, p) at the samples, and what they act on."""
        _, acts, shapes = self._shapes(term.effect, term.setting)
        return acts, shapes

    def _shapes(self, effect: type[Effect], setting: Sequence[float]) -> tuple[tuple[str, ...], Acts, F64]:
        if effect.curvature is not None:
            return effect.linear(), Acts.ANGLE, self._late(effect, setting)
        named = effect.columns(self.covariates, **dict(zip(effect.nonlinear(), setting, strict=True)))
        return tuple(named), effect.acts, np.column_stack([*named.values()])

    def over_rows(self, acts: Acts, shapes: F64) -> F64:
        """(n, p) in the unit of the output, from shapes (k, p) at the samples in what the effect acts on."""
        averages = self.design.averages
        single, between, (begin, at_begin), (end, at_end), dt = self._intervals
        out = np.zeros((len(averages.at), shapes.shape[1]))
        if acts is Acts.ANGLE:
            if self.design.readings is None:
                # Without an encoder every row is a sample in motion; at its rests an encoder's error does not change.
                out[single] = np.gradient(shapes, averages.samples.interval_s, axis=0)[averages.at[single]]
            out[between] = (_inside(shapes, end, at_end) - _inside(shapes, begin, at_begin)) / dt
            return -self.scale_factor * out
        out[single] = shapes[averages.at[single]]
        if len(dt):
            h = np.diff(averages.samples.time_s)[:, None]
            h[averages.samples.start[1:]] = 0.0
            total = np.zeros_like(shapes)
            np.cumsum(h * (shapes[1:] + shapes[:-1]) / 2.0, axis=0, out=total[1:])
            out[between] = (
                total[end] - total[begin] + h[end] * at_end * (shapes[end] + _inside(shapes, end, at_end)) / 2.0
                - h[begin] * at_begin * (shapes[begin] + _inside(shapes, begin, at_begin)) / 2.0
            ) / dt  # fmt: skip
        return (self.scale_factor if acts is Acts.RATE else 1.0) * out

    @cached_property
    def _intervals(self) -> tuple[Mask, Mask, tuple[Ints, F64], tuple[Ints, F64], F64]:
        """Which rows are samples and which are intervals; where intervals begin and end among the samples."""
        averages = self.design.averages
        between = averages.at < 0
        time = averages.samples.time_s

        def place(at_s: F64) -> tuple[Ints, F64]:
            k = np.clip(np.searchsorted(time, at_s, side="right") - 1, 0, len(time) - 2)
            return k, ((at_s - time[k]) / (time[k + 1] - time[k]))[:, None]

        begin, end = averages.begin_s[between], averages.end_s[between]
        return ~between, between, place(begin), place(end), (end - begin)[:, None]

    def _felt(self) -> F64:
        """(k,) the measured rate, zero at rest; the reference's own where it is a rate."""
        if self.design.readings is None:
            return self.covariates.rate_dps
        moving = self.covariates.rate_dps != 0.0
        return np.where(
            moving, (self.design.averages.samples.output - self.values[0]) / (self.scale_factor or 1.0), 0.0
        )

    def _late(self, effect: type[Effect], setting: Sequence[float]) -> F64:
        """A late answer in terms of the measured rate w: the angle lags by w + κτ·w'; τ is the setting."""
        assert effect.curvature is not None
        tau = setting[0] if setting else 0.0
        shape = self._felt()
        if tau:
            # In terms of the true rate, which only a reference rate tells, the series turns round.
            bend = effect.curvature if self.design.readings is not None else effect.curvature - 1.0
            shape = shape + bend * tau * np.gradient(shape, self.covariates.interval_s)
        sign = -1.0 if effect.name == "angular_acceleration" else 1.0
        return sign * shape[:, None]

    def white(self, columns: F64) -> F64:
        """(n + b', p) whitened columns, with room below for what is known beforehand."""
        return np.vstack([self.whitener.whiten(columns), np.zeros((len(self.prior), columns.shape[1]))])

    def gram(self, terms: Sequence[Term]) -> Gram:
        """Whitens the residual, the base and the terms' columns and forms their Gram matrix."""
        columns = [self.residual, self.base, *(t.columns for t in terms)]
        white = self.white(np.column_stack(columns))
        b = len(self.prior)
        white[-b:, 1 : 1 + b] = np.diag(self.prior)
        return Gram(white, b)


class Gram:
    """The scaled Gram matrix of [residual, base, columns], and what follows from it."""

    def __init__(self, white: F64, base: int) -> None:
        self.white = white
        self.base = base
        scale = np.sqrt(np.einsum("ij,ij->j", white, white))
        self.scale = np.where(scale > 0.0, scale, 1.0)
        self.matrix = (white / self.scale).T @ (white / self.scale)

    def without(self, kept: Sequence[int]) -> F64:
        """The matrix with the base and the columns ``kept`` (indices from 1 + base) projected out."""
        held = [*range(1, 1 + self.base), *kept]
        block = self.matrix[np.ix_(held, held)]
        weights = np.linalg.lstsq(block, self.matrix[held], rcond=1e-12)[0]
        out: F64 = self.matrix - self.matrix[:, held] @ weights
        return out

    def gain(self, projected: F64, columns: Sequence[int], term: Term) -> tuple[float, float]:
        """2ΔlnL of adding ``term``, which stands in ``columns``, and what of it its slack could not feign.

        NaN where what is projected out spans the columns. A coefficient that is known (``term.fixed``) is one.
        """
        block = projected[np.ix_(columns, columns)]
        if np.diag(block).min() < 1e-7:
            return float("nan"), float("nan")
        size = self.scale[list(columns)]
        score = projected[list(columns), 0] * self.scale[0]
        if term.fixed:
            gain = float(2.0 * score[0] * size[0] - block[0, 0] * size[0] ** 2)
            return gain, gain
        inverse = np.linalg.pinv(block, rcond=1e-9, hermitian=True)
        value = inverse @ score
        gain = float(score @ value)
        if not term.slack.any():
            return gain, gain
        return gain, float(value @ np.linalg.solve(inverse + np.diag(term.slack * size**2), value))

    def coefficients(self, columns: Sequence[int]) -> tuple[F64, F64]:
        """Coefficients and covariance of the base's corrections and of ``columns``."""
        held = [*range(1, 1 + self.base), *columns]
        block = self.matrix[np.ix_(held, held)]
        inverse = np.linalg.pinv(block, rcond=1e-12, hermitian=True)
        size = self.scale[held]
        return inverse @ self.matrix[held, 0] * self.scale[0] / size, inverse / np.outer(size, size)


def _inside(shapes: F64, at: Ints, fraction: F64) -> F64:
    """(r, p) values between the samples ``at`` (r,) and the next, ``fraction`` (r, 1) of the way."""
    return np.asarray(shapes[at] + fraction * (shapes[at + 1] - shapes[at]))
