"""What is missing in gyro = offset + gain · reference, asked of independent readings (``gyro-points 1``).

There is no time order here, so only effects of the rate itself can be tested, and one of time: a bias that has moved
since it was estimated, which in a position test adds up over the time of the move. The encoder is the reference; what
is wrong with it along its track cannot be told from the gyro.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core.effects import Acts, Covariates, Effect, library
from calib_core.formula import UserEffect
from calib_core.gap import p_value
from calib_core.gap_checks import Check
from calib_core.gap_search import FALSE_ALARM, FORM, RIVAL
from calib_core.points import Points
from calib_core.problem import Problem

F64 = NDArray[np.float64]

OF_RATE = ("scale_factor_quadratic", "scale_factor_cubic", "scale_factor_asymmetry", "dead_band")
MOVED = "bias_step"
FEWEST = 8
BLOCKS = 8
MOST = 3
DRAWS = 4000
FAILING = 4.0
OWN = 0.03
"""A column that is others to within this share cannot be told from them: readings miss their set-points by as much."""
SPEED_DPS = 50.0
"""Of a move in a position test, where its duration is not written down."""


@dataclass(frozen=True, eq=False)
class Column:
    """What one effect does to the readings, for a parameter of one; ``size`` is the parameter's name."""

    effect: type[Effect]
    shape: F64
    size: str
    times_gain: bool
    """Whether the parameter acts on what the sensor feels, so that the gain multiplies it."""

    @property
    def name(self) -> str:
        return self.effect.name


@dataclass(frozen=True, eq=False)
class Fit:
    """Least squares of the readings on base and columns."""

    values: F64
    covariance: F64
    residual: F64

    @property
    def squares(self) -> float:
        return float(self.residual @ self.residual)


