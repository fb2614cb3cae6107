"""Many recordings with a known truth, diagnosed; what came out, case by case.

Every case is named by its group and number, from which its seed follows: a case that went wrong can be made again.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

import calib_core
from calib_core.recording import Recording
from server.bench.gap_oracle import detectable, evidence
from server.bench.gap_records import EFFECTS, OUTSIDE_THE_LIBRARY, Record, record

PROCESSES = 2
SEED = 20261127
INSIDE = tuple(name for name in EFFECTS if name not in OUTSIDE_THE_LIBRARY)
LATE = ("bandwidth_lag", "time_offset", "angular_acceleration", "clock_skew")
NO_SHAPE = ("adc_quantization", "bias_random_walk")
"""Not in METHOD 2's list of strengths, and no regressor: tested at full strength only."""
ON_THE_TABLE = ("encoder_eccentricity", "encoder_nonlinearity", "backlash")
"""These act on the encoder: with a reference rate there is nothing to see."""
FAMILIES = (
    {"bias_temperature", "thermal_lag", "warm_up", "bias_drift", "bias_step", "bias_random_walk"},
    {"scale_factor_quadratic", "scale_factor_cubic", "scale_factor_asymmetry", "saturation", "dead_band"},
    {"hysteresis", "backlash", "dead_band"},
    {"g_sensitivity", "g_squared_sensitivity", "encoder_eccentricity", "encoder_nonlinearity"},
    set(LATE),
    {"scale_factor_temperature", "scale_factor_cubic"},
    {"bias_drift", "supply_sensitivity", "bias_temperature"},
)
"""Effects that pass for each other (METHOD 4, "confused with")."""


@dataclass(frozen=True)
class Case:
    """One recording to make: effects with strengths, options of ``record``, names taken out of the library."""

    group: str
    number: int
    effects: Mapping[str, float]
    options: Mapping[str, Any] = field(default_factory=dict)
    without: tuple[str, ...] = ()
    detectability: float = 0.0
    """Where not 0, the strength is this many times the detectability amplitude (METHOD 3)."""

    @property
    def seed(self) -> int:
        return zlib.crc32(f"{SEED}/{self.group}/{self.number}".encode())

    def made(self) -> Record:
        effects = dict(self.effects)
        if self.detectability:
            effects = {name: self.detectability * detectable(self.seed, name, self.options) for name in effects}
        return record(self.seed, effects, **self.options)

    def __str__(self) -> str:
        return f"{self.group}/{self.number} {dict(self.effects)} {dict(self.options)}"


@dataclass(frozen=True)
class Outcome:
    """What the diagnosis said of a case."""

    case: Case
    verdict: str
    named: tuple[str, ...]
    tied: frozenset[str]
    """Everything that is in a declared tie."""
    unknown: str
    held_out: float
    floor: float
    """RMS of the generator's own noise in the same statistic."""
    cpu_s: float

    @cached_property
    def oracle(self) -> float:
        """√NCP of the truth for one who knows its shape and the noise."""
        made = self.case.made()
        return evidence(self.case.seed, made.effects, self.case.options) if made.effects else 0.0

    @property
    def truth(self) -> frozenset[str]:
        return frozenset(self.case.effects)

    @property
    def right(self) -> bool:
        """Every true effect is named or in a declared tie."""
        return self.truth <= {*self.named, *self.tied}

    @property
    def exact(self) -> bool:
        return set(self.named) == self.truth

    @property
    def unique(self) -> bool:
        return self.verdict == "missing"

    @property
    def flagged_or_kin(self) -> bool:
        return self.verdict == "unknown" or self.family

    @property
    def family(self) -> bool:
        """Some effect is named that passes for the truth."""
        return any(truth in kin and kin & {*self.named, *self.tied} for truth in self.truth for kin in FAMILIES)


def as_recording(made: Record) -> Recording:
    """The record as the product reads it."""
    columns = dict(made.columns)
    names = tuple(dict.fromkeys(made.segments))
    codes = np.array([names.index(name) for name in made.segments], np.int32)
    header = {"format": "gyro-recording 1", "board": "GAP", "axis": str(made.truth["axis"])}
    return Recording(columns.pop("time_s"), columns, codes, names, header)


