"""Which effects a record asks for, how sure that is, and which others would serve as well (METHOD 3, steps 4 to 6)."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from calib_core.effects.base import Effect
from calib_core.gap_gram import Gram
from calib_core.gap_space import Space, Term
from calib_core.problem import Problem

F64 = NDArray[np.float64]

FALSE_ALARM = 0.01
"""Of a healthy record given anything at all; designing at 2 % fails a 2 % bar as often as not."""
DRAWS = 4000
FORM = 0.002
"""Share of what an effect explains that may be its form's, which is never quite right."""
SHARE, SHARE_RATE = 0.001, 0.04
"""A new term must buy this share of what is explained already: the form of a big effect is never quite right, and a
reference rate has errors that follow the motion."""
REST = 0.05
"""Or this share of what is left: then the form is not what is meant."""
RIVAL = 6.0
"""2ΔlnL within which two explanations cannot be told apart."""
TUNED = 4.0
"""2ΔlnL that a time or a time constant gains by being put where noise likes it best."""
MOST = 3
STEP_EVERY_S, STEPS = 4.0, 40.0
CLEAN = 1e-3
"""Of a column's square, what must be its own to stand beside others while the noise is estimated."""
FIELD = 8
"""So many classes are refined before one is chosen."""
LATE_TURNS, TURNS = 6, 3
SETTLED, PAIRED = 3, 6
"""So many rivals are looked at with the others where they would stand then; of so many classes pairs are tried."""
PLAIN = 8.0
"""|z| of what is refined before the noise is estimated."""
LARGE = 1000.0
"""Of χ², what an effect explains that bends the rate by more than the noise does."""
NOISE_COMPANY = 8
"""So many best classes stand in the model while the noise is estimated."""


@dataclass(frozen=True, eq=False)
class Suspicion:
    """A term with its evidence over base and the terms before it."""

    term: Term
    gain: float
    z: float
    """The gain as that of one degree of freedom: its square root where the term has one column."""
    sure: float = float("nan")
    """The same of what the encoder's codes could not feign."""


@dataclass
class Finding:
    """What was added in one step, and every class that could have been, refined, best first."""

    chosen: Suspicion
    field: list[Suspicion]
    threshold: float


