"""Does the diagnosis name what is missing? Recordings that share no line with the library, and what came out.

The figures are those of METHOD 2 and 3. Denominators are all recordings made; intervals are Wilson's, 95 %.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from server.bench import Row
from server.bench import gap_campaign as campaign
from server.bench.coverage import wilson
from server.bench.gap_campaign import Case, Outcome
from server.bench.gap_shared import hidden_effects

PLAIN = 6.0
"""√NCP at which who knows the shape finds it in 99 of 100 records."""
Good = Callable[[Outcome], bool]
SIZES = {False: campaign.LATENESS_MS, True: (15.0,)}
HEALTHY = {"white": "white noise", "0.95": "AR(1) noise, 0.95", "0.995": "AR(1) noise, 0.995"}


def run(*, quick: bool) -> Iterator[Row]:
    """Every group in turn; ``quick`` takes a recording of each."""
    with campaign.player(1 if quick else campaign.PROCESSES) as play:
        yield from _one_effect(play, quick)
        yield from _lateness(play, quick)
        yield from _with_rate(play, quick)
        yield from _healthy(play, quick)
        yield from _others(play, quick)
    if not quick:
        yield from hidden_effects()


Play = Callable[[Sequence[Case]], list[Outcome]]


def right(o: Outcome) -> bool:
    return o.right


def _one_effect(play: Play, quick: bool) -> Iterator[Row]:
    plain = play(_some(campaign.one_effect(0.6, 8), quick))
    if not quick:
        plain += play([*campaign.one_effect(1.0, 4), *campaign.one_effect(2.0, 4)])
    weak, weakest = (play([] if quick else list(campaign.one_effect(strength, 8))) for strength in (0.2, 0.1))
    for strength, outcomes, limit in (("0.6 to 2", plain, 98), ("0.2", weak, 92), ("0.1", weakest, 80)):
        yield from share(f"one effect at {strength}: named or in the declared tie", outcomes, right, limit)
        found = [] if quick else [o for o in outcomes if o.oracle >= PLAIN]
        yield from share(f"one effect at {strength}: the same, where an oracle would find it", found, right, limit)
    unique = [o for o in [*plain, *weak, *weakest] if o.unique]
    yield from share("one effect: right where one name is given alone", unique, lambda o: o.exact, 97)
    ratio = np.array([o.held_out / o.floor for o in plain if o.named])
    told = f"{len(ratio)} recordings with something added"
    yield Row("held-out ÷ the generator's floor, median", float(np.median(ratio)), "1", 1.002, ours=told)
    yield Row("held-out ÷ the generator's floor, 95th percentile", float(np.quantile(ratio, 0.95)), "1", 1.01)


def _lateness(play: Play, quick: bool) -> Iterator[Row]:
    found = {size: play(_some(campaign.lateness(size, 40), quick)) for size in SIZES[quick]}
    small = [o for size, outcomes in found.items() if size <= 4.0 for o in outcomes]
    large = [o for size, outcomes in found.items() if size >= 10.0 for o in outcomes]
    yield from share("lag or delay up to 4 ms: tied or right", small, right, 99)
    yield from share("lag or delay from 10 ms: told apart, rightly", large, lambda o: o.unique and o.exact, 95)
    worst = max(found, key=lambda size: sum(map(_confidently_wrong, found[size])) / len(found[size]))
    name = f"lag or delay: surely wrong at {worst:g} ms, the worst size"
    yield from share(name, found[worst], _confidently_wrong, 1, at_most=True)


def _confidently_wrong(o: Outcome) -> bool:
    return o.unique and not o.exact


def _with_rate(play: Play, quick: bool) -> Iterator[Row]:
    three = play(_some(campaign.with_rate(3.0, 8), quick))
    yield from share("exact rate, 3 × detectability: named or in the declared tie", three, right, 95)
    five = play([] if quick else list(campaign.with_rate(5.0, 8)))
    yield from share("exact rate, 5 × detectability: named", five, lambda o: o.truth <= set(o.named), 96)


def _healthy(play: Play, quick: bool) -> Iterator[Row]:
    for kind, words in list(HEALTHY.items())[quick : 2 if quick else None]:
        outcomes = play(_some(campaign.healthy(kind, 300), quick))
        yield from share(f"nothing missing, {words}: given something", outcomes, _given, 2, at_most=True)


def _given(o: Outcome) -> bool:
    return o.verdict != "adequate"


def _others(play: Play, quick: bool) -> Iterator[Row]:
    two = play(_some(campaign.two_effects(150), quick))
    yield from share("two effects: both named or in the declared ties", two, right, 92)
    outside = play(_some(campaign.outside(24), quick))
    yield from share("in no library: flagged", outside, lambda o: o.verdict == "unknown", 90)
    yield from share("in no library: no library name beside it", outside, lambda o: not o.named, 80)
    removed = play([] if quick else list(campaign.taken_out(6)))
    name = "truth taken out of the library: flagged, or its family named"
    yield from share(name, removed, lambda o: o.verdict == "unknown" or o.family, 85)
    unclear = play(_some(campaign.confounded(12), quick))
    yield from share("confounded: tie declared, or the right name", unclear, right, 100)


def share(name: str, outcomes: Sequence[Outcome], good: Good, limit: float, *, at_most: bool = False) -> Iterator[Row]:
    """Per cent of the outcomes that are ``good``, their interval, and the first cases that count against us."""
    if not outcomes:
        return
    count, n = sum(map(good, outcomes)), len(outcomes)
    low, high = wilson(count, n)
    against = [str(o.case).split()[0] for o in outcomes if good(o) == at_most]
    told = f"{count}/{n}, {100 * low:.1f} to {100 * high:.1f} %"
    if against:
        told += f"; {' '.join(against[:12])}{' …' if len(against) > 12 else ''}"
    yield Row(name, 100.0 * count / n, "%", limit, not at_most, told)


def _some(cases: Iterator[Case], quick: bool) -> list[Case]:
    """All of the cases, or one from the middle of them where it must be quick."""
    every = list(cases)
    return [every[len(every) // 2]] if quick else every
