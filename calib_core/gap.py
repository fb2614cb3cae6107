"""What is the model missing? From a recording to verdict, names, evidence, and the error that is left (METHOD 3).

The order: deterministic checks; saturation; the search of the library; structure in no library; rivals; error on data
not seen. Everything is told by codes and values; sentences are made where a language is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core import contest, covariates, gap_saturation
from calib_core.effects import Effect, library
from calib_core.gap_checks import Check, checks
from calib_core.gap_error import Explanation
from calib_core.gap_search import FORM, Search, Suspicion
from calib_core.gap_space import Space, Term
from calib_core.gap_spectrum import Hum, find_hum
from calib_core.gap_spikes import spikes
from calib_core.gap_unknown import CERTAIN, Structure, strongest
from calib_core.gap_wander import Walk, wandering
from calib_core.integral_fit import Design
from calib_core.recording import Recording

F64 = NDArray[np.float64]

FORM_RATE = 0.03
"""Beside a reference rate structure that explains less than this share of what has a name is the rate's own error."""
CLEAR = 25.0
"""Of χ², what a limit must take away: samples have been sought that it suits."""
PASSES = 2
"""So often shapes are made again at the rate without what is large; a third time changes nothing that is seen."""
AGREED = 2.0
"""Of χ² on data not seen, what an effect must take away."""
BY_ITSELF = ("saturation", "adc_quantization", "mains_hum", "bias_random_walk", "input_loading")
"""Effects that are no shape in the residual: each has a test of its own, or can have none."""


@dataclass
class Diagnosis:
    """The answer, in objects; ``to_json`` gives CONTRACT 3."""

    recording: Recording
    axis: str
    checks: list[Check]
    verdict: str = "not_testable"
    search: Search | None = None
    asked: list[Term] = field(default_factory=list)
    rivals: list[list[Suspicion]] = field(default_factory=list)
    alternatives: list[list[list[str]]] = field(default_factory=list)
    """Names that together would serve as well as others together, where the search does not weigh them."""
    candidates: list[dict[str, Any]] = field(default_factory=list)
    clip: gap_saturation.Clip | None = None
    clip_gain: float = 0.0
    hum: Hum | None = None
    walk: Walk | None = None
    coarse: float | None = None
    """The converter's step, where it is too coarse for the noise."""
    unknown: Structure | None = None
    before: Explanation | None = None
    after: Explanation | None = None


