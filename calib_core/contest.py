"""What records can tell of rival effects: their signals, and what each leaves unexplained of another's.

A truth's signal, less all that base and a rival can explain of it at any setting, squared in the whitened space, is the
2ΔlnL to expect if that truth is true. It needs no fit and no noise, only columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from calib_core.effects import Acts, Effect, Param
from calib_core.effects.saturation import Saturation
from calib_core.excitation import Excitation
from calib_core.gap_search import settings
from calib_core.gap_space import Space, Term
from calib_core.gyro_models import PRESETS
from calib_core.prospect import Hand, clipping, imagine

F64 = NDArray[np.float64]
Setting = tuple[float, ...]

BASE = 3
"""Bias, scale factor, and what sampling hides."""
SHOWN = 17.6
"""2ΔlnL at which an effect is found four times in five (METHOD 3); what would give less, a record does not test."""
USUAL_V_PER_DPS = 5.9e-3
SHEET = PRESETS["LPY503AL-OUT"].axes["x"].scale_factor_V_per_dps
CLIPS = 16
"""Clip levels tried, from half of the fastest rate on."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Whitened columns as the R of their QR: lengths and angles are all that is asked of them."""

    r: F64

    @classmethod
    def of(cls, white: F64) -> Columns:
        """Of whitened columns (n, p), n ≥ p or not."""
        return cls(np.asarray(np.linalg.qr(white, mode="r")))

    def on_top_of(self, other: Columns) -> Columns:
        """Both records together."""
        return Columns.of(np.vstack([other.r, self.r]))

    def unexplained(self, signal: int, held: Sequence[int], less: int | None = None) -> float:
        """The square of column ``signal`` (less another one) that the columns ``held`` cannot explain."""
        target = self.r[:, signal] - (0.0 if less is None else self.r[:, less])
        known = self.r[:, held]
        size = np.linalg.norm(known, axis=0)
        known = known[:, size > 0.0] / size[size > 0.0]
        rest = target - known @ np.linalg.lstsq(known, target, rcond=1e-10)[0]
        return float(rest @ rest)


class Contest:
    """Signals of ``truths`` (effect, setting, sizes), and the columns with which ``fits`` would try to explain them."""

    def __init__(
        self, hand: Hand, truths: Sequence[tuple[type[Effect], Setting, F64]], fits: Sequence[type[Effect]]
    ) -> None:
        self.hand, self.truths = hand, truths
        self.values = values_of(hand)
        self.fits = [[(e, s) for s in _tries(hand, e, [t[1] for t in truths if t[0] is e])] for e in fits]
        self._places: list[list[list[int]]] = []
        self._held: list[int] = []
        self.in_hand = Columns.of(np.vstack([self._columns(hand.space).r, self._prior(hand.space)]))

    def after(self, motion: Sequence[Excitation]) -> Columns:
        """The columns of both records, once ``motion`` has been done."""
        return self._columns(imagine(self.hand, motion, self.values)).on_top_of(self.in_hand)

    def left(self, columns: Columns, truth: int, fit: int | None = None) -> float:
        """2ΔlnL to expect of ``truth`` over base and ``fit``, at whatever setting that does best."""
        if fit is None:
            return columns.unexplained(truth, self._held)
        if self.fits[fit][0][0] is Saturation:
            return min(columns.unexplained(truth, self._held, less=place[0]) for place in self._places[fit])
        return min(columns.unexplained(truth, [*self._held, *place]) for place in self._places[fit])

    def _columns(self, space: Space) -> Columns:
        """[signals, base, kept, fits at every setting], whitened. A bias that wanders begins anew in another record."""
        found = [_term(space, effect, setting).columns @ sizes for effect, setting, sizes in self.truths]
        q, own = self.hand.space.background.shape[1], space.base.shape[1] - space.background.shape[1]
        base = np.zeros((len(space.base), BASE + q))
        base[:, :own] = space.base[:, :own]
        if space is self.hand.space:
            base[:, BASE:] = space.base[:, own:]
        parts = [np.column_stack(found), base, *(_term(space, t.effect, t.setting).columns for t in self.hand.kept)]
        width = sum(p.shape[1] for p in parts)
        self._held = list(range(len(found), width))
        self._places = []
        for tries in self.fits:
            places = []
            for effect, setting in tries:
                columns = _term(space, effect, setting).columns
                places.append(list(range(width, width + columns.shape[1])))
                width += columns.shape[1]
                parts.append(columns)
            self._places.append(places)
        return Columns.of(space.whitener.whiten(np.column_stack(parts)))

    def _prior(self, space: Space) -> F64:
        """(1 + q, p) what is known beforehand: how much point samples may hide, a coefficient that both records share;
        and how far the bias wanders in this one."""
        q, first = space.background.shape[1], self._held[0]
        rows = np.zeros((1 + q, self._held[-1] + 1 + sum(len(p) for places in self._places for p in places)))
        if len(space.prior) - q == BASE:
            rows[0, first + BASE - 1] = space.prior[BASE - 1]
        rows[1 + np.arange(q), first + BASE + np.arange(q)] = space.prior[len(space.prior) - q :]
        return rows


