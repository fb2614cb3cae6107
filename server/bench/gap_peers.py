"""What others would use on the same records: PySINDy, LassoCV, orthogonal matching pursuit and forward BIC.

They get an exact reference rate and the library's own columns, scaled; they answer with the columns they keep. The
first three are in the dependency group ``bench``; where they are not installed, the rows say so.
"""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from server.bench import Row
from server.bench import gap_campaign as campaign
from server.bench.coverage import wilson
from server.bench.gap_campaign import Case, as_recording
from server.bench.gap_records import Record

F64 = NDArray[np.float64]
Select = Callable[[F64, F64], F64]
"""Coefficients (p,) from scaled columns (n, p) and what the base leaves of the output (n,), both of mean 0."""

BLOCKS = 8
GRID = 3
"""So many settings of a nonlinear effect become columns."""


@dataclass(frozen=True)
class Answer:
    """What one tool said of one record: names by size, and error over floor on the blocks it had not seen."""

    names: tuple[str, ...]
    ratio: float


def run(*, quick: bool) -> Iterator[Row]:
    """One table: false alarms, right names and held-out error of every tool, ours last."""
    yield from part(count=1, quick=True) if quick else part()


def part(first: int = 0, count: int | None = None, *, quick: bool = False) -> Iterator[Row]:
    """The table of ``count`` cases of each of the four groups (all), beginning with number ``first``."""
    groups = {name: cases[first:][:count] for name, cases in _cases(40, 4).items()}
    if quick:
        groups = {name: groups[name] for name in ("white", "one, white")}
    tools: dict[str, Select | None] = {
        "forward BIC": _forward_bic,
        "PySINDy STLSQ": _installed(_pysindy, "pysindy"),
        "LassoCV": _installed(_lasso, "sklearn"),
        "matching pursuit CV": _installed(_pursuit, "sklearn"),
    }
    made = {name: [(case, case.made()) for case in cases] for name, cases in groups.items()}
    for tool, select in list(tools.items())[: 1 if quick else None]:
        if select is None:
            yield Row(tool, float("nan"), "", ours="not installed: uv sync --group bench")
        else:
            yield from _table(tool, {group: [(c, _answer(m, select)) for c, m in rows] for group, rows in made.items()})
    if not quick:
        yield from _table("Gyrobench", {group: [(c, _ours(c)) for c, _ in rows] for group, rows in made.items()})


def _cases(healthy: int, each: int) -> dict[str, list[Case]]:
    """Records with an exact reference rate: nothing in them, or one effect at 3 × detectability."""

    def plain(kind: str) -> list[Case]:
        cases = campaign.healthy(kind, healthy)
        return [Case(c.group, c.number, {}, {**c.options, "reference": "rate"}) for c in cases]

    one = sorted(campaign.with_rate(3.0, each), key=lambda case: case.seed)
    return {
        "white": plain("white"),
        "coloured": plain("0.95"),
        "one, white": [c for c in one if not c.options.get("ar1_V")],
        "one, coloured": [c for c in one if c.options.get("ar1_V")],
    }


def _table(tool: str, answers: Mapping[str, Sequence[tuple[Case, Answer]]]) -> Iterator[Row]:
    for noise in [name for name in ("white", "coloured") if name in answers]:
        healthy, one = answers[noise], answers[f"one, {noise}"]
        alarms = np.mean([bool(a.names) for _, a in healthy])
        first = np.mean([a.names[:1] == tuple(c.effects) for c, a in one])
        only = np.mean([a.names == tuple(c.effects) for c, a in one])
        ratios = [a.ratio for _, a in one]
        told = _interval(alarms, healthy)
        yield Row(f"{tool}: something found in healthy records, {noise}", 100 * float(alarms), "%", ours=told)
        told = f"{_interval(first, one)}; {100 * float(only):.0f} % with no other name beside it"
        yield Row(f"{tool}: right name first at 3 × detectability, {noise}", 100 * float(first), "%", ours=told)
        told = f"95th percentile {np.quantile(ratios, 0.95):.4g}"
        yield Row(f"{tool}: held-out ÷ floor, median, {noise}", float(np.median(ratios)), "1", ours=told)


def _interval(found: Any, answers: Sequence[tuple[Case, Answer]]) -> str:
    n, seeds = len(answers), [case.seed for case, _ in answers]
    low, high = wilson(round(float(found) * n), n)
    return f"{n} records, {100 * low:.0f} to {100 * high:.0f} %, seeds {min(seeds)}…{max(seeds)}"


def _installed(select: Select, package: str) -> Select | None:
    from importlib.util import find_spec

    return select if find_spec(package) else None


