"""How well a model explains data it has not seen, and where it fails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_core.effects.base import Acts
from calib_core.gap_gram import Gram
from calib_core.gap_space import Space, Term
from calib_core.integral_fit import SUFFIX
from calib_core.weak_form import Windows

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

BINS = 14


@dataclass(frozen=True)
class Error:
    """Error on unseen data, and the least that the noise allows."""

    held_out_rms_dps: float
    floor_rms_dps: float
    block_s: float
    blocks: int


HARDLY = {"temperature_c": 0.2, "supply_v": 0.005, "other_rate_dps": 1.0}
"""A covariate that varies less is constant but for its own noise: nothing fails along it."""


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

    def __init__(self, space: Space, terms: Sequence[Term], fixed: Mapping[str, float] | None = None) -> None:
        """Parameters in ``fixed``, by full name, keep the value given there."""
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
        self.middle_s: F64 = samples.time_s[windows.first[self.first] + windows.width // 2] - samples.time_s[0]
        self.gram = space.gram(terms, folds=True)
        self._known = self._granted(fixed or {})
        self._free = [k for k in range(1 + self.gram.base, len(self.gram.scale)) if k not in self._known]

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

    @property
    def names(self) -> list[str]:
        """Full names of bias, scale factor and the linear parameters, column by column; "" for what has none."""
        suffix = SUFFIX[self.space.design.averages.samples.unit]
        base = [f"bias_{suffix}", f"scale_factor_{suffix}_per_dps"][: len(self.space.values)]
        base += [""] * (self.gram.base - len(base))
        return base + [f"{t.name}.{name}" if name else "" for t in self.terms for name in t.names]

    def _granted(self, fixed: Mapping[str, float]) -> dict[int, float]:
        """Coefficients that are not estimated, by their column in the Gram matrix: one where the size is a setting."""
        known = {k: fixed[name] for k, name in enumerate(self.names, 1) if name in fixed}
        known |= {k: known[k] - float(self.space.values[k - 1]) for k in known if k <= len(self.space.values)}
        return known | {k: 1.0 for k, name in enumerate(self.names, 1) if not name and k > self.gram.base}

    def residual(self, coefficients: F64) -> F64:
        """(w,) of the windows, for the coefficients of the base's corrections and the terms."""
        return np.asarray(self.measured - self.columns @ coefficients)

    @cached_property
    def solution(self) -> tuple[F64, F64]:
        """Coefficients (p,) of base and terms and their covariance (p, p), which is nothing where they are known."""
        values, covariance = self._given(1)[0], np.zeros((self.columns.shape[1],) * 2)
        estimated = self._estimated
        found, spread = self._open.coefficients(self._free)
        values[estimated] += found
        covariance[np.ix_(estimated, estimated)] = spread
        return values, covariance

    @property
    def chi2(self) -> float:
        """Of the record under this model."""
        return self._open.chi2(self._free)

    @property
    def granted(self) -> set[str]:
        """Names of the parameters that were not estimated."""
        return {self.names[k - 1] for k in self._known}

    @cached_property
    def _open(self) -> Gram:
        """Without what is known."""
        return self.gram.known(self._known) if self._known else self.gram

    @property
    def _estimated(self) -> list[int]:
        return [*range(self.gram.base), *(k - 1 for k in self._free)]

    def _given(self, count: int) -> F64:
        """(count, p) coefficients before anything is estimated."""
        values = np.zeros((count, self.columns.shape[1]))
        for k, value in self._known.items():
            values[:, k - 1] = value
        return values

    def error(self) -> Error:
        """Cross-validated over blocks of time."""
        folds = self.space.folds
        values = self._given(len(folds))
        values[:, self._estimated] += self._open.left_out(self._free)[1]
        unseen = values[folds.of_time(self.middle_s + self.space.design.averages.samples.time_s[0])]
        left = self.measured - np.einsum("ij,ij->i", self.columns, unseen)
        floor = float(np.sqrt(np.mean(self.spread() ** 2)))
        return Error(float(np.sqrt(np.mean(left**2))), floor, folds.block_s, len(folds.edges) - 1)

    def spread(self) -> F64:
        """(w,) what the noise gives each window."""
        space, design = self.space, self.space.design
        noise, scale = space.noise.noise, space.scale_factor or 1.0
        variance = np.zeros(len(space.covariates.time_s))
        if design.readings is not None:
            variance += np.interp(design.averages.samples.time_s, design.readings.time_s, design.readings.variance)
            variance[design.averages.at[design.averages.at >= 0]] = 0.0
        spread = self.windows.spread(noise.white / scale, noise.ar1 / scale, noise.correlation_time_s, variance)
        if design.readings is not None:
            # The encoder's error at rest is one draw: a window that the rest fills in part sees it whole.
            still = design.averages.at[design.averages.at >= 0]
            fresh = np.flatnonzero(np.diff(still, prepend=-2) != 1)
            last = np.append(fresh[1:], len(still)) - 1
            seen = self.windows.resting(still[fresh], still[last] + 1) if len(still) else 0.0
            spread = np.sqrt(spread**2 + design.readings.step_deg**2 / 12.0 * seen)
        return np.asarray(spread[self.first])

    def along(self) -> dict[str, F64]:
        """What residuals are looked at against, by name: (w,) means over the windows."""
        return {n: self.windows.mean(v[:, None])[self.first, 0] for n, v in covariate_columns(self.space).items()}

    def failures(self) -> list[Failure]:
        """The worst stretch of each covariate, worst first: bins of equal count against the mean of their noise."""
        residual, spread = self.residual(self.solution[0]), self.spread()
        found = []
        for name, at in self.along().items():
            order = np.argsort(at, kind="stable")
            if np.ptp(at) <= HARDLY.get(name, 0.0) or len(order) < 2 * BINS:
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
