"""Ties of the first diagnosis, and what one recommended motion made of them, on the twin.

Every board has one hidden effect, of a size that a short or slow motion leaves tied. Right is: after the motion that
the instrument recommends and expects to decide, all data together name the truth, tied with nothing but what was said
to remain tied with it (a warm-up slow enough is a drift, whatever the motion).
"""

import zlib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np

from calib_core.excitation import Excitation, plan_of
from server.bench import Row
from server.bench.coverage import wilson

PROCESSES, BOARDS = 2, 40
BOARD = "EXP"
SINE = (Excitation("x", "sine", 99.5, (30.0,), (0.2513,)),)
MIXED = (
    Excitation("x", "sine", 39.8, (30.0,), (0.2513,)),
    Excitation("x", "staircase", 60.0, rates_dps=(10.0, 20.0, 40.0, 60.0, 80.0, 100.0)),
    Excitation("x", "poses", 40.0, angles_deg=(80.0, -80.0, -120.0, 40.0, 120.0, -40.0, 0.0)),
    Excitation("x", "sine", 11.9, (6.0,), (1.0137,)),
    Excitation("x", "sine", 11.9, (1.5,), (4.0313,)),
    Excitation("x", "hold", 8.0),
)


@dataclass(frozen=True)
class Pair:
    """A tie: the truths that may be behind it, each with its least and greatest size, and the motion that leaves it."""

    name: str
    truths: tuple[tuple[str, float, float], ...]
    motion: tuple[Excitation, ...]
    warming: float = 0.0
    """°C a minute, of the room."""


PAIRS = (
    Pair("lag, delay", (("bandwidth_lag.tau", 2.5e-3, 4e-3), ("time_offset.delay", 2.5e-3, 4e-3)), MIXED),
    Pair("lag, delay, one sine", (("bandwidth_lag.tau", 3e-3, 12e-3), ("time_offset.delay", 3e-3, 12e-3)), SINE),
    Pair(
        "quadratic, asymmetry",
        (("scale_factor_quadratic.k", 1e-5, 5e-5), ("scale_factor_asymmetry.k", 4e-4, 2e-3)),
        SINE,
    ),
    Pair("temperature, drift", (("bias_temperature.k1", 1e-4, 5e-4), ("bias_drift.r", 3e-6, 1e-5)), SINE, warming=2.0),
    Pair("g, g squared", (("g_sensitivity.k_s", 4e-4, 1.5e-3), ("g_squared_sensitivity.k_s", 4e-4, 1.5e-3)), SINE),
    Pair("backlash, hysteresis", (("backlash.b", 0.03, 0.15), ("hysteresis.h", 3e-5, 2e-4)), SINE),
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    pair: str
    seed: int
    truth: str
    size: float
    before: tuple[str, ...]
    """What was tied at first; empty where nothing was."""
    expected: float
    decides: bool
    remain: frozenset[str]
    """What was to remain tied with the truth, the truth included."""
    verdict: str
    named: tuple[str, ...]
    tied: frozenset[str]

    @property
    def counts(self) -> bool:
        """A tie with the truth in it, for which a motion was recommended that should decide."""
        return self.truth in self.before and self.decides

    @property
    def right(self) -> bool:
        said = {*self.named, *self.tied}
        return self.verdict in ("missing", "ambiguous") and self.truth in said and said <= self.remain


def play(case: tuple[int, int]) -> Outcome:
    """Pair number and seed."""
    from server import diagnosis, experiments
    from server.devices import open_rig
    from server.engine import record

    pair, seed = PAIRS[case[0]], case[1]
    rng = np.random.default_rng([zlib.crc32(pair.name.encode()), seed])
    path, low, high = pair.truths[seed % len(pair.truths)]
    size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    rig = open_rig(f"twin:?seed={seed + 1}&covariates=1&warming={pair.warming}&effects={path}:{size:.6g}")
    rig.open()
    hand = record(plan_of(pair.motion, experiment="hand", axis="x"), rig, board=BOARD)
    first = diagnosis.of_recording(hand, axis="x", axes=rig.axes)
    truth = path.partition(".")[0]
    following: dict[str, Any] = first["next_experiment"] or {}
    tied = tuple(following.get("separates", ())) if first["verdict"] == "ambiguous" else ()
    decides = truth in tied and following["decides"]
    last = first
    if decides:
        both = experiments.perform(hand, "x", following["motion"], rig)
        last = diagnosis.of_recording(both, axis="x", axes=rig.axes)
    return Outcome(
        pair.name,
        seed,
        truth,
        size,
        tied,
        following.get("expected_two_delta_lnL", 0.0),
        decides,
        frozenset(next((g for g in following.get("remain", ()) if truth in g), [truth])),
        last["verdict"],
        _named(last),
        frozenset(name for names in last["rivals"] for name in names),
    )


def _named(answer: dict[str, Any]) -> tuple[str, ...]:
    return tuple(found["effect"] for found in answer["missing"])


def part(first: int = 0, count: int | None = None) -> list[Row]:
    """The rows of ``count`` boards (all) beginning with number ``first``; neighbours have different pairs."""
    cases = [(number, seed) for seed in range(BOARDS) for number in range(len(PAIRS))][first:][:count]
    with ProcessPoolExecutor(min(PROCESSES, len(cases)), mp_context=get_context("spawn")) as pool:
        found = list(pool.map(play, cases))
    counted = [o for o in found if o.counts]
    rows = [_row("tied pairs, one recommended motion: right", counted, 99.0)]
    rows += [_row(f"  {pair.name}", [o for o in counted if o.pair == pair.name], None) for pair in PAIRS]
    open_ = sum(o.truth in o.before and not o.decides for o in found)
    rows.append(Row("ties for which no motion is expected to decide", open_, f"of {len(found)} boards"))
    return rows


def run(*, quick: bool) -> list[Row]:
    return part(count=1) if quick else part()


def _row(name: str, outcomes: list[Outcome], limit: float | None) -> Row:
    if not outcomes:
        return Row(name, float("nan"), "%", ours="no ties")
    right, n = sum(o.right for o in outcomes), len(outcomes)
    low, high = wilson(right, n)
    seeds = [o.seed for o in outcomes]
    told = f"{right} of {n} ties, {100 * low:.1f} to {100 * high:.1f} %, seeds {min(seeds)}…{max(seeds)}"
    return Row(name, 100.0 * right / n, "%", limit, at_least=True, ours=told)