def _answer(made: Record, select: Select) -> Answer:
    """Names from the whole record; error from a fit on every other block of time."""
    names, base, columns, output = _problem(made)
    coefficients = _fit(base, columns, output, select)
    sizes = {
        name: float(np.sqrt(np.mean((columns[:, list(part)] @ coefficients[list(part)]) ** 2)))
        for name, part in _parts(names)
    }
    found = tuple(sorted((n for n in sizes if sizes[n] > 0.0), key=lambda n: -sizes[n]))
    block = np.arange(len(output)) * BLOCKS // len(output)
    seen = block % 2 == 0
    kept = _fit(base[seen], columns[seen], output[seen], select)
    everything = np.column_stack([base, columns])
    own = np.linalg.lstsq(base[seen], output[seen] - columns[seen] @ kept, rcond=None)[0]
    left = (output - everything @ np.concatenate([own, kept]))[~seen]
    return Answer(found, float(np.sqrt(np.mean(left**2) / np.mean(made.gyro_noise_dps[~seen] ** 2))))


def _ours(case: Case) -> Answer:
    said = campaign.play(case)
    names = said.named if said.verdict != "adequate" else ()
    return Answer(names or (("unknown",) if said.verdict == "unknown" else ()), said.held_out / said.floor)


def _problem(made: Record) -> tuple[list[str], F64, F64, F64]:
    """Names of the columns' effects; base (n, 2), columns (n, p) and output (n,) in deg/s."""
    from calib_core import covariates
    from calib_core.effects import Acts, library
    from calib_core.gap import BY_ITSELF
    from calib_core.gap_search import settings
    from calib_core.gap_space import Space
    from calib_core.integral_fit import Design

    recording, axis = as_recording(made), str(made.truth["axis"])
    design = Design.of(recording, axis)
    rough = design.rough()
    space = Space(design, covariates.of(recording, axis, design, float(rough[0]), float(rough[1])), rough)
    names, columns = [], []
    for name, effect in library().items():
        if name in BY_ITSELF or effect.missing(space.covariates) or effect.acts is Acts.ANGLE:
            continue
        grid = settings(effect, space)
        for setting in grid[:: max(1, len(grid) // GRID)]:
            _, shapes = space.shapes(space.term(effect, setting))
            columns.append(shapes)
            names += [name] * shapes.shape[1]
    wide = np.column_stack(columns)
    spread = wide.std(axis=0)
    useful = np.flatnonzero(spread > 1e-12)
    scale = space.scale_factor
    rate = made.columns[f"{axis}_rate_dps"]
    output = made.columns[f"{axis}_gyro_v"] / scale
    base = np.column_stack([np.ones(len(rate)), rate])
    return [names[k] for k in useful], base, wide[:, useful] / spread[useful], output


def _fit(base: F64, columns: F64, output: F64, select: Select) -> F64:
    """Coefficients of the columns; bias and scale factor are taken out of everything first, as they always belong."""
    own, _ = np.linalg.qr(base)
    clear = columns - own @ (own.T @ columns)
    size = clear.std(axis=0)
    size[size < 1e-9] = np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.asarray(select(clear / size, output - own @ (own.T @ output)) / size)


def _parts(names: Sequence[str]) -> Iterator[tuple[str, tuple[int, ...]]]:
    for name, group in groupby(range(len(names)), key=lambda k: names[k]):
        yield name, tuple(group)


def _blocked() -> Any:
    from sklearn.model_selection import KFold

    return KFold(BLOCKS, shuffle=False)


def _lasso(columns: F64, output: F64) -> F64:
    from sklearn.linear_model import LassoCV

    return np.asarray(LassoCV(cv=_blocked(), fit_intercept=False).fit(columns, output).coef_)


def _pursuit(columns: F64, output: F64) -> F64:
    from sklearn.linear_model import OrthogonalMatchingPursuitCV

    return np.asarray(OrthogonalMatchingPursuitCV(cv=_blocked(), fit_intercept=False).fit(columns, output).coef_)


def _pysindy(columns: F64, output: F64) -> F64:
    from pysindy import STLSQ

    return np.asarray(STLSQ().fit(columns, output[:, None]).coef_[0])


def _forward_bic(columns: F64, output: F64) -> F64:
    """Adds the column that lowers BIC most, until none does."""
    n, chosen = len(output), list[int]()
    left, best = output, n * np.log(np.mean(output**2))
    while len(chosen) < 10:
        gains = (columns.T @ left) ** 2
        k = int(np.argmax(gains))
        trial = [*chosen, k]
        fit = np.linalg.lstsq(columns[:, trial], output, rcond=None)[0]
        rest = output - columns[:, trial] @ fit
        score = n * np.log(np.mean(rest**2)) + len(trial) * np.log(n)
        if score >= best or k in chosen:
            break
        chosen, left, best = trial, rest, score
    out = np.zeros(columns.shape[1])
    if chosen:
        out[chosen] = np.linalg.lstsq(columns[:, chosen], output, rcond=None)[0]
    return out
