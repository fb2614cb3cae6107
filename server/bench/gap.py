"""Does the diagnosis name what is missing? Recordings that share no line with the library, and what came out.

The figures are those of METHOD 2 and 3. Denominators are all recordings made; intervals are Wilson's, 95 %. A group is
played in an order that any slice of it is a fair sample of, and a slice may be kept and gone on with later.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from calib_core.problem import Problem
from server.bench import Row, gap_cost, gap_experiment, gap_limits, gap_peers, gap_real
from server.bench import gap_campaign as campaign
from server.bench.coverage import wilson
from server.bench.gap_campaign import Case, Outcome
from server.bench.gap_shared import hidden_effects

PLAIN = 6.0
"""√NCP at which who knows the shape finds it in 99 of 100 records."""
FEW = 12
Good = Callable[[Outcome], bool]
Rows = Callable[[Sequence[Outcome]], Iterator[Row]]


@dataclass(frozen=True)
class Group:
    """Cases of one kind, and what their outcomes amount to."""

    cases: Callable[[], Iterator[Case]]
    rows: Rows
    quick: bool = True
    """Whether a quick run takes a case of it."""


def run(*, quick: bool) -> Iterator[Row]:
    """Every group in turn; ``quick`` takes a recording of each."""
    with campaign.player(1 if quick else campaign.PROCESSES) as play:
        for name, group in GROUPS.items():
            if group.quick or not quick:
                yield from group.rows(list(play(_ordered(name)[: 1 if quick else None])))
    if not quick:
        yield from hidden_effects()


def part(name: str, first: int = 0, count: int | None = None, kept: Path | None = None) -> Iterator[Row]:
    """The rows of one group from ``count`` of its cases (all) beginning with number ``first``.

    With a file ``kept`` outcomes are written there one by one, those that it has of this very code are not played
    again, and the rows tell of all it has of the group. Raises Problem bench.group for a group that there is not.
    """
    if name in OTHERS:
        yield from OTHERS[name](first, count)
        return
    if name not in GROUPS:
        raise Problem("bench.group", given=name, allowed=", ".join([*GROUPS, *OTHERS]))
    cases = _ordered(name)
    before = campaign.outcomes_in(kept, cases) if kept is not None and kept.exists() else {}
    asked = cases[first:][:count]
    found, due = dict(before), [case for case in asked if str(case) not in before]
    with campaign.player(campaign.PROCESSES if len(due) > FEW else 1) as play:
        for outcome in play(due):
            found[str(outcome.case)] = outcome
            if kept is not None:
                campaign.keep(kept, outcome)
    yield from GROUPS[name].rows([found[str(c)] for c in (cases if kept else asked) if str(c) in found])


def _ordered(name: str) -> list[Case]:
    """The group's cases in the order of their seeds, which follows nothing else."""
    return sorted(GROUPS[name].cases(), key=lambda case: case.seed)


def right(o: Outcome) -> bool:
    return o.right


def _confidently_wrong(o: Outcome) -> bool:
    return o.unique and not o.exact


def _one_effect(strength: str, limit: float) -> Rows:
    def rows(outcomes: Sequence[Outcome]) -> Iterator[Row]:
        name = f"one effect at {strength}"
        yield from share(f"{name}: named or in the declared tie", outcomes, right, limit)
        if len(outcomes) > 1:
            found = [o for o in outcomes if o.oracle >= PLAIN]
            yield from share(f"{name}: the same, where an oracle would find it", found, right, limit)
        yield from share(f"{name}: right where one name is given alone", _alone(outcomes), lambda o: o.exact, 97)
        # A walk's steps are noise to anybody, and not in the generator's floor.
        ratio = np.array([o.held_out / o.floor for o in outcomes if o.named and "bias_random_walk" not in o.truth])
        if len(ratio):
            told = f"{len(ratio)} recordings with something added, walks apart"
            yield Row(
                f"{name}: held-out ÷ the generator's floor, median", float(np.median(ratio)), "1", 1.002, ours=told
            )
            yield Row(f"{name}: the same, 95th percentile", float(np.quantile(ratio, 0.95)), "1", 1.01)

    return rows


def _alone(outcomes: Sequence[Outcome]) -> list[Outcome]:
    return [o for o in outcomes if o.unique]


def _lateness(outcomes: Sequence[Outcome]) -> Iterator[Row]:
    size = {str(o.case): float(o.case.group.removeprefix("late-")) for o in outcomes}
    small = [o for o in outcomes if size[str(o.case)] <= 4.0]
    large = [o for o in outcomes if size[str(o.case)] >= 10.0]
    yield from share("lag or delay up to 4 ms: tied or right", small, right, 99)
    yield from share("lag or delay from 10 ms: told apart, rightly", large, lambda o: o.unique and o.exact, 95)
    by_size = {x: [o for o in outcomes if size[str(o.case)] == x] for x in sorted(set(size.values()))}
    worst = max(by_size, key=lambda x: sum(map(_confidently_wrong, by_size[x])) / len(by_size[x]))
    name = f"lag or delay: surely wrong at {worst:g} ms, the worst size"
    yield from share(name, by_size[worst], _confidently_wrong, 1, at_most=True)


