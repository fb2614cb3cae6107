"""How well a model explains data it has not seen, and where it fails."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_core.effects.base import Acts
from calib_core.gap_floor import coded
from calib_core.gap_gram import Gram
from calib_core.gap_space import Space, Term
from calib_core.integral_fit import SUFFIX
from calib_core.weak_form import Windows
from calib_core.whitening import RowNoise

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

BINS = 14
MISFIT, LACKING_S = 0.1, 2.0
"""A residual whose square exceeds the noise's by this share lacks something, which lasts about so long."""


@dataclass(frozen=True)
class Error:
    """Error on unseen data, and the least that the noise allows."""

    held_out_rms_dps: float
    floor_rms_dps: float
    block_s: float
    blocks: int


HARDLY = {"temperature_c": 0.2, "supply_v": 0.005, "other_rate_dps": 1.0}
"""A covariate that usually varies less is constant but for its own noise: nothing fails along it."""
USUALLY = (0.02, 0.98)


TIME_LEADS = 0.5


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

    def __init__(
        self,
        space: Space,
        terms: Sequence[Term],
        fixed: Mapping[str, float] | None = None,
        *,
        background: bool = True,
    ) -> None:
        """Parameters in ``fixed``, by full name, keep the value given there. Without ``background`` the base is bias
        and scale factor again, whatever the space has put into it."""
        self.space, self.terms = space, terms
        design, c = space.design, space.covariates
        samples = design.averages.samples
        scale = space.scale_factor or 1.0
        self.windows = windows = Windows(len(samples.time_s), samples.interval_s)
        self.first = self._whole(windows)
        rates, angles = self._shapes()
        output = (samples.output - space.values[0]) / scale
        truth = windows.rate(_angle(space)) if design.readings is not None else windows.mean(c.rate_dps[:, None])
        columns = windows.mean(rates)
        columns[:, space.base.shape[1] :] += windows.rate(angles)
        self.columns = columns[self.first]
        self.measured = (windows.mean(output[:, None]) - truth)[self.first, 0]
        self.middle_s: F64 = samples.time_s[windows.first[self.first] + windows.width // 2] - samples.time_s[0]
        self.gram = space.gram(terms, folds=True)
        self._known = self._granted(fixed or {})
        if not background:
            last = self.gram.base
            self._known |= dict.fromkeys(range(last + 1 - space.background.shape[1], last + 1), 0.0)
        self._free = [k for k in range(1 + self.gram.base, len(self.gram.scale)) if k not in self._known]

    def _whole(self, windows: Windows) -> Ints:
        """The windows in which the record is not interrupted."""
        broken = np.cumsum(self.space.design.averages.samples.start)
        first = windows.first
        return np.flatnonzero(broken[first] == broken[first + windows.width - 1])

    def _shapes(self) -> tuple[F64, F64]:
        """What base and terms are at the samples: (k, b + p) in deg/s, and (k, p) in deg where terms act on the
        encoder, turned round. What sampling hides is not seen in a window: its column of the base is nothing here."""
        space = self.space
        k, b, scale = len(space.covariates.time_s), space.base.shape[1], space.scale_factor or 1.0
        width = sum(t.columns.shape[1] for t in self.terms)
        rates, angles, at = np.zeros((k, b + width)), np.zeros((k, width)), b
        rates[:, 0] = 1.0 / scale
        if space.design.moves:
            rates[:, 1] = space.covariates.rate_dps / scale
        rates[:, b - space.background.shape[1] : b] = space.background / scale
        for term in self.terms:
            end = at + term.columns.shape[1]
            acts, shapes = space.shapes(term)
            if acts is Acts.ANGLE:
                angles[:, at - b : end - b] = -shapes
            else:
                rates[:, at:end] = shapes / (1.0 if acts is Acts.RATE else scale)
            at = end
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
        floor = float(np.sqrt(np.mean(self.spread**2)))
        return Error(float(np.sqrt(np.mean(left**2))), floor, folds.block_s, len(folds.edges) - 1)

    @cached_property
    def spread(self) -> F64:
        """(w,) what the gyro's noise and the encoder's codes give each window, one standard deviation."""
        noise, scale = self.space.noise.noise, abs(self.space.scale_factor) or 1.0
        noise = replace(noise, white=noise.white / scale, ar1=noise.ar1 / scale)
        gyro = self.windows.spread(noise.white, noise.ar1, noise.correlation_time_s)
        if self.space.design.readings is None or not self.space.design.moves:
            return np.full(len(self.first), gyro)
        rates, angles = self._shapes()
        output, sizes = self.space.design.averages.samples.output, self.solution[0]
        rate = (output - self.space.values[0]) / self.space.scale_factor - rates @ sizes
        shown = -angles @ sizes[self.gram.base :]

        def squares(noise: RowNoise) -> F64:
            self.space.forget()
            found = gyro**2 + coded(self.space.design, self.windows, rate, shown, noise)[self.first]
            self.space.forget()
            return found

        first = squares(noise)
        misfit = float(np.mean(self.residual(sizes) ** 2 - first))
        if misfit < MISFIT * float(first.mean()):
            return np.sqrt(first)
        # What the model lacks is none of the noise, but it must not bend the path either.
        lacking = replace(noise, ar1=math.hypot(noise.ar1, math.sqrt(misfit)), correlation_time_s=LACKING_S)
        return np.sqrt(squares(lacking))

    def along(self) -> dict[str, F64]:
        """What residuals are looked at against, by name: (w,) means over the windows."""
        return {n: self.windows.mean(v[:, None])[self.first, 0] for n, v in covariate_columns(self.space).items()}

    def failures(self) -> list[Failure]:
        """The worst stretch of each covariate, plainest first: bins of equal count against the mean of their noise."""
        residual, spread = self.residual(self.solution[0]), self.spread
        found = []
        for name, at in self.along().items():
            order = np.argsort(at, kind="stable")
            if not varies(name, at) or len(order) < 2 * BINS:
                continue
            parts = _stretches(at[order], order)
            if not parts:  # a short record, and most of it at one value
                continue
            # Windows overlap by half: two neighbours count as one and a half.
            z = np.array([residual[p].mean() / (np.sqrt(np.mean(spread[p] ** 2) / len(p)) * 1.2) for p in parts])
            k = int(np.argmax(np.abs(z)))
            worst = parts[k]
            found.append(
                Failure(
                    name, float(at[worst].min()), float(at[worst].max()), float(residual[worst].mean()), float(z[k])
                )
            )
        # Whatever is slow is seen along time as well: time leads only where nothing else is nearly as plain.
        return sorted(found, key=lambda f: -abs(f.z) * (TIME_LEADS if f.covariate == "time_s" else 1.0))


def varies(covariate: str, values: F64) -> bool:
    """Whether anything can be seen along it: by more than its own noise, and not for a moment only."""
    return bool(np.ptp(np.quantile(values, USUALLY)) > HARDLY.get(covariate, 0.0))


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