def usual(space: Space, effect: type[Effect]) -> tuple[Setting, F64]:
    """The effect at the size that METHOD calls strength 1: its setting, and its coefficients (p,) in this unit."""
    known = effect.parameters()
    setting = tuple(known[name].typical for name in effect.nonlinear())
    if effect.name == "bias_step":
        setting = (float(space.covariates.time_s[-1]) / 2.0,)
    names = space.term(effect, setting).names
    sizes = np.array([known[n].typical if n else 1.0 for n in names])
    # Typical sizes of what acts on the output are volts of the thesis' gyro.
    volts = effect.acts is Acts.OUTPUT and space.design.averages.samples.unit != "V"
    return setting, sizes * (abs(space.scale_factor) or 1.0) / USUAL_V_PER_DPS if volts else sizes


def powers(space: Space, suspects: Mapping[str, type[Effect]], kept: Sequence[Term]) -> dict[str, float]:
    """2ΔlnL that each suspect of usual size would have, beside base and ``kept``, in the record of ``space``."""
    signals = [
        _term(space, effect, setting).columns @ sizes
        for effect in suspects.values()
        for setting, sizes in [usual(space, effect)]
    ]
    if not signals:
        return {}
    held = np.column_stack([space.base, *(t.columns for t in kept)])
    white = space.white(np.column_stack([held, *signals]))
    white[-len(space.prior) :, : len(space.prior)] = np.diag(space.prior)
    columns, width = Columns.of(white), held.shape[1]
    return {n: columns.unexplained(width + k, range(width)) for k, n in enumerate(suspects)}


def sizes_in(hand: Hand, term: Term) -> F64:
    """(p,) the coefficients of ``term`` in the data in hand, beside base and what is kept."""
    if term.fixed:
        return np.ones(1)
    gram = hand.space.gram([*hand.kept, term])
    free = list(range(1 + gram.base, gram.matrix.shape[0]))
    return gram.coefficients(free)[0][-len(term.names) :]


def _tries(hand: Hand, effect: type[Effect], own: Sequence[Setting]) -> list[Setting]:
    """The settings at which ``effect`` may explain another's signal: its grid, and where it stands already."""
    if effect is Saturation:
        c, values = hand.space.covariates, values_of(hand)
        top = float(np.abs(c.rate_dps).max())
        limits = [values[0] + abs(values[1]) * top * part for part in np.linspace(0.5, 1.5, CLIPS)]
        return [*own, *((2.0 * values[0] - limit, limit) for limit in limits)]
    if effect.about or not effect.nonlinear():
        return list(own) or [()]
    if effect.name == "bias_step":
        return [*own, *settings(effect, hand.space)]
    known = [effect.parameters()[name] for name in effect.nonlinear()]
    return [*own, *product(*(_range(p) for p in known))]


def _range(p: Param) -> tuple[float, ...]:
    """The grid of a nonlinear parameter, drawn out to its bounds: refined, a rival may end up there."""
    if not p.log:
        return p.grid
    low, high = p.bounds
    below = np.geomspace(low, p.grid[0], 4)[:-1].tolist() if low > 0.0 else ()
    return (*below, *p.grid, *np.geomspace(p.grid[-1], high, 4)[1:].tolist())


def values_of(hand: Hand) -> F64:
    """(2,) bias and scale factor; the datasheet's where nothing has moved yet."""
    values = hand.space.values
    if len(values) > 1:
        return values
    return np.array([values[0], SHEET if hand.space.design.averages.samples.unit == "V" else 1.0])


def _term(space: Space, effect: type[Effect], setting: Setting) -> Term:
    return clipping(space, setting) if effect is Saturation else space.term(effect, setting)
