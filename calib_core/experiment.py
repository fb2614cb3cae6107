"""The next experiment: the motion that would tell apart what the data in hand cannot (METHOD 3, step 9).

For every pair of rivals, were the first the truth: its fitted signal, in hand and in the motion, less all that base and
the second could explain of it, squared in the whitened space, is the 2ΔlnL to expect. The motion with the greatest
smallest such number over all pairs is proposed; where even that is too little, the answer says so by its code.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core import gap_unknown
from calib_core.effects import Effect
from calib_core.effects.base import Acts
from calib_core.effects.saturation import Saturation
from calib_core.excitation import Excitation, menu
from calib_core.gap import BY_ITSELF, Diagnosis
from calib_core.gap_search import settings
from calib_core.gap_space import Space, Term
from calib_core.gyro_models import PRESETS, GyroModel
from calib_core.prospect import Hand, clipping, imagine
from calib_core.recording import Recording
from calib_core.sequence import Axis

F64 = NDArray[np.float64]

DECIDES = 35.0
"""2ΔlnL to expect for a decision in 99 of 100 tries: it scatters by twice its root, and 6 must be passed."""
RIG: Mapping[str, Axis] = {
    axis: Axis(axis, -150.0, 150.0, rate, 300.0 / 1023.0, part, 12.1)
    for axis, rate, part in (("x", 326.0, "RX-28"), ("z", 254.0, "RX-64"))
}
"""The bench of HARDWARE, where no rig was chosen."""
LONGER = 3.0
"""A motion that brings too little may last so many times longer."""
NEARLY = 0.6
"""Of the most that a motion brings; what takes less time and brings this much is preferred."""
CLIPS = 16
"""Clip levels tried, from half of the fastest rate on."""

Motions = tuple[Excitation, ...]
Setting = tuple[float, ...]


@dataclass(frozen=True)
class Proposal:
    """What to do next, and what it would bring."""

    separates: tuple[str, ...]
    motion: Motions
    expected: float
    """Smallest 2ΔlnL to expect over the pairs, with the data in hand."""
    in_hand: float
    """The same from the data in hand alone."""
    kind: str = "rivals"
    """``rivals``, ``unknown`` or ``not_excited``."""
    offered: tuple[tuple[Motions, float], ...] = field(default=(), repr=False)
    """Every motion of the menu with what it would bring."""

    @property
    def duration_s(self) -> float:
        return sum(e.duration_s for e in self.motion)

    @property
    def decides(self) -> bool:
        return self.expected >= DECIDES

    def to_json(self) -> dict[str, Any]:
        """CONTRACT 3's ``next_experiment``; its sentence is rendered from code and values."""
        code = f"experiment.{self.kind}" if self.decides else "experiment.none_decides"
        values = {
            "effects": list(self.separates),
            "kinds": [e.kind for e in self.motion],
            "duration_s": self.duration_s,
            "expected": self.expected,
            "needed": DECIDES,
        }
        return {
            "separates": list(self.separates),
            "motion": [e.to_json() for e in self.motion],
            "duration_s": self.duration_s,
            "expected_two_delta_lnL": self.expected,
            "in_hand_two_delta_lnL": self.in_hand,
            "decides": self.decides,
            "code": code,
            "values": values,
        }


def propose(
    diagnosis: Diagnosis, rig: Mapping[str, Axis] = RIG, gyro_model: GyroModel | None = None
) -> Proposal | None:
    """The next experiment after this diagnosis on this rig, or None where nothing is open.

    First what ties the strongest finding, then structure without a name, then suspects that this motion never excited.
    """
    search = diagnosis.search
    if search is None or diagnosis.axis not in rig:
        return None
    named = [t for t in search.chosen if t.name != "unknown"]
    found = named[len(named) - len(diagnosis.rivals) :]
    sensor = ranges(diagnosis.recording, gyro_model)
    for own, rivals in zip(found, diagnosis.rivals, strict=True):
        if len(rivals) > 1:
            hand = Hand(diagnosis.recording, search.space, tuple(t for t in named if t is not own))
            return separate(hand, [r.term for r in rivals], rig, sensor)
    hand = Hand(diagnosis.recording, search.space, tuple(named))
    if diagnosis.unknown is not None:
        return explore(hand, diagnosis.unknown, rig, sensor)
    dormant = {row["effect"] for row in diagnosis.candidates if row["status"] == "not_excited"}
    return excite(hand, [e for name, e in search.suspects.items() if name in dormant], rig, sensor)