class Readings:
    """Readings of one board and axis, and the columns that its effects would leave in them."""

    def __init__(self, points: Points) -> None:
        self.points = points
        self.axis = str(points.axis[0])
        self.angles = points.kind == "position"
        self.unit = "deg" if self.angles else "deg/s"
        self.suffix = "deg" if self.angles else "dps"
        self.reference, self.gyro = points.reference, points.gyro
        set_point, one = points.set_point, np.ones(len(points))
        duration = np.where(np.isnan(points.duration_s), np.abs(set_point) / SPEED_DPS, points.duration_s)
        self.duration_s = duration if self.angles else one
        """What the offset adds up over; the effects of rate act while the angle is turned, at a steady rate."""
        rate = np.divide(set_point, duration, out=0.0 * one, where=duration > 0.0) if self.angles else self.reference
        self.turning_s = np.divide(self.reference, rate, out=0.0 * one, where=rate != 0.0) if self.angles else one
        self.covariates = Covariates(
            axis=self.axis, time_s=np.zeros(len(points)), rate_dps=rate, position_deg=np.zeros(len(points)),
            acceleration_dps2=np.zeros(len(points)), direction=np.sign(rate), interval_s=1.0,
        )  # fmt: skip
        self.base = np.column_stack([np.ones(len(points)), self.reference])

    def columns(self, suspects: dict[str, type[Effect]]) -> list[Column]:
        """One for each suspect that a reading can show."""
        found = []
        for name in (n for n in OF_RATE if n in suspects):
            effect = suspects[name]
            if name == "dead_band":
                # Below the slowest set-point the width is the coefficient: every reading is short by it.
                found.append(Column(effect, -np.sign(self.covariates.rate_dps) * self.turning_s, "d", True))
            else:
                (size, shape), *_ = effect.columns(self.covariates).items()
                found.append(Column(effect, shape * self.turning_s, size, True))
        for effect in suspects.values():
            known = issubclass(effect, UserEffect) and set(effect.formula.names) <= {"rate_dps", "direction"}
            if known and effect.acts is not Acts.ANGLE and not effect.missing(self.covariates):
                ((size, shape),) = effect.columns(self.covariates).items()
                felt = effect.acts is Acts.RATE
                found.append(Column(effect, shape * (self.turning_s if felt else self.duration_s), size, felt))
        if MOVED in suspects:
            found.append(Column(suspects[MOVED], self.duration_s, "a", False))
        return found

    def fit(self, columns: Sequence[Column], seen: NDArray[np.bool_] | None = None) -> Fit:
        """Base and columns on the readings ``seen``; the residual is of all of them."""
        design = np.column_stack([self.base, *(c.shape for c in columns)])
        size = np.abs(design).max(axis=0)
        rows = slice(None) if seen is None else seen
        scaled = design[rows] / size
        inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12, hermitian=True)
        values = inverse @ (scaled.T @ self.gyro[rows]) / size
        residual = self.gyro - design @ values
        freedom = max(len(scaled) - design.shape[1], 1)
        spread = float(residual[rows] @ residual[rows]) / freedom
        return Fit(values, spread * inverse / np.outer(size, size), residual)

    def own(self, columns: Sequence[Column], chosen: Sequence[Column]) -> F64:
        """(n, p) of unit length: what each column has beside base and ``chosen``; nan where that is nothing."""
        held, _ = np.linalg.qr(np.column_stack([self.base, *(c.shape for c in chosen)]))
        shapes = np.column_stack([c.shape / np.abs(c.shape).max() for c in columns])
        free = shapes - held @ (held.T @ shapes)
        size = np.sqrt((free**2).sum(axis=0))
        return np.asarray(free / np.where(size > OWN * np.sqrt((shapes**2).sum(axis=0)), size, np.nan))

    def held_out(self, columns: Sequence[Column]) -> float:
        """RMS of readings left out in turn: every eighth reading of each set-point."""
        _, place = np.unique(self.points.set_point, return_inverse=True)
        order = np.argsort(place, kind="stable")
        block = np.empty(len(order), int)
        block[order] = np.arange(len(order)) % BLOCKS
        return self._left_out(columns, block)

    def at_other_places(self, columns: Sequence[Column]) -> float:
        """RMS of readings where all of their set-point were left out."""
        return self._left_out(columns, np.unique(self.points.set_point, return_inverse=True)[1])

    def _left_out(self, columns: Sequence[Column], block: NDArray[np.int64]) -> float:
        squares = 0.0
        for k in range(int(block.max()) + 1):
            squares += float(np.sum(self.fit(columns, block != k).residual[block == k] ** 2))
        return float(np.sqrt(squares / len(self.gyro)))

    def by_set_point(self, column: Column, others: Sequence[Column]) -> float:
        """2ΔlnL of ``column`` where all readings of a set-point count as one: they share the encoder's error."""
        _, place, count = np.unique(self.points.set_point, return_inverse=True, return_counts=True)
        rows = np.column_stack([self.gyro, self.base, *(c.shape for c in others), column.shape])
        means = np.stack([np.bincount(place, weights=row) for row in rows.T], axis=1) / count[:, None]
        means /= np.abs(means).max(axis=0)
        squares = [
            float(np.sum((means[:, 0] - x @ np.linalg.lstsq(x, means[:, 0], rcond=None)[0]) ** 2))
            for x in (means[:, 1:-1], means[:, 1:])
        ]
        return float(len(count) * np.log(squares[0] / squares[1])) if squares[1] > 0.0 else float("inf")

    def scatter(self) -> float:
        """Standard deviation of readings about the mean of their set-point; nan without repeats."""
        squares, freedom = 0.0, 0
        for place in np.unique(self.points.set_point):
            here = self.gyro[self.points.set_point == place]
            squares, freedom = squares + float(np.sum((here - here.mean()) ** 2)), freedom + len(here) - 1
        return float(np.sqrt(squares / freedom)) if freedom else float("nan")