@dataclass
class Search:
    """The state of one diagnosis."""

    space: Space
    suspects: dict[str, type[Effect]]
    rng: np.random.Generator
    chosen: list[Term] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    last: list[Suspicion] = field(default_factory=list)
    threshold: float = float("nan")
    columns: dict[str, list[Term]] = field(default_factory=dict)
    """The grid of each suspect, to be shared with other searches of the same space."""
    alternatives: list[list[list[str]]] = field(default_factory=list)
    """An effect, and those that together explain the record as well."""
    given: int = field(init=False)
    """So many of the chosen were there from the start."""

    def __post_init__(self) -> None:
        self.given = len(self.chosen)

    def terms(self) -> list[Term]:
        """Every suspect not yet chosen, at every point of its grid.

        A rate that was measured went through a filter of its own, as late or early as the gyro's: beside it one late
        answer can be told, and what a second one would mend is that filter's form.
        """
        fresh = [name for name in self.suspects if name not in self.columns]
        for name in fresh:
            effect = self.suspects[name]
            self.columns[name] = [self.space.term(effect, s) for s in settings(effect, self.space)]
        if fresh:
            self.space.enlist([t for terms in self.columns.values() for t in terms])
        taken = {t.name for t in self.chosen}
        if self.space.design.reference == "rate" and any(t.effect.curvature is not None for t in self.chosen):
            taken |= {name for name, effect in self.suspects.items() if effect.curvature is not None}
        return [t for name in self.suspects if name not in taken for t in self.columns[name]]

    def scan(self) -> tuple[Gram, list[Suspicion]]:
        """The best setting of every class over base and chosen, best class first; and the Gram matrix behind it."""
        terms = self.terms()
        gram = self.space.gram([*self.chosen, *terms])
        kept, places = _places(self.chosen, gram.base), _places([*self.chosen, *terms], gram.base)
        projected = gram.without([k for place in kept for k in place])
        best: dict[str, Suspicion] = {}
        for term, place in zip(terms, places[len(kept) :], strict=True):
            gain, sure = gram.gain(projected, place, term.slack, fixed=term.fixed)
            if not np.isfinite(gain):
                continue
            if gain < 0.0 or (term.effect.positive and projected[place[0], 0] < 0.0):
                gain = sure = 0.0  # tested, and the record speaks against it
            z, least = (float(equivalent_z(g, len(place))) for g in (gain, sure))
            found = Suspicion(term, gain, z, least)
            if term.name not in best or found.z > best[term.name].z:
                best[term.name] = found
        self._projected, self._places = projected, places[len(kept) :]
        return gram, sorted(best.values(), key=lambda s: -s.z)

    def _beside(self, terms: Sequence[Term]) -> tuple[F64, F64]:
        """Orthonormal columns (n, h) of base and ``terms``, whitened, and what they leave of the residual (n,)."""
        space = self.space
        free = [space.whitened(t) for t in terms if not t.fixed]
        held = np.column_stack([space.white(space.base), *free])
        size = np.sqrt(np.einsum("ij,ij->j", held, held))
        span, _ = np.linalg.qr(held[:, size > 0.0] / size[size > 0.0])
        left = space.white(space.residual - sum(t.columns[:, 0] for t in terms if t.fixed))
        return span, left - span @ (span.T @ left)

    def null_tail(self, terms: Sequence[Term]) -> float:
        """The (1 - FALSE_ALARM) quantile of the best z over all ``terms`` in a record where nothing is missing."""
        own = np.diag(self._projected)
        usable = [(t, p) for t, p in zip(terms, self._places, strict=True) if own[p].min() > 1e-7]
        order = [k for _, place in usable for k in place]
        block = self._projected[np.ix_(order, order)]
        size = np.sqrt(np.diag(block))
        power, vectors = np.linalg.eigh(block / np.outer(size, size))
        draws = (vectors * np.sqrt(np.maximum(power, 0.0))) @ self.rng.standard_normal((len(order), DRAWS))
        best, start = np.zeros(DRAWS), 0
        for _, place in usable:
            part = draws[start : start + len(place)]
            if len(place) == 1:
                z = np.abs(part[0])
            else:
                own_block = block[start : start + len(place), start : start + len(place)]
                own_size = size[start : start + len(place)]
                inverse = np.linalg.pinv(own_block / np.outer(own_size, own_size), rcond=1e-9, hermitian=True)
                z = equivalent_z(np.einsum("ij,ik,kj->j", part, inverse, part), len(place))
            best = np.maximum(best, z)
            start += len(place)
        return float(np.quantile(best, 1.0 - FALSE_ALARM))

    def chi2(self, terms: Sequence[Term]) -> float:
        """χ² of the record under base and ``terms``."""
        gram, free = self.space.free(terms)
        return gram.chi2(free)

    def deviance(self, terms: Sequence[Term]) -> float:
        """-2lnL of the record under base and ``terms`` and the noise of now, up to a constant."""
        return self.chi2(terms) + self.space.whitener.log_determinant

    def held_out(self, terms: Sequence[Term]) -> float:
        """χ² of what base and ``terms`` leave of each fold, fitted to the others."""
        gram, free = self.space.free(terms, folds=True)
        return gram.left_out(free)[0]

    def refined(self, term: Term, others: Sequence[Term], kept: Collection[str] = ()) -> tuple[Term, float]:
        """``term`` at the best setting of its nonlinear parameters, but those ``kept``, beside ``others``; the χ²."""
        if term.effect.about:
            return (term, self.chi2([*others, term])) if kept else self._refined_about(term, others)
        from scipy.optimize import minimize_scalar

        best, low = term, self.chi2([*others, term])
        for k, name in enumerate(term.effect.nonlinear()):
            p = term.effect.parameters()[name]
            if name in kept:
                continue
            if p.discrete:
                best, low = self._best_of(best, k, p.grid, others)
                continue
            grid = sorted({s[k] for s in settings(term.effect, self.space)})
            at = int(np.argmin(np.abs(np.array(grid) - best.setting[k])))
            ends = (grid[at - 2] if at > 1 else p.bounds[0], grid[at + 2] if at + 2 < len(grid) else p.bounds[1])

            def moved(u: float, here: Term = best, k: int = k, log: bool = p.log) -> Term:
                setting = (*here.setting[:k], float(np.exp(u)) if log else float(u), *here.setting[k + 1 :])
                return self.space.term(here.effect, setting)

            def cost(u: float, moved: Callable[[float], Term] = moved) -> float:
                return self.chi2([*others, moved(u)])

            bounds = tuple(np.log(ends)) if p.log else ends
            answer = minimize_scalar(cost, bounds=bounds, method="bounded", options={"maxiter": 14})
            if answer.fun < low:
                best, low = moved(float(answer.x)), float(answer.fun)
        return best, low

    def _best_of(self, term: Term, k: int, grid: Sequence[float], others: Sequence[Term]) -> tuple[Term, float]:
        """``term`` with the value of its parameter ``k`` that makes it most certain, and the χ² there."""
        now = self.chi2(others)
        tried = [self.space.term(term.effect, (*term.setting[:k], v, *term.setting[k + 1 :])) for v in grid]
        chi2 = [self.chi2([*others, t]) for t in tried]
        z = [float(equivalent_z(now - x, t.freedom)) for t, x in zip(tried, chi2, strict=True)]
        best = max(range(len(z)), key=z.__getitem__)
        return tried[best], chi2[best]

    def _refined_about(self, term: Term, others: Sequence[Term]) -> tuple[Term, float]:
        for _ in range(LATE_TURNS):
            tau = self.value(term, others)
            if term.name == "angular_acceleration":
                tau = -tau
            if term.setting and abs(tau - term.setting[0]) < 1e-3 * abs(tau):
                break
            term = self.space.term(term.effect, [tau])
        return term, self.chi2([*others, term])

    def value(self, term: Term, others: Sequence[Term]) -> float:
        """The coefficient of ``term``'s one column beside ``others``."""
        gram, free = self.space.free([*others, term])
        return float(gram.coefficients(free)[0][-1])

    def placed(self, effects: Sequence[str]) -> list[Term]:
        """The terms of ``effects`` where they do best together, in the noise that they leave.

        Raises Problem diagnosis.effect_not_possible for one that is not among the suspects.
        """
        self.terms()
        placed: list[Term] = []
        for name in effects:
            if name not in self.columns:
                raise Problem("diagnosis.effect_not_possible", effect=name)
            placed.append(min(self.columns[name], key=lambda t: self.chi2([*placed, t])))
        for _ in range(TURNS):
            self.space.refit_noise(placed)
            for k, term in enumerate(placed):
                placed[k] = self.refined(term, [*placed[:k], *placed[k + 1 :]])[0]
        return placed

    def large(self) -> list[Term]:
        """The two best effects at most, as far as they explain much."""
        ranking = self.scan()[1]
        if not ranking or ranking[0].z < PLAIN:
            return []
        trial = Search(self.space, self.suspects, self.rng, columns=self.columns)
        for _ in range(2):
            field = trial._field(trial.prepare())
            if not field or field[0].gain < LARGE:
                break
            trial.chosen.append(field[0].term)
            trial.settle()
        return trial.chosen

    def run(self, most: int = MOST) -> None:
        """Adds effects one by one while the best passes the threshold and buys its share; fills ``findings``."""
        while True:
            ranking = self.prepare()
            # Half of the noise's uncertainty is that of every z.
            self.threshold = self.null_tail(self.terms()) * (1.0 + 0.5 * min(self.space.doubt, 1.0))
            self.last = ranking
            sure = {s.term.name for s in ranking if s.sure >= self.threshold}
            if not sure or len(self.chosen) - self.given >= most:
                return
            rivals = self._field(ranking)
            held, left = self._beside(self.chosen)
            while rivals and not (
                rivals[0].term.name in sure
                and rivals[0].z >= self.threshold * math.sqrt(self.space.unrest(rivals[0].term, held, left))
            ):
                del rivals[0]
            rest = self.chi2(self.chosen)
            needed = asked(self.space, self.chi2([]) - rest, rest)
            if not rivals or self._beside_refined(rivals[0].term, rest) < needed:
                return
            simplest = min((s for s in rivals if rivals[0].gain - s.gain < 1.0), key=lambda s: len(s.term.setting))
            self.findings.append(Finding(simplest, rivals, self.threshold))
            self.chosen.append(simplest.term)
            self.settle()

    def prepare(self) -> list[Suspicion]:
        """Estimates the noise beside the chosen and the best classes, and ranks all classes with it."""
        gram, ranking = self.scan()
        company = self._company(gram, ranking)
        if ranking and ranking[0].z > PLAIN:
            # What is not quite its shape would pose as noise.
            company = [self.refined(t, self.chosen)[0] if t is ranking[0].term else t for t in company]
        # Nor are the chosen ones' times right until all stand beside them.
        self.space.refit_noise([*self._settled(self.chosen, company), *company])
        return self.scan()[1]

    def _field(self, ranking: Sequence[Suspicion]) -> list[Suspicion]:
        """The best classes, refined beside the chosen, best first."""
        now = self.chi2(self.chosen)
        field: list[Suspicion] = []
        for s in ranking:
            if s.z < 0.5 * ranking[0].z or len(field) >= FIELD:
                break
            term, chi2 = self.refined(s.term, self.chosen)
            if not (term.effect.positive and self.value(term, self.chosen) < 0.0):
                field.append(Suspicion(term, now - chi2, float(equivalent_z(now - chi2, term.freedom))))
        return sorted(field, key=lambda s: -s.gain)

    def _beside_refined(self, term: Term, rest: float) -> float:
        """What ``term`` takes off the χ² ``rest`` when the chosen ones' nonlinear parameters give way to it."""
        trial = Search(self.space, self.suspects, self.rng, [*self.chosen, term], columns=self.columns)
        trial.settle()
        return rest - trial.chi2(trial.chosen)

    def exchange(self) -> None:
        """Puts in the place of each chosen effect the rival that does better now that the others are there."""
        for k, others in enumerate(self.rivals()):
            own = next((s.gain for s in others if s.term is self.chosen[k]), -math.inf)
            if k >= self.given and others[0].gain > own + 1.0:
                best = others[0]
                z = float(equivalent_z(best.gain, best.term.freedom))
                self.chosen[k] = best.term
                self.findings[k - self.given].chosen = Suspicion(best.term, best.gain, z)
                self.settle()
                return

    def split(self) -> bool:
        """Puts two effects in the place of one that passed for both, where that buys what a second effect must."""
        for k in range(self.given, len(self.chosen) if len(self.chosen) - self.given < MOST else 0):
            others, now = [*self.chosen[:k], *self.chosen[k + 1 :]], self.chi2(self.chosen)
            trial = Search(self.space, self.suspects, self.rng, chosen=others, columns=self.columns)
            ranking = [s for s in trial.scan()[1] if s.term.name != self.chosen[k].name][:PAIRED]
            pairs = [(self.chi2([*others, a.term, b.term]), a, b) for a, b in combinations(ranking, 2)]
            if not pairs:
                continue
            _, a, b = min(pairs, key=lambda pair: pair[0])
            both = self._settled([*others, a.term, b.term])
            left = self.chi2(both)
            found = []
            for one in both[-2:]:
                gain = self.chi2([t for t in both if t is not one]) - left
                found.append(Suspicion(one, gain, float(equivalent_z(gain, one.freedom))))
            if min(equivalent_z(now - left, 1), *(s.z for s in found)) > self.threshold:
                self.chosen = both
                del self.findings[k - self.given]
                self.findings += [Finding(s, [s], self.threshold) for s in found]
                return True
        return False

    def rivals(self) -> list[list[Suspicion]]:
        """For each chosen effect, every effect that would serve in its place, the others kept: itself first or near."""
        answer = []
        for k, term in enumerate(self.chosen):
            others = [*self.chosen[:k], *self.chosen[k + 1 :]]
            now = self.chi2(others)
            trial = Search(self.space, self.suspects, self.rng, chosen=others, columns=self.columns)
            _, ranking = trial.scan()
            field = [Suspicion(term, now - self.chi2([*others, term]), 0.0)]
            for place, s in enumerate(ranking[:8]):
                # Beside the first few the others may stand elsewhere, however little is left for them where they are.
                near = bool(others) and place <= SETTLED
                if s.term.name != term.name and (near or s.z > 0.5 * ranking[0].z):
                    other, chi2 = self.refined(s.term, others)
                    if near:
                        chi2 = min(chi2, self.chi2(self._settled([*others, other])))
                    if not (other.effect.positive and self.value(other, others) < 0.0):
                        field.append(Suspicion(other, now - chi2, 0.0))
            field.sort(key=lambda s: -s.gain)
            answer.append([s for s in field if field[0].gain - s.gain < _margin(field[0], s)])
        return answer

    def confirm(self) -> None:
        """Drops what no longer passes once the noise is that of the chosen model alone.

        While the search goes on the noise is estimated beside the best of all classes, which makes it small.
        """
        self.space.refit_noise(self.chosen)
        while len(self.chosen) > self.given:
            both = self.chi2(self.chosen)
            weakest, least = self.given, np.inf
            for k in range(self.given, len(self.chosen)):
                gain = self.chi2([*self.chosen[:k], *self.chosen[k + 1 :]]) - both
                z = float(equivalent_z(gain, self.chosen[k].freedom))
                if z < least:
                    weakest, least = k, z
            if least >= self.findings[weakest - self.given].threshold:
                return
            del self.chosen[weakest], self.findings[weakest - self.given]
            self.space.refit_noise(self.chosen)

    def merge(self) -> None:
        """Two effects that one other explains as well were that one: the truth may not look best at first."""
        while len(self.chosen) - self.given >= 2:
            for i, j in combinations(range(self.given, len(self.chosen)), 2):
                others = [t for k, t in enumerate(self.chosen) if k not in (i, j)]
                trial = Search(self.space, self.suspects, self.rng, chosen=others, columns=self.columns)
                _, ranking = trial.scan()
                both = self.chi2(self.chosen)
                for s in ranking[:4]:
                    term, chi2 = self.refined(s.term, others)
                    pair = [self.chosen[i].name, self.chosen[j].name]
                    if chi2 < both + RIVAL and term.name not in pair:
                        if chi2 > both:
                            self.alternatives.append([[term.name], pair])
                        self.chosen = [*others, term]
                        self.findings = [*self.findings[: len(others)], Finding(s, [s], self.threshold)]
                        break
                else:
                    continue
                break
            else:
                return

    def _company(self, gram: Gram, ranking: Sequence[Suspicion]) -> list[Term]:
        """The best classes whose columns are not nearly spanned by those before them: REML wants a clean basis."""
        place = dict(zip(map(id, self.terms()), self._places, strict=True))
        kept = [k for p in _places(self.chosen, gram.base) for k in p]
        company: list[Term] = []
        for s in ranking:
            columns = place[id(s.term)]
            if np.diag(gram.without(kept))[columns].min() > CLEAN:
                kept += columns
                company.append(s.term)
            if len(company) == NOISE_COMPANY:
                break
        return company

    def settle(self) -> None:
        """Refines the nonlinear parameters of all chosen terms beside each other."""
        if len(self.chosen) > 1:
            self.chosen = self._settled(self.chosen)

    def _settled(self, terms: Sequence[Term], company: Sequence[Term] = ()) -> list[Term]:
        """``terms`` where they do best beside each other and ``company``: anywhere on the grid, then refined."""
        settled = list(terms)
        for k, term in enumerate(settled):
            if not (term.effect.nonlinear() or term.effect.about):
                continue
            others = [*settled[:k], *settled[k + 1 :], *company]
            if term.effect.nonlinear():
                now = self.chi2([*others, term])
                best = min(self.columns.get(term.name, []), key=lambda t: self.chi2([*others, t]), default=term)
                term = best if self.chi2([*others, best]) < now - 1.0 else term
            settled[k] = self.refined(term, others)[0]
        return settled