def separate(
    hand: Hand, rivals: Sequence[Term], rig: Mapping[str, Axis] = RIG, sensor: Mapping[str, float] | None = None
) -> Proposal:
    """The motion that tells ``rivals`` apart, each taken for the truth in turn, at the size it has in hand."""
    contest = Contest(hand, [(t.effect, t.setting, sizes_in(hand, t)) for t in rivals], [t.effect for t in rivals])
    pairs = list(permutations(range(len(rivals)), 2))

    def worst(columns: Columns) -> float:
        return min(contest.left(columns, i, j) for i, j in pairs)

    offered = tuple((motion, worst(columns)) for motion, columns in contest.played(rig, sensor))
    in_hand = worst(contest.in_hand)
    motion, expected = _cheapest(offered)
    more = (DECIDES - in_hand) / max(expected - in_hand, 1e-9)
    if 1.0 < more <= LONGER:
        motion = tuple(replace(e, duration_s=round(1.1 * more * e.duration_s, 1)) for e in motion)
        expected = worst(contest.after(motion))
        offered = (*offered, (motion, expected))
    return Proposal(tuple(t.name for t in rivals), motion, expected, in_hand, "rivals", offered)


def excite(
    hand: Hand,
    suspects: Sequence[type[Effect]],
    rig: Mapping[str, Axis] = RIG,
    sensor: Mapping[str, float] | None = None,
) -> Proposal | None:
    """The motion that would show most of ``suspects``, were they there at their typical size; None without any.

    ``separates`` names those that it would show; where there are none, the one that comes nearest.
    """
    truths = []
    for effect in suspects:
        if not effect.missing(hand.space.covariates) and effect.name not in BY_ITSELF:
            known = effect.parameters()
            setting = tuple(known[name].typical for name in effect.nonlinear())
            names = hand.space.term(effect, setting).names
            truths.append((effect, setting, np.array([known[n].typical if n else 1.0 for n in names])))
    if not truths:
        return None
    contest = Contest(hand, truths, [])
    found: Proposal | None = None
    best, offered = (-1, 0.0), []
    for motion, columns in contest.played(rig, sensor):
        brings = {truths[i][0].name: contest.left(columns, i) for i in range(len(truths))}
        seen = sorted((name for name in brings if brings[name] >= DECIDES), key=lambda n: -brings[n])
        seen = seen or [max(brings, key=lambda n: brings[n])]
        least = brings[seen[-1]]
        offered.append((motion, least))
        shown = len(seen) if least >= DECIDES else 0  # more suspects before stronger evidence
        if (shown, least) > best:
            best = (shown, least)
            found = Proposal(tuple(seen), motion, least, 0.0, "not_excited")
    return found


def explore(
    hand: Hand,
    unknown: gap_unknown.Structure,
    rig: Mapping[str, Axis] = RIG,
    sensor: Mapping[str, float] | None = None,
) -> Proposal:
    """The motion that would show most of a structure without a name: its evidence grows as its covariate is visited."""
    known, values = _visited(hand.space, unknown.covariate), _values(hand)
    offered = tuple(
        (motion, unknown.gain * (1.0 + _visited(imagine(hand, motion, values), unknown.covariate) / max(known, 1e-300)))
        for motion in _motions(hand, rig, sensor)
    )
    motion, expected = _cheapest(offered)
    return Proposal((unknown.covariate,), motion, expected, unknown.gain, "unknown", offered)


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
        self.values = _values(hand)
        self.fits = [[(e, s) for s in _tries(hand, e, [t[1] for t in truths if t[0] is e])] for e in fits]
        self._places: list[list[list[int]]] = []
        self._held: list[int] = []
        self.in_hand = self._columns(hand.space)

    def played(self, rig: Mapping[str, Axis], sensor: Mapping[str, float] | None) -> Iterator[tuple[Motions, Columns]]:
        """Each motion of the menu with the columns of both records."""
        for motion in _motions(self.hand, rig, sensor):
            yield motion, self.after(motion)

    def after(self, motion: Motions) -> Columns:
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
        """[signals, base, kept, fits at every setting], whitened."""
        found = [_term(space, effect, setting).columns @ sizes for effect, setting, sizes in self.truths]
        base = np.zeros((len(space.base), len(self.values)))
        base[:, : space.base.shape[1]] = space.base
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