def _single(name: str, good: Good, limit: float, *, at_most: bool = False) -> Rows:
    """One row of all outcomes."""
    return lambda outcomes: share(name, outcomes, good, limit, at_most=at_most)


def _healthy(noise: str) -> Rows:
    name = f"nothing missing, {noise}: given something"
    return _single(name, lambda o: o.verdict != "adequate", 2, at_most=True)


def _outside(outcomes: Sequence[Outcome]) -> Iterator[Row]:
    yield from share("in no library: flagged", outcomes, lambda o: o.verdict == "unknown", 90)
    yield from share("in no library: no library name beside it", outcomes, lambda o: not o.named, 80)


def _late_cases() -> Iterator[Case]:
    return chain.from_iterable(campaign.lateness(size, 40) for size in campaign.LATENESS_MS)


def _strong_cases() -> Iterator[Case]:
    return chain(campaign.one_effect(0.6, 8), campaign.one_effect(1.0, 4), campaign.one_effect(2.0, 4))


TIED = "named or in the declared tie"
GROUPS: Mapping[str, Group] = {
    "one": Group(_strong_cases, _one_effect("0.6 to 2", 98)),
    "one-0.2": Group(lambda: campaign.one_effect(0.2, 8), _one_effect("0.2", 92), quick=False),
    "one-0.1": Group(lambda: campaign.one_effect(0.1, 8), _one_effect("0.1", 80), quick=False),
    "late": Group(_late_cases, _lateness, quick=False),
    "rate-3": Group(lambda: campaign.with_rate(3.0, 8), _single(f"exact rate, 3 × detectability: {TIED}", right, 95)),
    "rate-5": Group(
        lambda: campaign.with_rate(5.0, 8),
        _single("exact rate, 5 × detectability: named", lambda o: o.truth <= set(o.named), 96),
        quick=False,
    ),
    "healthy-white": Group(lambda: campaign.healthy("white", 300), _healthy("white noise"), quick=False),
    "healthy-0.95": Group(lambda: campaign.healthy("0.95", 300), _healthy("AR(1) noise, 0.95")),
    "healthy-0.995": Group(lambda: campaign.healthy("0.995", 300), _healthy("AR(1) noise, 0.995"), quick=False),
    "two": Group(
        lambda: campaign.two_effects(150), _single("two effects: both named or in the declared ties", right, 92)
    ),
    "outside": Group(lambda: campaign.outside(24), _outside),
    "taken-out": Group(
        lambda: campaign.taken_out(6),
        _single("truth taken out of the library: flagged, or its family named", lambda o: o.flagged_or_kin, 85),
        quick=False,
    ),
    "confounded": Group(
        lambda: campaign.confounded(12), _single("confounded: tie declared, or the right name", right, 100), quick=False
    ),
}


OTHERS: Mapping[str, Callable[[int, int | None], Iterable[Row]]] = {
    "shared": lambda *_: hidden_effects(),
    "real": lambda *_: gap_real.run(quick=False),
    "cost": lambda *_: gap_cost.run(quick=False),
    "experiment": gap_experiment.part,
    "peers": gap_peers.part,
    "limits": lambda *_: gap_limits.run(),
}
"""What is no campaign of cases, or has its own."""


def share(name: str, outcomes: Sequence[Outcome], good: Good, limit: float, *, at_most: bool = False) -> Iterator[Row]:
    """Per cent of the outcomes that are ``good``, their interval, the seeds, and the first cases against us."""
    if not outcomes:
        return
    count, n = sum(map(good, outcomes)), len(outcomes)
    low, high = wilson(count, n)
    against = [f"{o.case.group}/{o.case.number}" for o in outcomes if good(o) == at_most]
    seeds = [o.case.seed for o in outcomes]
    told = (
        f"{count}/{n}, {100 * low:.1f} to {100 * high:.1f} %, {_groups(outcomes)}, seeds {min(seeds)} to {max(seeds)}"
    )
    if against:
        told += f"; {' '.join(against[:FEW])}{' …' if len(against) > FEW else ''}"
    yield Row(name, 100.0 * count / n, "%", limit, not at_most, told)


def _groups(outcomes: Sequence[Outcome]) -> str:
    counted = Counter(o.case.group for o in outcomes)
    return " + ".join(f"{n} of {group}" for group, n in counted.items())
