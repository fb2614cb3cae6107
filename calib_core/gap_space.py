"""The whitened space in which models of one record are compared: rows, base, suspects' columns, and their Gram.

Rows are condensed and columns whitened once for each noise; whatever is asked of models after that (gains by Schur
complement, thresholds, errors on data left out) is asked of small matrices. METHOD 3, steps 2 and 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core.condense import Operator, condense, integrals
from calib_core.effects.base import Acts, Covariates, Effect
from calib_core.gap_gram import Bank, Folds, Gram
from calib_core.integral_fit import Design
from calib_core.noise_fit import NoiseFit, first_guess, fit_noise
from calib_core.whitening import RowNoise, Rows, Whitener

F64 = NDArray[np.float64]

OVERSTATED = 2.0
FEIGNED_STEPS = 0.014
"""A shape of this size, RMS in encoder steps, may come from the codes themselves."""
FINER = 8
LATE = 0.01
"""Lateness below this share of a sampling interval is as good as none."""
REMEMBERED = 24
"""So many terms beside the listed ones are kept whitened."""
TOGETHER = 8
"""So many terms, or columns, are whitened at a time."""
LONG = 60_000
"""Rows from which columns are kept in single precision: they are long, and rounding them is like noise of 10⁻⁷."""


@dataclass(frozen=True, eq=False)
class Term:
    """One effect at one setting of its nonlinear parameters, as columns (n, p) over the rows."""

    effect: type[Effect]
    setting: tuple[float, ...]
    names: tuple[str, ...]
    """The linear parameters that the columns belong to; "" for a column whose coefficient is one."""
    columns: F64
    slack: F64
    """(p,) variance of each coefficient that the encoder's codes may feign: their error is not quite noise."""

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def freedom(self) -> int:
        """How many coefficients are free; one where a setting is all there is."""
        return max(1, sum(map(bool, self.names)))

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
    settled: bool = field(default=False, kw_only=True)
    """Whether the values are already those of a good model: then they are kept."""
    guess: NoiseFit | None = field(default=None, kw_only=True)
    """The noise to begin with, where it was found already."""
    given: Design = field(init=False)
    """The design as it was given; in ``design`` readings that recur count as one."""
    rows: Rows = field(init=False)
    """The design's, condensed: (n,) of them."""
    base: F64 = field(init=False)
    """(n, b') their columns, and that of what sampling hides."""
    prior: F64 = field(init=False)
    """(b',) one over the standard deviation that a coefficient is known to have; 0 where nothing is known."""
    background: F64 = field(init=False)
    """(k, q) shapes of the output that the base has at last beside bias, rate and what sampling hides."""
    rough_noise: float = field(init=False)
    """Of one sample, from the scatter of neighbours."""
    noise: NoiseFit = field(init=False)
    whitener: Whitener = field(init=False)

    def __post_init__(self) -> None:
        design = self.given = self.design
        if design.readings is not None:
            # A motion that repeats the same codes does not average their error: each counts as one.
            variance = design.rows.reading_variance * design.readings.recurrence
            self.design = design = replace(design, rows=replace(design.rows, reading_variance=variance))
        self.rows, self._condensing = condense(design)
        fine = design.output(0.0)
        self._output, self._rate = self._condensing @ fine, self._condensing @ design.rate
        output = design.averages.samples.output
        scatter = float(np.median(np.abs(np.diff(output, 3)))) / (0.6745 * math.sqrt(20.0))
        if scatter == 0.0:
            # A coarse converter rounds the noise away; what it does instead is known no better than by its step.
            step = np.abs(np.diff(output))
            scatter = float(np.median(step[step > 0.0])) / math.sqrt(12.0)
        self.rough_noise = max(first_guess(design.rows, fine), 0.1 * scatter)
        self._least_noise = 0.9 * scatter
        self.folds = Folds.of(self.rows.time_s)
        one = np.ones((len(self.rows), 1))
        self.values = self.values[: 2 if design.moves else 1]
        rate = self._rate[:, None]
        if design.readings is not None:
            rate = self.over_rows(Acts.ANGLE, self.covariates.position_deg[:, None]) / -(self.scale_factor or 1.0)
        self.base = np.column_stack([one, rate]) if design.moves else one
        self.prior = np.zeros(self.base.shape[1])
        samples = design.averages.samples
        if design.readings is not None and design.moves and samples.average_s == 0.0:
            # Between point samples the output is a guess, wrong by about h²/8·ω'' where motion begins and ends: as much
            # as tells a lag from a delay of 3 ms. A column of that shape, with that size as its standard deviation.
            bend = np.gradient(self.felt, samples.interval_s)[:, None]
            self.base = np.column_stack([self.base, self.over_rows(Acts.ANGLE, bend)])
            self.prior = np.append(self.prior, 8.0 / samples.interval_s**2)
        self.background = np.empty((len(self.covariates.time_s), 0))
        self._last: RowNoise | None = None  # coloured noise as it was found last
        self._listed: tuple[Term, ...] = ()
        self._places: dict[int, list[int]] = {}
        if self.guess is None:
            self.refit_noise([])
        else:
            self.use_noise(self.guess)
        for _ in range(0 if self.settled else 2):
            step, _ = self.gram([]).coefficients([])
            self.values = self.values + step[: len(self.values)]
            self.use_noise(self.noise)

    @property
    def scale_factor(self) -> float:
        """Output per deg/s; 0 where nothing moved."""
        return float(self.values[1]) if len(self.values) > 1 else 0.0

    @property
    def residual(self) -> F64:
        """(n,) output less the base model's."""
        residual: F64 = self._output - self.values[0] - self.scale_factor * self._rate
        return residual

    @property
    def precision(self) -> type[np.floating[Any]]:
        """In which columns are kept."""
        return np.float32 if len(self.rows) > LONG else np.float64

    def refit_noise(self, terms: Iterable[Term]) -> None:
        """REML with the base and ``terms`` in the model, so that no effect poses as noise; whitens anew.

        The codes' error is a sawtooth, not white; overstated, it leaves nothing for AR(1) noise to pose as.
        """
        columns = np.column_stack([self.base, *(t.columns for t in terms)])
        rows = replace(self.rows, reading_variance=OVERSTATED * self.rows.reading_variance)
        start, longest = RowNoise(self.rough_noise), self.design.longest_noise_s
        noise = fit_noise(rows, self.residual, columns, self.scale_factor, start, None, self._last, longest_s=longest)
        if noise.noise.ar1 > 0.0:
            self._last = noise.noise
        least = math.log(self._least_noise)
        if noise.logarithms[0] < least:
            # Without rests the encoder's error hides the gyro's noise, but not from the output's own scatter.
            logarithms, covariance = noise.logarithms.copy(), noise.covariance.copy()
            logarithms[0], covariance[0], covariance[:, 0] = least, 0.0, 0.0
            noise = replace(noise, logarithms=logarithms, covariance=covariance)
        self.use_noise(noise)

    def use_noise(self, noise: NoiseFit) -> None:
        """Whitens with this noise from now on."""
        self.noise = noise
        self.whitener = Whitener(self.rows, self.scale_factor, noise.noise)
        self._bank: Bank | None = None
        self._whitened: dict[int, tuple[Term, F64]] = {}

    def extend(self, shapes: F64, prior: F64) -> None:
        """Puts shapes (k, p) of the output into the base, of whose coefficients ``prior`` (p,) is known: one over a
        deviation."""
        self.background = np.column_stack([self.background, shapes])
        self.base = np.column_stack([self.base, self.over_rows(Acts.OUTPUT, shapes)])
        self.prior = np.append(self.prior, prior)
        self.use_noise(self.noise)

    def forget(self) -> None:
        """Gives back the memory of a long record's whitened columns, and of what makes means of its samples; both are
        made again when they are asked for."""
        if len(self.rows) > LONG:
            self._bank = None
            self.design.averages.forget()

    def enlist(self, terms: Sequence[Term]) -> None:
        """These will be asked for together, again and again: their Gram matrix is made once for each noise."""
        self._listed, self._bank = tuple(terms), None

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
        columns = self.over_rows(acts, shapes).astype(self.precision, copy=False)
        return Term(effect, tuple(setting), names, columns, slack)

    def shapes(self, term: Term) -> tuple[Acts, F64]:
        """The term's columns (k, p) at the samples, and what they act on."""
        _, acts, shapes = self._shapes(term.effect, term.setting)
        return acts, shapes

    def _shapes(self, effect: type[Effect], setting: Sequence[float]) -> tuple[tuple[str, ...], Acts, F64]:
        if effect.curvature is not None:
            if self.design.readings is None:
                shapes = self._answered(effect, setting[0] if setting else 0.0)
                return (("",) * (shapes.shape[1] - 1)) + effect.linear(), Acts.RATE, shapes
            return effect.linear(), Acts.ANGLE, self._late(effect, setting)
        if effect.about and setting:
            return ("", *effect.linear()), *self._retimed(setting[0])
        # Nothing is remembered from one look to the next: each begins settled, as the recording does.
        begun = replace(self.covariates, memory={})
        named = effect.columns(begun, **dict(zip(effect.nonlinear(), setting, strict=True)))
        return tuple(named), effect.acts, np.column_stack([*named.values()])

    def brought(self, terms: Sequence[Term]) -> tuple[F64, F64, F64]:
        """Fitted with ``terms``: bias and scale factor; (k,) deg/s that the terms bring into the measured rate at the
        samples; (k,) deg that they bring into the encoder's angle."""
        k, (gram, free) = len(self.covariates.time_s) if terms else 1, self.free(terms)
        found = gram.coefficients(free)[0]
        sizes = np.ones(sum(len(t.names) for t in terms))
        sizes[[i - 1 - gram.base for i in free]] = found[gram.base :]
        base = self.values + found[: len(self.values)]
        rate, angle = np.zeros(k), np.zeros(k)
        for term in terms:
            own, sizes = sizes[: len(term.names)], sizes[len(term.names) :]
            acts, shapes = self.shapes(term)
            shape = shapes @ own
            if acts is Acts.ANGLE and term.effect.about:
                # In truth it is the gyro that is late, not the encoder that is early.
                rate -= np.gradient(shape, self.covariates.interval_s)
            elif acts is Acts.ANGLE:
                angle += shape
            else:
                # Sizes are those beside the scale factor that the columns were made with.
                rate += shape * (self.scale_factor if acts is Acts.RATE else 1.0) / base[1]
        return base, rate, angle

    def over_rows(self, acts: Acts, shapes: F64 | Operator) -> F64:
        """(n, p) in the unit of the output, from shapes (k, p) at the samples in what the effect acts on."""
        mean, change = self._operators
        if acts is not Acts.ANGLE:
            columns = mean @ shapes
            scale = self.scale_factor if acts is Acts.RATE else 1.0
        elif self.design.readings is None:
            # Without an encoder every row is samples in motion; at its rests an encoder's error does not change.
            averages = self.design.averages
            columns = self._condensing @ np.gradient(shapes, averages.samples.interval_s, axis=0)[averages.at]
            scale = -self.scale_factor
        else:
            columns, scale = change @ shapes, -self.scale_factor
        return np.asarray(scale * (columns if isinstance(columns, np.ndarray) else columns.toarray()))

    @cached_property
    def _operators(self) -> tuple[Operator, Operator]:
        """Sparse (n, k), from samples to means over the rows, and to changes."""
        mean, change = integrals(self.design.averages)
        return self._condensing @ mean, self._condensing @ change

    @property
    def felt(self) -> F64:
        """(k,) the measured rate, zero at rest; the reference's own where it is a rate."""
        if self.design.readings is None:
            return self.covariates.rate_dps
        moving = self.covariates.rate_dps != 0.0
        return np.where(
            moving, (self.design.averages.samples.output - self.values[0]) / (self.scale_factor or 1.0), 0.0
        )

    def _late(self, effect: type[Effect], setting: Sequence[float]) -> F64:
        """A late answer in terms of the measured rate w: the angle lags by w + κτ·w' + κ₃τ²·w''; τ is the setting."""
        assert effect.curvature is not None
        tau = setting[0] if setting else 0.0
        shape = self.felt
        if tau:
            slope = np.gradient(shape, self.covariates.interval_s)
            bend = np.gradient(slope, self.covariates.interval_s)
            shape = shape + effect.curvature * tau * slope + effect.third * tau**2 * bend
        sign = -1.0 if effect.name == "angular_acceleration" else 1.0
        return sign * shape[:, None]

    def _answered(self, effect: type[Effect], tau: float) -> F64:
        """(k, 1) what an answer late by little adds to a reference rate, for each second of lateness; (k, 2) about
        the lateness ``tau`` what it adds by itself, and how that changes."""
        c = self.covariates
        slope = np.gradient(c.rate_dps, c.interval_s)
        if effect.name == "angular_acceleration":
            return slope[:, None]
        if abs(tau) < LATE * c.interval_s or (effect.curvature == 0.0 and tau < 0.0):
            return -slope[:, None]

        def answer(tau: float) -> F64:
            if effect.curvature == 0.0:
                # Between samples the rate is curved, and a lag of less than a sample feels it.
                within = np.arange(FINER * (len(c.time_s) - 1) + 1) / FINER
                fine = self._curve(np.interp(within, np.arange(len(c.time_s)), c.time_s))
                return replace(c, memory={}, interval_s=c.interval_s / FINER).lagged(fine, tau, "")[::FINER]
            return self._curve(c.time_s - tau)

        little = 0.02 * abs(tau)
        change = (answer(tau + little) - answer(tau - little)) / (2.0 * little)
        return np.column_stack([answer(tau) - c.rate_dps - tau * change, change])

    def _retimed(self, skew: float) -> tuple[Acts, F64]:
        """(k, 2) about a clock that runs ahead by ``skew``: what that adds by itself, and how it changes."""
        from scipy.interpolate import CubicSpline

        c = self.covariates
        begin, end = c.time_s[0], c.time_s[-1]
        if self.design.readings is None:

            def answer(skew: float) -> F64:
                return self._curve(c.time_s * (1.0 - skew)) - c.rate_dps
        else:
            turned = np.concatenate([[0.0], np.cumsum(self.felt[1:] + self.felt[:-1])]) * c.interval_s / 2.0
            angle = CubicSpline(c.time_s, turned)

            def answer(skew: float) -> F64:
                """What the encoder is ahead of the gyro's integral W: (1 - s)·W(t/(1 - s)) - W(t)."""
                at = np.clip(c.time_s / (1.0 - skew), begin, end)
                return np.asarray((1.0 - skew) * angle(at) - turned)

        little = max(0.02 * abs(skew), 1e-9)
        change = (answer(skew + little) - answer(skew - little)) / (2.0 * little)
        shapes = np.column_stack([answer(skew) - skew * change, change])
        return (Acts.RATE if self.design.readings is None else Acts.ANGLE), shapes

    @cached_property
    def _curve(self) -> Callable[[F64], F64]:
        """The reference rate between its samples; a straight line there would be a filter."""
        from scipy.interpolate import CubicSpline

        c = self.covariates
        spline = CubicSpline(c.time_s, c.rate_dps)
        return lambda at_s: np.asarray(spline(np.clip(at_s, c.time_s[0], c.time_s[-1])))

    def white(self, columns: F64) -> F64:
        """(n, p) whitened columns."""
        if columns.ndim == 1 or columns.shape[1] <= TOGETHER:
            return self.whitener.whiten(columns)
        out = np.empty_like(columns)
        for begin in range(0, columns.shape[1], TOGETHER):
            few = slice(begin, begin + TOGETHER)
            out[:, few] = self.whitener.whiten(columns[:, few])
        return out

    def whitened(self, term: Term) -> F64:
        """(n, p) the term's columns, whitened."""
        if id(term) in self._places and self._bank is not None:
            return self._bank.white[:, self._places[id(term)]].astype(float)
        if id(term) not in self._whitened:
            if len(self._whitened) >= REMEMBERED:
                del self._whitened[next(iter(self._whitened))]
            self._whitened[id(term)] = (term, self.white(term.columns))
        return self._whitened[id(term)][1]

    def gram(self, terms: Sequence[Term], *, folds: bool = False) -> Gram:
        """The Gram matrix of the whitened residual, the base and the terms' columns; with ``folds``, in its parts."""
        bank, head = self.bank, 1 + len(self.prior)
        inside, own, order, ahead = list(range(head)), [], list(range(head)), 0
        for term in terms:
            count = term.columns.shape[1]
            if id(term) in self._places:
                order += range(len(inside), len(inside) + count)
                inside += self._places[id(term)]
            else:
                order += range(-1 - ahead, -1 - ahead - count, -1)
                own.append(self.whitened(term))
                ahead += count
        # Negative places count one's own columns, which stand behind the bank's.
        order = [k if k >= 0 else len(inside) - 1 - k for k in order]
        parts = bank.parts_with(inside, own, folds=folds)
        return Gram(parts[:, order][:, :, order], self.prior)

    def free(self, terms: Sequence[Term], *, folds: bool = False) -> tuple[Gram, list[int]]:
        """The terms' Gram matrix, and which of its columns have a coefficient that is not known to be one."""
        gram = self.gram(terms, folds=folds)
        named = [name for t in terms for name in t.names]
        fixed = [k for k, name in enumerate(named, 1 + gram.base) if not name]
        free = [k for k, name in enumerate(named, 1 + gram.base) if name]
        return (gram.known(dict.fromkeys(fixed, 1.0)) if fixed else gram), free

    def unrest(self, term: Term, held: F64, left: F64) -> float:
        """How much more the evidence for ``term`` scatters from block to block than the noise model has it, 1 or more.

        ``held`` (n, h) are orthonormal whitened columns of what is in the model, ``left`` (n,) the whitened residual
        beside them. Errors that come and go, and models of the wrong form, are uncertain in a way that no likelihood
        knows; scatter that blocks as few as these may show by chance does not count.
        """
        white = self.whitened(term)
        free = white - held @ (held.T @ white)
        along = free @ (np.ones(1) if term.fixed else np.linalg.lstsq(free, left, rcond=1e-6)[0])
        begin = self.folds.edges[:-1]
        score, own = np.add.reduceat(along * left, begin), np.add.reduceat(along**2, begin)
        whole = float(own.sum())
        if whole <= 0.0:
            return 1.0
        variance = own * (1.0 - own / whole)
        scatter = float(np.sum((score - own * (score.sum() / whole)) ** 2) / variance.sum())
        freedom = float(variance.sum() ** 2 / np.sum(variance**2))
        return max(1.0, scatter / (1.0 + 2.0 * math.sqrt(2.0 / freedom)))

    @property
    def bank(self) -> Bank:
        """The residual, the base and the listed terms, whitened with the noise of now."""
        if self._bank is None:
            together = [np.column_stack([self.residual, self.base])]
            self._places, at = {}, together[0].shape[1]
            white = np.empty((len(self.rows), at + sum(t.columns.shape[1] for t in self._listed)), self.precision)
            white[:, :at] = self.white(together[0])
            for begin in range(0, len(self._listed), TOGETHER):
                few = self._listed[begin : begin + TOGETHER]
                columns = np.column_stack([t.columns for t in few])
                white[:, at : at + columns.shape[1]] = self.white(columns)
                for term in few:
                    self._places[id(term)] = list(range(at, at + term.columns.shape[1]))
                    at += term.columns.shape[1]
            self._bank = Bank(self.folds, white)
        return self._bank