def diagnose(
    points: Points, *, effects: Sequence[str] = (), suspects: dict[str, type[Effect]] | None = None, seed: int = 0
) -> dict[str, Any]:
    """CONTRACT 3 for the readings of one board and axis, with codes and values, without sentences."""
    pool = dict(library() if suspects is None else suspects)
    readings = Readings(points)
    failed = _checks(readings)
    if any(check.blocking for check in failed):
        return _answer(
            readings, failed, {"verdict": "not_testable", "code": failed[0].code, "values": dict(failed[0].values)}
        )
    columns = readings.columns(pool)
    asked = [_asked(name, columns) for name in effects]
    alone = _gains(readings, [c for c in columns if c not in asked], asked)
    chosen, gains = _search(readings, columns, asked, np.random.default_rng(seed))
    rivals = [_rivals(readings, columns, chosen, k) for k in range(len(asked), len(chosen))]
    verdict = "adequate" if len(chosen) == len(asked) else "ambiguous" if any(len(r) > 1 for r in rivals) else "missing"
    after, s = readings.held_out(chosen), readings.suffix
    missing = [
        {"effect": c.name, "two_delta_lnL": gain, "p": p_value(gain**0.5), f"held_out_rms_{s}": after,
         "two_delta_lnL_by_set_point": readings.by_set_point(c, [x for x in chosen if x is not c]),
         "parameters": [p for p in _parameters(readings, chosen) if p["name"].startswith(f"{c.name}.")]}
        for c, gain in zip(chosen[len(asked) :], gains, strict=True)
    ]  # fmt: skip
    said = {
        "verdict": verdict, "code": f"diagnosis.{verdict}", "values": {},
        "model": {"effects": [c.name for c in asked], "parameters": _parameters(readings, asked)},
        "noise": {f"white_{s}": readings.scatter(), "correlation_time_s": None},
        "error": {f"held_out_rms_{s}": readings.held_out(asked), f"floor_rms_{s}": readings.scatter(),
                  "holdout": {"block_s": None, "blocks": BLOCKS}},
        "where_it_fails": _failures(readings, readings.fit(asked).residual),
        "missing": missing,
        "rivals": [r for r in rivals if len(r) > 1],
        "candidates": _candidates(pool, columns, alone),
        "after": {"effects": [c.name for c in chosen], f"held_out_rms_{s}": after,
                  "parameters": _parameters(readings, chosen)},
    }  # fmt: skip
    return _answer(readings, failed, said)


def _answer(readings: Readings, checks: Sequence[Check], said: dict[str, Any]) -> dict[str, Any]:
    board = str(readings.points.board[0]) or None
    empty: dict[str, Any] = {
        "recording": {"file": None, "board": board, "samples": len(readings.gyro), "duration_s": None},
        "axis": readings.axis, "unit": readings.unit, "verdict": "", "code": "", "values": {},
        "checks": [{"name": c.name, "ok": c.ok, "code": c.code, "values": dict(c.values)} for c in checks],
        "model": {"effects": [], "parameters": []}, "noise": None, "error": None, "where_it_fails": [], "missing": [],
        "rivals": [], "rival_sets": [], "candidates": [], "unknown": None, "next_experiment": None, "after": None,
    }  # fmt: skip
    return empty | said


def _checks(readings: Readings) -> list[Check]:
    """Enough readings, at three references or more, answered with the right sign."""
    n, places = len(readings.gyro), len(np.unique(readings.reference))
    if n < FEWEST or places < 3:
        return [
            Check(
                "readings", False, "check.points.too_few", {"readings": n, "set_points": places, "needed": FEWEST}, True
            )
        ]
    gain = float(readings.fit([]).values[1])
    if not 0.3 < gain < 3.0:
        told = {"axis": readings.axis, "gain": gain}
        return [Check("gain", False, "check.points.gain", told, True)]
    return [Check("readings", True, "check.points.readings_ok", {"readings": n, "set_points": places})]


def _asked(name: str, columns: Sequence[Column]) -> Column:
    found = next((c for c in columns if c.name == name), None)
    if found is None:
        raise Problem("diagnosis.effect_not_possible", effect=name)
    return found


def _search(
    readings: Readings, columns: Sequence[Column], asked: Sequence[Column], rng: np.random.Generator
) -> tuple[list[Column], list[float]]:
    """Adds the best column while it passes the maximum of all, buys its share and holds on readings not seen."""
    chosen, gains = list(asked), list[float]()
    first = readings.fit(asked).squares
    while True:
        free = [c for c in columns if c.name not in {x.name for x in chosen}]
        field = _gains(readings, free, chosen)
        if not field or len(gains) == MOST:
            return chosen, gains
        best = max(field, key=field.__getitem__)
        column = next(c for c in free if c.name == best)
        bought = field[best] >= FORM * len(readings.gyro) * np.log(first / readings.fit(chosen).squares)
        judged = readings.at_other_places if gains else readings.held_out
        holds = judged([*chosen, column]) < judged(chosen)
        if field[best] < null_tail(readings.own(free, chosen), rng) ** 2 or not (bought and holds):
            return chosen, gains
        chosen.append(column)
        gains.append(field[best])