def sizes_in(hand: Hand, term: Term) -> F64:
    """(p,) the coefficients of ``term`` in the data in hand, beside base and what is kept."""
    if term.fixed:
        return np.ones(1)
    gram = hand.space.gram([*hand.kept, term])
    free = list(range(1 + gram.base, gram.matrix.shape[0]))
    return gram.coefficients(free)[0][-len(term.names) :]


def ranges(recording: Recording, gyro_model: GyroModel | None = None) -> dict[str, float]:
    """Up to what rate (deg/s) each axis of the sensor may be turned, by its datasheet."""
    if gyro_model is None and "gyro_model" in recording.header:
        gyro_model = GyroModel.from_json(json.loads(recording.header["gyro_model"]))
    gyro_model = gyro_model or PRESETS["LPY503AL-OUT"]
    return {axis: sheet.range_dps for axis, sheet in gyro_model.axes.items()}


def _tries(hand: Hand, effect: type[Effect], own: Sequence[Setting]) -> list[Setting]:
    """The settings at which ``effect`` may explain another's signal: its grid, and where it stands already."""
    if effect is Saturation:
        c, values = hand.space.covariates, _values(hand)
        top = float(np.abs(c.rate_dps).max())
        limits = [values[0] + abs(values[1]) * top * part for part in np.linspace(0.5, 1.5, CLIPS)]
        return [*own, *((2.0 * values[0] - limit, limit) for limit in limits)]
    if effect.curvature is not None or not effect.nonlinear():
        return list(own) or [()]
    return [*own, *settings(effect, hand.space)]


def _motions(hand: Hand, rig: Mapping[str, Axis], sensor: Mapping[str, float] | None) -> list[Motions]:
    heat = hand.space.covariates.temperature_c is not None
    return [tuple(m) for m in menu(hand.axis, rig, sensor or ranges(hand.recording), heat=heat)]


def _cheapest(offered: Sequence[tuple[Motions, float]]) -> tuple[Motions, float]:
    """Of the motions that bring nearly the most, the one that takes least: in hands, then in time."""
    most = max(expected for _, expected in offered)
    good = [offer for offer in offered if offer[1] >= NEARLY * most]
    return min(good, key=lambda offer: (len(offer[0]), sum(e.duration_s for e in offer[0]), -offer[1]))


def _values(hand: Hand) -> F64:
    """(2,) bias and scale factor; the datasheet's where nothing has moved yet."""
    values = hand.space.values
    if len(values) > 1:
        return values
    unit = hand.space.design.averages.samples.unit
    sheet = PRESETS["LPY503AL-OUT"].axes["x"].scale_factor_V_per_dps
    return np.array([values[0], sheet if unit == "V" else 1.0])


def _term(space: Space, effect: type[Effect], setting: Setting) -> Term:
    return clipping(space, setting) if effect is Saturation else space.term(effect, setting)


def _visited(space: Space, covariate: str) -> float:
    """How much a record says about shapes along ``covariate``: their whitened squares beside the base, summed."""
    shapes = gap_unknown._shapes(space).get(covariate)
    if shapes is None:
        return 0.0
    white = space.whitener.whiten(np.column_stack([space.base, space.over_rows(Acts.OUTPUT, shapes)]))
    base = white[:, : space.base.shape[1]]
    free = white[:, base.shape[1] :]
    free = free - base @ np.linalg.lstsq(base, free, rcond=1e-10)[0]
    return float(np.sum(free**2))