def play(case: Case) -> Outcome:
    """Makes the recording and diagnoses it."""
    from calib_core.effects import library
    from server.diagnosis import of_recording

    made = case.made()
    suspects = {name: effect for name, effect in library().items() if name not in case.without}
    start = time.process_time()
    said = of_recording(as_recording(made), suspects=suspects)
    cpu_s = time.process_time() - start
    return Outcome(
        case,
        said["verdict"],
        tuple(finding["effect"] for finding in said["missing"]),
        frozenset(
            name for names in [*said["rivals"], *(s for sets in said["rival_sets"] for s in sets)] for name in names
        ),
        said["unknown"]["covariate"] if said["unknown"] else "",
        said["after"]["held_out_rms_dps"] if said["after"] else math.nan,
        true_floor(made),
        cpu_s,
    )


@cache
def code() -> str:
    """A digest of the arithmetic: outcomes of another are no outcomes of this."""
    digest = hashlib.sha256()
    for file in sorted(Path(calib_core.__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def keep(file: Path, outcome: Outcome) -> None:
    """Writes one line more to ``file``."""
    told = {
        "code": code(), "case": str(outcome.case), "seed": outcome.case.seed, "verdict": outcome.verdict,
        "named": outcome.named, "tied": sorted(outcome.tied), "unknown": outcome.unknown,
        "held_out": outcome.held_out, "floor": outcome.floor, "cpu_s": outcome.cpu_s,
    }  # fmt: skip
    with file.open("a", encoding="utf-8") as opened:
        opened.write(json.dumps(told) + "\n")


def outcomes_in(file: Path, cases: Sequence[Case]) -> dict[str, Outcome]:
    """What ``file`` has of these cases from this code, by the case's name."""
    known, found = {str(case): case for case in cases}, {}
    for line in file.read_text(encoding="utf-8").splitlines():
        told = json.loads(line)
        if told["code"] == code() and told["case"] in known:
            found[told["case"]] = Outcome(
                known[told["case"]], told["verdict"], tuple(told["named"]), frozenset(told["tied"]), told["unknown"],
                told["held_out"], told["floor"], told["cpu_s"],
            )  # fmt: skip
    return found


def true_floor(made: Record) -> float:
    """RMS of what noise and rounding leave in one-second windows (METHOD 2's weak form), in deg/s."""
    from calib_core.weak_form import Windows

    squares = []
    # Which windows a limit leaves depends on where it is seen: on average they are any without it.
    for begin in range(0, 50, 5) if made.clipped.any() else (0,):
        noise, error = made.gyro_noise_dps[begin:, None], made.encoder_error_deg[begin:, None]
        windows = Windows(len(noise), 0.01)
        left = windows.mean(noise)[:, 0]
        if made.truth["reference"] == "encoder":
            left = left - windows.rate(error)[:, 0]
        clipped = made.clipped[begin:][windows.first[:, None] + np.arange(windows.width)].any(axis=1)
        squares.append(left[~clipped] ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))


@contextmanager
def player(processes: int = PROCESSES) -> Iterator[Callable[[Sequence[Case]], Iterator[Outcome]]]:
    """A function that plays many cases, in this process or over so many of its own, and gives each as it is done."""
    if processes < 2:
        yield lambda cases: map(play, cases)
        return
    import multiprocessing

    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        yield lambda cases: pool.imap_unordered(play, cases, chunksize=1)


# --- the groups --------------------------------------------------------------------------------------------------
def conditions(k: int) -> dict[str, Any]:
    """Plan, lock, noise and axis in turn: any eight numbers in a row meet every plan, lock and kind of noise."""
    options: dict[str, Any] = {"plan": "second" if k & 1 else "first", "locked": bool(k & 2)}
    if k & 4:
        options |= coloured(k)
    if k % 16 in (5, 10):
        options["axis"] = "z"
    return options


def coloured(k: int) -> dict[str, float]:
    """AR(1) noise correlated over 0.1 to 2 s, with as much slow noise as hidden_effects' coloured records have."""
    rng = np.random.default_rng([SEED, k])
    correlation_s = math.exp(rng.uniform(math.log(0.1), math.log(2.0)))
    return {"ar1_V": 7.5e-4 * math.sqrt(0.1 / correlation_s), "phi": math.exp(-0.01 / correlation_s)}


def one_effect(strength: float, each: int) -> Iterator[Case]:
    """Every effect of the library, ``each`` times, under conditions in turn."""
    names = [name for name in INSIDE if name not in NO_SHAPE or strength >= 0.6]
    for i, name in enumerate(names):
        for k in range(each):
            yield Case(f"one-{strength:g}", i * 1000 + k, {name: strength}, conditions(k + i))


def healthy(kind: str, count: int) -> Iterator[Case]:
    """Nothing hidden, in ``white`` noise or AR(1) noise of φ = 0.95 or 0.995; the encoder is the reference."""
    noise = {"white": {}, "0.95": {"ar1_V": 8e-4, "phi": 0.95}, "0.995": {"ar1_V": 8e-4, "phi": 0.995}}[kind]
    for k in range(count):
        options = conditions(k) | {"ar1_V": 0.0, "phi": 0.0} | noise
        yield Case(f"healthy-{kind}", k, {}, options)


LATENESS_MS = (2.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0)


def lateness(milliseconds: float, each: int) -> Iterator[Case]:
    """Lag or delay of this size."""
    for i, name in enumerate(("bandwidth_lag", "time_offset")):
        for k in range(each):
            yield Case(f"late-{milliseconds:g}", i * 1000 + k, {name: milliseconds / 6.0}, conditions(k))


def with_rate(times: float, each: int) -> Iterator[Case]:
    """An exact reference rate, at so many times the detectability amplitude."""
    for i, name in enumerate(n for n in INSIDE if n not in (*NO_SHAPE, *ON_THE_TABLE)):
        for k in range(each):
            options = conditions(k + i) | {"reference": "rate"}
            yield Case(f"rate-{times:g}", i * 1000 + k, {name: 1.0}, options, detectability=times)


def two_effects(count: int) -> Iterator[Case]:
    """Two different effects of the library at 0.6 to 1.5."""
    names = [name for name in INSIDE if name not in NO_SHAPE]
    for k in range(count):
        rng = np.random.default_rng([SEED, 2, k])
        a, b = rng.choice(len(names), 2, replace=False)
        effects = {names[a]: float(rng.uniform(0.6, 1.5)), names[b]: float(rng.uniform(0.6, 1.5))}
        yield Case("two", k, effects, conditions(k))


def outside(each: int) -> Iterator[Case]:
    """Shapes that are in no library, at strength 2 to 4."""
    for i, name in enumerate(OUTSIDE_THE_LIBRARY):
        for k in range(each):
            yield Case("outside", i * 1000 + k, {name: 2.0 + k % 3}, conditions(k))


def taken_out(each: int) -> Iterator[Case]:
    """The truth's own effect is not among the suspects."""
    for i, name in enumerate(n for n in INSIDE if n not in NO_SHAPE):
        for k in range(each):
            yield Case("taken-out", i * 1000 + k, {name: 2.0}, conditions(k + i), without=(name,))


def confounded(each: int) -> Iterator[Case]:
    """Records that cannot decide: lateness in one sine, temperature that rises with time, one speed."""
    ones = [(name, {"plan": "sine", "locked": k}) for name in ("bandwidth_lag", "time_offset") for k in (True, False)]
    ones += [(name, {"warming": True}) for name in ("bias_temperature", "bias_drift")]
    ones += [(name, {"plan": "one_rate"}) for name in ("scale_factor_quadratic", "scale_factor_asymmetry")]
    for i, (name, options) in enumerate(ones):
        for k in range(each):
            yield Case("confounded", i * 1000 + k, {name: 2.0 if i < 4 else 1.0}, options)
