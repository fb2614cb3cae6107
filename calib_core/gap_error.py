"""How well a model explains data it has not seen, and where it fails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calib_core.effects.base import Acts
from calib_core.gap_space import Gram, Space, Term
from calib_core.weak_form import Windows

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

BLOCKS = 8
BINS = 14


@dataclass(frozen=True)
class Error:
    """Error on unseen data, and the least that the noise allows."""

    held_out_rms_dps: float
    floor_rms_dps: float
    block_s: float
    blocks: int


@dataclass(frozen=True)
class Failure:
    """A stretch of a covariate where the residual is not noise."""

    covariate: str
    low: float
    high: float
    residual_dps: float
    z: float


class Explanation:
    """Base and terms fitted with each block of time left out in turn; residuals of windows in deg/s."""

    def __init__(self, space: Space, terms: Sequence[Term]) -> None:
        self.space, self.terms = space, terms
        design, c = space.design, space.covariates
        samples = design.averages.samples
        scale = space.scale_factor or 1.0
        self.windows = windows = Windows(len(samples.time_s), samples.interval_s)
        self.first = self._whole(windows)
        rate_shapes, angle_shapes = self._shapes()
        output = (samples.output - space.values[0]) / scale
        truth = windows.rate(_angle(space)) if design.readings is not None else windows.mean(c.rate_dps[:, None])
        base = [np.ones(len(output)) / scale]
        if design.moves:
            base.append(c.rate_dps / scale)
        base += [np.zeros(len(output))] * (space.base.shape[1] - len(base))
        self.columns = np.column_stack(
            [windows.mean(np.column_stack(base)), windows.mean(rate_shapes) + windows.rate(angle_shapes)]
        )[self.first]
        self.measured = (windows.mean(output[:, None]) - truth)[self.first, 0]
        self.middle_s = samples.time_s[windows.first[self.first] + windows.width // 2] - samples.time_s[0]
        self.gram = space.gram(terms)
        self._free = self._coefficient_places()

    def _whole(self, windows: Windows) -> Ints:
        """The windows in which the record is not interrupted."""
        broken = np.cumsum(self.space.design.averages.samples.start)
        first = windows.first
        return np.flatnonzero(broken[first] == broken[first + windows.width - 1])

    def _shapes(self) -> tuple[F64, F64]:
        """What the terms' columns are at the samples: in deg/s, and in deg where they act on the encoder."""
        k = len(self.space.covariates.time_s)
        width = sum(t.columns.shape[1] for t in self.terms)
        rates, angles, at = np.zeros((k, width)), np.zeros((k, width)), 0
        for term in self.terms:
            part = slice(at, at + term.columns.shape[1])
            acts, shapes = self.space.shapes(term)
            if acts is Acts.ANGLE:
                angles[:, part] = -shapes
            else:
                rates[:, part] = shapes / (1.0 if acts is Acts.RATE else (self.space.scale_factor or 1.0))
            at = part.stop
        return rates, angles

    def _coefficient_places(self) -> list[int]:
        places: list[int] = []
        at = 1 + self.gram.base
        for term in self.terms:
            if not term.fixed:
                places += range(at, at + term.columns.shape[1])
            at += term.columns.shape[1]
        return places

    def residual(self, coefficients: F64) -> F64:
        """(w,) of the windows, for the coefficients of the base's corrections and the terms."""
        return np.asarray(self.measured - self.columns @ coefficients)

    def coefficients(self, gram: Gram) -> F64:
        """Of base and terms, one for those whose size is their setting."""
        return self.solution(gram)[0]

    def solution(self, gram: Gram | None = None) -> tuple[F64, F64]:
        """Coefficients (p,) of base and terms and their covariance (p, p); a size that is a setting is one, exactly."""
        gram = gram or self.gram
        fixed = [k for k in range(1 + gram.base, gram.matrix.shape[0]) if k not in self._free]
        if fixed:
            left = gram.white[:, [0]] - gram.white[:, fixed].sum(axis=1, keepdims=True)
            gram = Gram(np.column_stack([left, gram.white[:, 1:]]), gram.base)
        p = gram.matrix.shape[0] - 1
        estimated = [*range(gram.base), *(k - 1 for k in self._free)]
        values, covariance = np.ones(p), np.zeros((p, p))
        values[estimated], covariance[np.ix_(estimated, estimated)] = gram.coefficients(self._free)
        return values, covariance

    def error(self) -> Error:
        """Cross-validated over blocks of time."""
        rows_s = self.space.design.rows.time_s - self.space.design.averages.samples.time_s[0]
        end = float(self.middle_s[-1]) + 1e-9
        blocks = int(np.clip(end // 5.0, 2, BLOCKS))
        edges = np.linspace(0.0, end, blocks + 1)
        squares = 0.0
        for a, b in pairwise(edges.tolist()):
            unseen = (self.middle_s >= a) & (self.middle_s < b)
            if unseen.any():
                known = np.ones(len(self.space.prior), bool)
                kept = Gram(self.gram.white[np.append((rows_s < a) | (rows_s >= b), known)], self.gram.base)
                squares += float(np.sum(self.residual(self.coefficients(kept))[unseen] ** 2))
        floor = float(np.sqrt(np.mean(self.spread() ** 2)))
        return Error(float(np.sqrt(squares / len(self.middle_s))), floor, float(edges[1]), blocks)

    def spread(self) -> F64:
        """(w,) what the noise gives each window."""
        space, design = self.space, self.space.design
        noise, scale = space.noise.noise, space.scale_factor or 1.0
        variance = np.zeros(len(space.covariates.time_s))
        if design.readings is not None:
            variance += np.interp(design.averages.samples.time_s, design.readings.time_s, design.readings.variance)
            variance[design.averages.at[design.averages.at >= 0]] = 0.0
        spread = self.windows.spread(noise.white / scale, noise.ar1 / scale, noise.correlation_time_s, variance)
        return np.asarray(spread[self.first])

    def failures(self) -> list[Failure]:
        """The worst stretch of each covariate, worst first: bins of equal count against the mean of their noise."""
        residual, spread = self.residual(self.coefficients(self.gram)), self.spread()
        found = []
        for name, values in covariate_columns(self.space).items():
            at = self.windows.mean(values[:, None])[self.first, 0]
            order = np.argsort(at, kind="stable")
            if np.ptp(at) <= 0.0 or len(order) < 2 * BINS:
                continue
            parts = _stretches(at[order], order)
            # Windows overlap by half: two neighbours count as one and a half.
            z = np.array([residual[p].mean() / (np.sqrt(np.mean(spread[p] ** 2) / len(p)) * 1.2) for p in parts])
            k = int(np.argmax(np.abs(z)))
            worst = parts[k]
            found.append(
                Failure(
                    name, float(at[worst].min()), float(at[worst].max()), float(residual[worst].mean()), float(z[k])
                )
            )
        return sorted(found, key=lambda f: -abs(f.z))


def _stretches(values: F64, order: Ints) -> list[Ints]:
    """``order`` cut where the sorted ``values`` fill a bin, none so narrow that it is one value's repeats."""
    least = float(np.ptp(values)) / (3.0 * BINS)
    parts, begin = [], 0
    for end in [*(np.arange(1, BINS) * len(order) // BINS), len(order)]:
        if values[end - 1] - values[begin] >= least or end == len(order):
            parts.append(order[begin:end])
            begin = end
    return [part for part in parts if len(part) > 3]


def covariate_columns(space: Space) -> Mapping[str, F64]:
    """What residuals are looked at against, by name, at the samples."""
    c, axis = space.covariates, space.covariates.axis
    columns = {
        f"{axis}_rate_dps": c.rate_dps,
        f"{axis}_position_deg": c.position_deg,
        f"{axis}_acceleration_dps2": c.acceleration_dps2,
        "temperature_c": c.temperature_c,
        "time_s": c.time_s,
        "supply_v": c.supply_v,
        "other_rate_dps": c.other_rate_dps,
    }
    return {name: values for name, values in columns.items() if values is not None}


def _angle(space: Space) -> F64:
    """(k, 1) the encoder at the samples."""
    readings = space.design.readings
    assert readings is not None
    return np.interp(space.design.averages.samples.time_s, readings.time_s, readings.angle_deg)[:, None]
