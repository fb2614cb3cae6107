"""The next experiment: the motion that would tell apart what the data in hand cannot (METHOD 3, step 9).

For every pair of rivals, were the first the truth: its fitted signal, in hand and in the motion, less all that base and
the second could explain of it, squared in the whitened space, is the 2ΔlnL to expect. The motion with the greatest
smallest such number over all pairs is proposed; where even that is too little, the answer says so by its code.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core import gap_unknown
from calib_core.contest import Columns, Contest, sizes_in, usual, values_of
from calib_core.effects import Effect
from calib_core.excitation import Excitation, menu
from calib_core.gap import BY_ITSELF, Diagnosis
from calib_core.gap_search import form
from calib_core.gap_space import Space, Term
from calib_core.gyro_models import PRESETS, GyroModel
from calib_core.problem import Problem
from calib_core.prospect import PAUSE_S, Hand, imagine
from calib_core.recording import Recording
from calib_core.sequence import Axis

F64 = NDArray[np.float64]

DECIDES = 50.0
"""2ΔlnL to expect for a decision in 99 of 100 tries: it scatters by twice its root, 6 must be passed, and the codes of
strokes that begin alike are worth some 5 either way."""
RIG: Mapping[str, Axis] = {
    axis: Axis(axis, -150.0, 150.0, rate, 300.0 / 1023.0, part, 12.1)
    for axis, rate, part in (("x", 326.0, "RX-28"), ("z", 254.0, "RX-64"))
}
"""The bench of HARDWARE, where no rig was chosen."""
LONGER = 4.0
"""A motion that brings too little may last so many times longer."""
NEARLY, PLENTY = 0.6, 2.0
"""What brings this share of the most, or this many times what decides, is as good where it takes less."""
Motions = tuple[Excitation, ...]


@dataclass(frozen=True)
class Offer:
    """A motion, and the 2ΔlnL to expect of it, with the data in hand, for each question asked."""

    motion: Motions
    evidence: tuple[float, ...]

    @property
    def duration_s(self) -> float:
        return sum(e.duration_s for e in self.motion)

    @property
    def settled(self) -> tuple[int, ...]:
        """The questions that it would decide."""
        return tuple(k for k, value in enumerate(self.evidence) if value >= DECIDES)

    @property
    def expected(self) -> float:
        """The smallest evidence of a question that it would decide; where it would none, the one it comes nearest."""
        return min((self.evidence[k] for k in self.settled), default=max(self.evidence))


@dataclass(frozen=True)
class Proposal:
    """What to do next, and what it would bring."""

    kind: str
    """``rivals``, ``unknown`` or ``not_excited``."""
    separates: tuple[str, ...]
    offer: Offer
    in_hand: float
    """The smallest evidence for a question that the motion would decide, from the data in hand alone."""
    remain: tuple[tuple[str, ...], ...] = ()
    """Rivals that would still be tied."""
    offered: tuple[Offer, ...] = field(default=(), repr=False)
    """The whole menu."""

    @property
    def motion(self) -> Motions:
        return self.offer.motion

    @property
    def expected(self) -> float:
        return self.offer.expected

    @property
    def decides(self) -> bool:
        return bool(self.offer.settled)

    def to_json(self) -> dict[str, Any]:
        """CONTRACT 3's ``next_experiment``; its sentence is rendered from code and values."""
        near = "probable" if self.expected >= DECIDES / 2.0 else "none_decides"
        code = f"experiment.{self.kind if self.decides else near}"
        values = {"duration_s": self.offer.duration_s, "expected": self.expected, "needed": DECIDES}
        return {
            "separates": list(self.separates),
            "motion": [e.to_json() for e in self.motion],
            "duration_s": self.offer.duration_s,
            "expected_two_delta_lnL": self.expected,
            "in_hand_two_delta_lnL": self.in_hand,
            "decides": self.decides,
            "remain": [list(names) for names in self.remain],
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
    late = any(t.effect.curvature is not None for t in named)
    suspects = [e for n, e in search.suspects.items() if n in dormant and not (late and e.curvature is not None)]
    return excite(hand, suspects, rig, sensor)


def separate(
    hand: Hand, rivals: Sequence[Term], rig: Mapping[str, Axis] = RIG, sensor: Mapping[str, float] | None = None
) -> Proposal:
    """The motion that tells most of ``rivals`` apart, each taken for the truth in turn at the size it has in hand.

    Some pairs no motion may tell apart (a warm-up slow enough is a drift): they are named in ``remain``.
    """
    contest = Contest(hand, [(t.effect, t.setting, sizes_in(hand, t)) for t in rivals], [t.effect for t in rivals])
    pairs = list(combinations(range(len(rivals)), 2))

    def told(columns: Columns, truth: int, rival: int) -> float:
        """Beyond what a tie between two so large would be allowed."""
        allowed = form(rivals[truth].effect, rivals[rival].effect, contest.left(columns, truth))
        return max(contest.left(columns, truth, rival) - allowed, 0.0)

    def evidence(columns: Columns) -> tuple[float, ...]:
        return tuple(min(told(columns, i, j), told(columns, j, i)) for i, j in pairs)

    offered = [Offer(motion, evidence(columns)) for motion, columns in _played(contest, rig, sensor)]
    before = evidence(contest.in_hand)
    best = _cheapest(offered)
    missing = [(DECIDES - h) / (e - h) for h, e in zip(before, best.evidence, strict=True) if h < e < DECIDES]
    more = [factor for factor in missing if factor < LONGER]
    if more:
        longer = tuple(replace(e, duration_s=round(1.1 * max(more) * e.duration_s, 1)) for e in best.motion)
        best = Offer(longer, evidence(contest.after(longer)))
        offered.append(best)
    names = tuple(t.name for t in rivals)
    tied = [(names[i], names[j]) for k, (i, j) in enumerate(pairs) if k not in best.settled]
    in_hand = min(before[k] for k in best.settled or range(len(pairs)))
    return Proposal("rivals", names, best, in_hand, _groups(names, tied), tuple(offered))


def excite(
    hand: Hand,
    suspects: Sequence[type[Effect]],
    rig: Mapping[str, Axis] = RIG,
    sensor: Mapping[str, float] | None = None,
) -> Proposal | None:
    """The motion that would show most of ``suspects``, were they there at their typical size; None where none would.

    ``separates`` names those that it would show.
    """
    truths = []
    for effect in suspects:
        if not effect.missing(hand.space.covariates) and effect.name not in BY_ITSELF:
            truths.append((effect, *usual(hand.space, effect)))
    if not truths:
        return None
    contest = Contest(hand, truths, [])

    def evidence(columns: Columns) -> tuple[float, ...]:
        return tuple(contest.left(columns, i) for i in range(len(truths)))

    offered = [Offer(motion, evidence(columns)) for motion, columns in _played(contest, rig, sensor)]
    best, before = _cheapest(offered), evidence(contest.in_hand)
    if not best.settled:
        return None
    names = tuple(truths[k][0].name for k in best.settled)
    return Proposal("not_excited", names, best, min(before[k] for k in best.settled), offered=tuple(offered))


def explore(
    hand: Hand,
    unknown: gap_unknown.Structure,
    rig: Mapping[str, Axis] = RIG,
    sensor: Mapping[str, float] | None = None,
) -> Proposal:
    """The motion that would show most of a structure without a name: its evidence grows as its covariate is visited."""
    known, values = _visited(hand.space, unknown.covariate), values_of(hand)
    offered = []
    for motion in _motions(hand, rig, sensor):
        more = _visited(imagine(hand, motion, values), unknown.covariate) / max(known, 1e-300)
        offered.append(Offer(motion, (unknown.gain * (1.0 + more),)))
    best = max(offered, key=lambda offer: offer.expected)
    return Proposal("unknown", (unknown.covariate,), best, unknown.gain, offered=tuple(offered))


def join(hand: Recording, run: Recording, axis: str, after_s: float = PAUSE_S) -> Recording:
    """The data in hand and an experiment's as one record of one board in one session, ``after_s`` between them.

    Raises Problem where they cannot be: another board, another unit, or samples that were taken in another way.
    """
    told = {
        "board": (hand.header.get("board", ""), run.header.get("board", "")),
        "unit": (hand.gyro(axis).unit, run.gyro(axis).unit),
        "gyro_average_s": (hand.header.get("gyro_average_s", "0"), run.header.get("gyro_average_s", "0")),
        f"{axis}_gyro_delay_s": tuple(r.header.get(f"{axis}_gyro_delay_s", "0") for r in (hand, run)),
    }
    for name, (before, now) in told.items():
        if before != now and not (name == "board" and "" in (before, now)):
            raise Problem("experiment.other_record", name=name, before=before, now=now)
    shift = hand.time_s[-1] + after_s - run.time_s[0]
    columns = {n: np.round(v + shift, 6) if n.endswith("time_s") else v for n, v in run.columns.items()}
    return Recording.join([hand, replace(run, time_s=np.round(run.time_s + shift, 6), columns=columns)])


def model_of(header: Mapping[str, str]) -> GyroModel | None:
    """The gyro model that a recording's header carries."""
    text = header.get("gyro_model", "")
    try:
        return GyroModel.from_json(json.loads(text)) if text else None
    except ValueError:
        return None


def ranges(recording: Recording, gyro_model: GyroModel | None = None) -> dict[str, float]:
    """Up to what rate (deg/s) each axis of the sensor may be turned, by its datasheet."""
    gyro_model = gyro_model or model_of(recording.header) or PRESETS["LPY503AL-OUT"]
    return {axis: sheet.range_dps for axis, sheet in gyro_model.axes.items()}


def _motions(hand: Hand, rig: Mapping[str, Axis], sensor: Mapping[str, float] | None) -> list[Motions]:
    heat = hand.space.covariates.temperature_c is not None
    return [tuple(m) for m in menu(hand.axis, rig, sensor or ranges(hand.recording), heat=heat)]


def _played(
    contest: Contest, rig: Mapping[str, Axis], sensor: Mapping[str, float] | None
) -> Iterator[tuple[Motions, Columns]]:
    """Each motion of the menu with the columns of both records."""
    for motion in _motions(contest.hand, rig, sensor):
        yield motion, contest.after(motion)


def _cheapest(offered: Sequence[Offer]) -> Offer:
    """Of the motions that decide most and bring nearly the most, or plenty, the one that takes least.

    The board is warmed, which takes a hand, only where nothing else decides as much.
    """
    most = max(len(offer.settled) for offer in offered)
    good = [offer for offer in offered if len(offer.settled) == most]
    if most:
        good = [offer for offer in good if all(e.kind != "heat" for e in offer.motion)] or good
    enough = min(NEARLY * max(offer.expected for offer in good), PLENTY * DECIDES)
    good = [offer for offer in good if offer.expected >= enough]
    return min(good, key=lambda offer: (len(offer.motion), round(offer.duration_s, -1), -offer.expected))


def _groups(names: Sequence[str], tied: Sequence[tuple[str, str]]) -> tuple[tuple[str, ...], ...]:
    """The names that hang together by ``tied`` pairs, two or more of them."""
    groups = [{name} for name in names]
    for pair in tied:
        joined = set().union(*(g for g in groups if g & set(pair)))
        groups = [g for g in groups if not g & joined] + [joined]
    return tuple(tuple(name for name in names if name in g) for g in groups if len(g) > 1)


def _visited(space: Space, covariate: str) -> float:
    """How much a record says about shapes along ``covariate``: their whitened squares beside the base, summed."""
    shapes = dict(gap_unknown._shapes(space)).get(covariate)
    if shapes is None:
        return 0.0
    white = space.whitener.whiten(np.column_stack([space.base, shapes]))
    base = white[:, : space.base.shape[1]]
    free = white[:, base.shape[1] :]
    free = free - base @ np.linalg.lstsq(base, free, rcond=1e-10)[0]
    return float(np.sum(free**2))