def _gains(readings: Readings, columns: Sequence[Column], chosen: Sequence[Column]) -> dict[str, float]:
    """2ΔlnL of each column that the readings show beside ``chosen``, with an estimated variance."""
    if not columns:
        return {}
    now, n = readings.fit(chosen).squares, len(readings.gyro)
    slowest = float(np.abs(readings.covariates.rate_dps).min())
    own = readings.own(columns, chosen)
    gains = {}
    for column in (c for k, c in enumerate(columns) if np.isfinite(own[:, k]).all()):
        fit = readings.fit([*chosen, column])
        possible = column.name != "dead_band" or 0.0 <= fit.values[-1] / fit.values[1] <= slowest
        gains[column.name] = float(n * np.log(now / fit.squares)) if possible else 0.0
    return gains


def null_tail(own: F64, rng: np.random.Generator) -> float:
    """The quantile of the greatest |z| over all columns where nothing is missing (max-T)."""
    seen = own[:, np.isfinite(own).all(axis=0)]
    power, vectors = np.linalg.eigh(seen.T @ seen)
    draws = (vectors * np.sqrt(np.maximum(power, 0.0))) @ rng.standard_normal((seen.shape[1], DRAWS))
    return float(np.quantile(np.abs(draws).max(axis=0), 1.0 - FALSE_ALARM))


def _rivals(readings: Readings, columns: Sequence[Column], chosen: Sequence[Column], k: int) -> list[str]:
    """Every effect that would serve in the place of the k-th, the others kept: the best first."""
    others = [*chosen[:k], *chosen[k + 1 :]]
    taken = {c.name for c in others}
    gains = _gains(readings, [c for c in columns if c.name not in taken], others)
    best = max(gains.values())
    return sorted((name for name, gain in gains.items() if best - gain < RIVAL), key=lambda name: -gains[name])


def _candidates(
    pool: dict[str, type[Effect]], columns: Sequence[Column], alone: dict[str, float]
) -> list[dict[str, Any]]:
    """What each effect of the library would bring by itself, or why it was not tried."""
    possible = {c.name for c in columns}
    rows = []
    for name in pool:
        status = "tested" if name in alone else "not_excited" if name in possible else "no_data"
        gain = alone.get(name)
        p = None if gain is None else p_value(max(gain, 0.0) ** 0.5)
        rows.append({"effect": name, "status": status, "two_delta_lnL": gain, "p": p, "held_out_gain": None})
    return rows


def _parameters(readings: Readings, columns: Sequence[Column]) -> list[dict[str, Any]]:
    """Offset, gain and each effect's parameter, in the points' unit."""
    fit, s, unit = readings.fit(columns), readings.suffix, readings.unit
    spread = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    rows = [
        (f"bias_{s}", fit.values[0], unit, spread[0]),
        (f"scale_factor_{s}_per_{s}", fit.values[1], "1", spread[1]),
    ]
    for k, column in enumerate(columns, start=2):
        per = fit.values[1] if column.times_gain else 1.0
        told = column.effect.parameters()[column.size].unit.replace("{out}", "deg/s")
        rows.append((f"{column.name}.{column.size}", fit.values[k] / per, told, spread[k] / per))
    return [
        {"name": name, "value": float(value), "unit": u, "standard_uncertainty": float(uncertainty)}
        for name, value, u, uncertainty in rows
    ]


def _failures(readings: Readings, residual: F64) -> list[dict[str, Any]]:
    """The worst stretch of the reference in which the mean residuals of all set-points have one sign."""
    noise = readings.scatter()
    noise = noise if noise > 0.0 else float(np.std(residual))
    order = np.argsort(readings.reference, kind="stable")
    places = np.unique(readings.reference)
    means = np.array([residual[readings.reference == place].mean() for place in places])
    turns = np.flatnonzero(np.diff(np.sign(means)) != 0.0) + 1
    stretches = []
    for a, b in pairwise([0, *turns.tolist(), len(places)]):
        inside = order[(readings.reference[order] >= places[a]) & (readings.reference[order] <= places[b - 1])]
        mean = float(residual[inside].mean())
        stretches.append((abs(mean) * len(inside) ** 0.5 / noise, mean, float(places[a]), float(places[b - 1])))
    z, mean, low, high = max(stretches)
    if z < FAILING:
        return []
    name = f"{readings.axis}_{'position_deg' if readings.angles else 'rate_dps'}"
    key = f"residual_{readings.suffix}"
    return [{"covariate": name, "from": low, "to": high, key: mean, "z": float(np.copysign(z, mean))}]