def asked(space: Space, explained: float, rest: float) -> float:
    """χ² that one more effect must take off the ``rest`` where a model has ``explained`` so much."""
    if space.design.reference == "rate":
        return SHARE_RATE * explained
    return min(SHARE * explained, REST * rest)


def _margin(best: Suspicion, other: Suspicion) -> float:
    """2ΔlnL within which ``other`` serves as well as the ``best``; a step is at the best of many places."""
    tuned = best.term.effect.nonlinear()
    return RIVAL + form(best.term.effect, other.term.effect, best.gain) + (TUNED if tuned else 0.0)


def form(best: type[Effect], other: type[Effect], gain: float) -> float:
    """How much of the ``gain`` of ``best`` its form may owe to chance: forms are never quite right, but those of late
    answers, which are series in the same small number."""
    return 0.0 if best.curvature is not None and other.curvature is not None else FORM * gain


def settings(effect: type[Effect], space: Space) -> list[tuple[float, ...]]:
    """The grid of the effect's nonlinear parameters; times of a step lie all along the record."""
    if effect.name == "bias_step":
        end = float(space.covariates.time_s[-1])
        step = max(STEP_EVERY_S, end / STEPS)
        return [(float(t),) for t in np.arange(step, end - step / 2.0, step)]
    return list(product(*(effect.parameters()[name].grid for name in effect.nonlinear())))


def equivalent_z(gain: float | F64, freedom: int) -> float | F64:
    """The |z| of one normal variable that is as improbable as ``gain`` with ``freedom`` degrees of freedom."""
    if freedom == 1:
        return np.sqrt(np.maximum(gain, 0.0))
    from scipy.special import chdtrc, ndtri

    tail = np.maximum(chdtrc(freedom, np.minimum(np.maximum(gain, 0.0), 600.0)), 1e-290)
    return np.where(np.asarray(gain) < 600.0, -ndtri(tail / 2.0), np.sqrt(np.maximum(gain - 2.0 * freedom, 0.0)))[()]


def _places(terms: Iterable[Term], base: int) -> list[list[int]]:
    """The indices of each term's columns in the Gram matrix."""
    places, at = [], 1 + base
    for term in terms:
        places.append(list(range(at, at + term.columns.shape[1])))
        at += term.columns.shape[1]
    return places