def diagnose(
    recording: Recording,
    axis: str,
    *,
    effects: Sequence[str] = (),
    suspects: dict[str, type[Effect]] | None = None,
    seed: int = 0,
    told: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Compares ``axis`` of the recording with base + ``effects`` and names what is missing.

    ``suspects`` replaces the library (a user's own effects, or one left out on purpose); ``told`` hears what begins:
    "fitting", "searching", "structure". Raises Problem for a recording
    without the axis or without a reference.
    """
    answer = Diagnosis(recording, axis, checks(recording, axis))
    if any(check.blocking and not check.ok for check in answer.checks):
        return answer
    pool = dict(library() if suspects is None else suspects)
    rng = np.random.default_rng(seed)
    told("fitting")
    space, search = _search(recording, axis, pool, effects, rng)
    if "saturation" in pool:
        space, search = _clipped(answer, recording, space, search, pool, effects, rng)
    told("searching")
    _sought(search)
    coarse = next((c for c in answer.checks if c.code == "check.record.adc_coarse"), None)
    if "adc_quantization" in pool and coarse is not None:
        answer.coarse = float(str(coarse.values["step"]))
    elif "bias_random_walk" in pool:
        walk = wandering(search)
        if walk is not None and walk.rivals:
            answer.alternatives.append([["bias_random_walk"], [*walk.rivals]])
        if walk is not None and walk.named:
            answer.walk = walk
            # Beside a bias that wanders a step or a drift must be plainer, and the rest may be plainer to see.
            search = Search(search.space, search.suspects, rng, search.chosen[: search.given], columns=search.columns)
            _sought(search)
    told("structure")
    if answer.coarse is not None:
        _beyond(search, answer.coarse)
    else:
        _structure(answer, search)
    if "mains_hum" in pool:
        line = find_hum(search.space.design.averages.samples, moving=search.space.design.moves)
        answer.hum = line if line is not None and line.found else None
    answer.search = search
    answer.asked = search.chosen[: len(effects)]
    answer.rivals = search.rivals()[search.given :]
    answer.before = Explanation(search.space, answer.asked, background=False)
    answer.after = Explanation(search.space, named(search))
    answer.candidates = _candidates(search, pool, answer)
    found = bool(named(search)[len(effects) :]) or any(
        x is not None for x in (answer.hum, answer.clip, answer.walk, answer.coarse)
    )
    answer.alternatives = _standing(answer, search)
    tied = any(len(r) > 1 for r in answer.rivals) or bool(answer.alternatives)
    if answer.unknown is not None:
        answer.verdict = "unknown"
    else:
        answer.verdict = ("ambiguous" if tied else "missing") if found else "adequate"
    return answer


def _standing(answer: Diagnosis, search: Search) -> list[list[list[str]]]:
    """The alternatives of which one is still what is said."""
    said = {t.name for t in named(search)} | ({"bias_random_walk"} if answer.walk is not None else set())
    both = [*answer.alternatives, *search.alternatives]
    return [sets for sets in both if any(said.issuperset(names) for names in sets)]


def named(search: Search) -> list[Term]:
    """The chosen terms that have a name."""
    return [t for t in search.chosen if t.name != "unknown"]


def prepare(recording: Recording, axis: str, mask: NDArray[np.bool_] | None = None) -> Space:
    """The space of the rows in ``mask`` (of the recording) that are no spikes, about its base."""
    output = recording.gyro(axis).values
    known = np.flatnonzero(np.isfinite(output))
    if len(out := spikes(output[known])):
        mask = np.ones(len(recording), bool) if mask is None else mask.copy()
        mask[known[out]] = False
    design = Design.of(recording, axis, mask)
    rough = design.rough()
    scale_factor = float(rough[1]) if len(rough) > 1 else float("nan")
    space = Space(design, covariates.of(recording, axis, design, float(rough[0]), scale_factor), rough)
    if len(space.values) > 1:
        # The base is now known well: the covariates, and the space about them, once more.
        about = _about(recording, space)
        del space  # a long record has no room for two
        space = about()
    design.averages.forget()
    return space


def begin(
    recording: Recording,
    axis: str,
    pool: dict[str, type[Effect]],
    rng: np.random.Generator,
    mask: NDArray[np.bool_] | None = None,
) -> Search:
    """A search of the recording's space, for what of ``pool`` has a shape in it.

    An effect that is large bends the rate that the gyro tells, on which every shape depends: it is taken out of it
    first (METHOD 2: shapes at the model-corrected true rate).
    """
    space = prepare(recording, axis, mask)
    shaped = {n: e for n, e in pool.items() if n not in BY_ITSELF and not e.missing(space.covariates)}
    search = Search(space, shaped, rng)
    for _ in range(PASSES if space.design.reference == "encoder" and space.design.moves else 0):
        large = search.large()
        if not large:
            break
        about = _about(recording, search.space, large)
        del space, search, large
        space = about()
        search = Search(space, shaped, rng)
        space.design.averages.forget()
    return search


def _about(recording: Recording, space: Space, terms: Sequence[Term] = ()) -> Callable[[], Space]:
    """What makes the space once more, with covariates for its own base and without what ``terms`` bring into them."""
    values, shift_dps, shown_deg = space.brought(terms)
    axis, design, noise, (bias, scale_factor) = space.covariates.axis, space.given, space.noise, values.tolist()

    def made() -> Space:
        c = covariates.of(recording, axis, design, bias, scale_factor, shift_dps=shift_dps, shown_deg=shown_deg)
        return Space(design, c, values, settled=bool(terms), guess=noise)

    return made


def _search(
    recording: Recording,
    axis: str,
    pool: dict[str, type[Effect]],
    effects: Sequence[str],
    rng: np.random.Generator,
    mask: NDArray[np.bool_] | None = None,
) -> tuple[Space, Search]:
    """The space of the recording, and a search of it that has the asked effects in its model."""
    search = begin(recording, axis, pool, rng, mask)
    if effects:
        search = Search(search.space, search.suspects, rng, chosen=search.placed(effects), columns=search.columns)
    return search.space, search


def _clipped(
    answer: Diagnosis,
    recording: Recording,
    space: Space,
    search: Search,
    pool: dict[str, type[Effect]],
    effects: Sequence[str],
    rng: np.random.Generator,
) -> tuple[Space, Search]:
    """The space without the samples on a limit, where that explains the record better than any other effect."""
    clip = gap_saturation.find(recording, answer.axis, space.design, space.rough_noise)
    if clip is None:
        return space, search
    kept, without = _search(recording, answer.axis, pool, effects, rng, ~clip.clipped)
    gain = clip_gain(search, without)
    if gain is None:
        return space, search
    answer.clip, answer.clip_gain = clip, gain
    return kept, without


def clip_gain(search: Search, without: Search) -> float | None:
    """2ΔlnL of a limit, from the whole record and the one ``without`` what is on it; None where another effect serves
    as well. Of both the chosen are kept, and the noise that is left at last is that of the samples on no limit."""
    space = search.space
    own, inside = space.noise, len(space.rows) - len(without.space.rows)
    without.prepare()
    # Samples on a limit must not pass for noise.
    space.use_noise(without.space.noise)
    everything, (best, other) = search.chi2(search.chosen), _best(search)
    clipped = without.chi2(without.chosen) + inside
    if clipped <= min(other, everything - CLEAR):
        return everything - clipped
    # Beside an effect larger than the limit: does it serve better there than any other second one?
    if best is not None:
        beside = Search(space, search.suspects, search.rng, [*search.chosen, best], columns=search.columns)
        clipped = _best(without)[1] + inside
        # Rows are formed anew where samples are left out: others, with a χ² of their own.
        if clipped <= min(_best(beside)[1], other - CLEAR - 4.0 * math.sqrt(len(space.rows))):
            return other - clipped
    space.use_noise(own)
    return None


def _best(search: Search) -> tuple[Term | None, float]:
    """The effect that leaves least beside what is chosen, and the χ² it leaves."""
    _, ranking = search.scan()
    refined = [search.refined(s.term, search.chosen) for s in ranking[:3]]
    return min(refined, key=lambda found: found[1], default=(None, search.chi2(search.chosen)))


def _sought(search: Search) -> None:
    """Adds what is missing, and takes away what does not hold."""
    search.run()
    if search.split():
        search.run()
    search.merge()
    if len(search.chosen) - search.given > 1:
        search.exchange()
    search.confirm()
    _agree(search)


def _agree(search: Search) -> None:
    """Drops what does not lower the error on data not seen, however sure it looks where it was fitted."""
    while len(search.chosen) > search.given:
        now = search.held_out(search.chosen)
        gains = [
            search.held_out([*search.chosen[:k], *search.chosen[k + 1 :]]) - now
            for k in range(search.given, len(search.chosen))
        ]
        worst = int(np.argmin(gains))
        if gains[worst] > AGREED:
            return
        del search.chosen[search.given + worst], search.findings[worst]


def _beyond(search: Search, step: float) -> None:
    """Drops what is smaller than a coarse converter's rounding, which goes with the rate and is no noise."""
    explanation = Explanation(search.space, search.chosen)
    values, at = explanation.solution[0], len(search.space.prior)
    for k, term in reversed(list(enumerate(search.chosen))):
        begin = at + sum(t.columns.shape[1] for t in search.chosen[:k])
        size = term.columns @ values[begin : begin + term.columns.shape[1]]
        if k >= search.given and float(np.std(size)) < step / np.sqrt(12.0):
            del search.chosen[k], search.findings[k - search.given]


def _structure(answer: Diagnosis, search: Search) -> None:
    """Flags what no library effect explains; names that do not pass beside it are dropped."""
    explained = search.chi2([]) - search.chi2(search.chosen)
    found = strongest(search.space, search.chosen)
    form = FORM if search.space.design.reference == "encoder" else FORM_RATE
    if found is None or found.z < CERTAIN or found.gain < form * explained:
        return
    answer.unknown = found
    names = {t.name for t in search.chosen[search.given :]}
    asked = search.chosen[: search.given]
    few = {n: e for n, e in search.suspects.items() if n in names}
    beside = Search(search.space, few, search.rng, columns=search.columns)
    beside.chosen = [*asked, found.term]
    beside.given = len(beside.chosen)
    beside.run()
    search.chosen = [*asked, *beside.chosen[beside.given :]]
    search.findings = beside.findings


def _candidates(search: Search, pool: dict[str, type[Effect]], answer: Diagnosis) -> list[dict[str, Any]]:
    """Every effect of the library: tested, not excited by this motion (or too little to be seen), or without data."""
    c, chosen = search.space.covariates, {t.name for t in search.chosen}
    tested = {s.term.name: s for s in search.last}
    # Beside what was chosen its rivals have nothing left of their own: they were tested when it was.
    tested = {s.term.name: s for f in search.findings for s in f.field} | tested
    tested |= {f.chosen.term.name: f.chosen for f in search.findings}
    power = contest.powers(search.space, search.suspects, search.chosen)
    weak = {n for n, s in tested.items() if n not in chosen and max(power.get(n, 0.0), s.gain) < contest.SHOWN}
    weak -= {s.term.name for rivals in answer.rivals for s in rivals}
    rows = []
    for name, effect in pool.items():
        row: dict[str, Any] = {
            "effect": name,
            "status": "tested",
            "two_delta_lnL": None,
            "p": None,
            "held_out_gain": None,
        }
        if name == "input_loading" or (name not in BY_ITSELF and effect.missing(c)):
            row["status"] = "no_data"
        elif name == "saturation":
            row["two_delta_lnL"] = answer.clip_gain if answer.clip else 0.0
        elif name == "mains_hum":
            row["two_delta_lnL"] = answer.hum.two_delta_lnL if answer.hum else 0.0
        elif name == "bias_random_walk":
            row["two_delta_lnL"] = answer.walk.two_delta_lnL if answer.walk else 0.0
        elif name == "adc_quantization":
            row["two_delta_lnL"] = on_grid(answer) if answer.coarse else 0.0
        elif name in weak:
            row["status"] = "not_excited"
        elif name in tested:
            row["two_delta_lnL"], row["p"] = tested[name].gain, p_value(tested[name].z)
            row["held_out_gain"] = _unseen(search, tested[name].term)
        elif name not in BY_ITSELF and name not in chosen:
            row["status"] = "not_excited"
        rows.append(row)
    return rows


def _unseen(search: Search, term: Term) -> float:
    """What ``term`` takes off χ² on data not seen: of a chosen one, what it takes off beside the others."""
    others = [t for t in search.chosen if t is not term]
    return search.held_out(others) - search.held_out([*others, term])


def on_grid(answer: Diagnosis) -> float:
    """2ΔlnL of every sample's lying within a fifth of a step of the converter's grid, against lying anywhere."""
    samples = int(np.isfinite(answer.recording.gyro(answer.axis).values).sum())
    return 2.0 * samples * float(np.log(2.5))


def p_value(z: float) -> float:
    """Two-sided, of an equivalent |z|."""
    from scipy.special import ndtr

    return float(2.0 * ndtr(-abs(z)))
