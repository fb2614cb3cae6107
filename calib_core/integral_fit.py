"""The fit of bias and scale factor by matching integrals, with noise estimated from the record itself (METHOD 2).

    mean V over an interval = β + S · mean true rate + Σ c_j · mean φ_j + errors,   errors ~ Σ(S, noise)

The encoder's error multiplies S, so Σ depends on S and the encoder's column carries its own error. Both are accounted
for by solving the score of r'Σ(S)⁻¹r in full: the plain least-squares S would be biased (errors in variables).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_core.code_likelihood import Sites, path_variance, sharpen
from calib_core.encoder_noise import Readings
from calib_core.noise_fit import NoiseFit, first_guess, fit_noise, longest_correlation_s
from calib_core.recording import Recording
from calib_core.rows import Averages, samples, with_encoder, with_reference
from calib_core.uncertainty import Contribution, coverage_factor
from calib_core.whitening import RowNoise, Rows, Whitener

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

SUFFIX = {"V": "V", "deg/s": "dps", "counts": "counts"}
ROUNDS = 3
"""Rounds over the codes; a fourth moves S by less than a hundredth of its uncertainty."""
CHI2_MEDIAN = 0.455
"""Median of the square of a standard normal variable."""
ENOUGH = 1e-3
"""A step, in standard uncertainties, that no longer matters."""
SOFTEST = 0.5
"""Readings noisier than this, in steps, blur the codes' edges: they are taken as Gaussian."""
MOVED_STEPS = 20.0
"""An encoder that moved by fewer of its steps says nothing about the scale factor."""


@dataclass(frozen=True)
class Fit:
    """What a recording says about one axis; names carry its unit (``bias_V``, ``scale_factor_V_per_dps``)."""

    names: tuple[str, ...]
    values: Mapping[str, float]
    covariance: F64
    """(p, p) in the order of ``names``."""
    dof: Mapping[str, float]
    """Effective degrees of freedom of each standard uncertainty: how well the record knows its own noise."""
    encoder_share: Mapping[str, float]
    """How much of each variance comes from the encoder's readings; the rest is the gyro's noise."""
    noise: Mapping[str, float | None]
    """``white`` and ``ar1`` in the recording's unit, for one sample; ``white_dps``, ``ar1_dps`` likewise in deg/s (None
    without a scale factor); ``correlation_time_s`` (None where the noise is white)."""
    delay_s: float
    """How much later the gyro tells than the encoder; nan where the record cannot say."""
    delay_uncertainty_s: float
    chi2: float
    rows: int
    """χ² of the residual whitened with the fitted noise; χ²/rows near 1 is as it should be."""
    samples: int
    duration_s: float
    encoder_step_deg: float
    warnings: tuple[Mapping[str, object], ...] = ()

    def standard_uncertainty(self, name: str) -> float:
        """One standard deviation of ``name``, from the fit alone (Type A)."""
        k = self.names.index(name)
        return float(np.sqrt(self.covariance[k, k]))

    def expanded_uncertainty(self, name: str) -> float:
        """Half the 95 % interval of ``name``, from the fit alone."""
        return coverage_factor(self.dof[name]) * self.standard_uncertainty(name)

    def contributions(self, name: str) -> tuple[Contribution, ...]:
        """The fit's rows in the budget of ``name``; together they have its uncertainty and degrees of freedom."""
        u, share = self.standard_uncertainty(name), self.encoder_share[name]
        # The encoder's step is known, so all doubt about u is in the gyro's part: Welch and Satterthwaite backwards.
        gyro = Contribution("gyro_noise", u * math.sqrt(1.0 - share), "A", dof=self.dof[name] * (1.0 - share) ** 2)
        return (gyro, Contribution("encoder_step", u * math.sqrt(share))) if share > 0.0 else (gyro,)

    @property
    def bias(self) -> float:
        return self.values[self.names[0]]

    @property
    def scale_factor(self) -> float:
        """Output per deg/s; nan where the record cannot say (nothing moved)."""
        return next((self.values[n] for n in self.names if n.startswith("scale_factor")), float("nan"))


def fit(recording: Recording, axis: str, *, mask: Mask | None = None) -> Fit:
    """Fits bias, scale factor and the gyro's delay to the rows of ``recording`` in ``mask`` (n,).

    The reference is a stationary header, a rate column, or the encoder, in this order. Raises Problem
    ``fit.too_short``, ``fit.stuck`` or ``fit.no_reference``.
    """
    design = Design.of(recording, axis, mask)
    solution = design.solve()
    return _report(design, solution)


@dataclass(frozen=True, eq=False)
class Design:
    """The rows of one axis and what their base columns are made of. Effects append columns to ``columns``."""

    rows: Rows
    averages: Averages
    rate: F64
    """(n,) the reference's mean rate over each row."""
    reference: str
    """"stationary", "rate" or "encoder"."""
    readings: Readings | None = None

    @classmethod
    def of(cls, recording: Recording, axis: str, mask: Mask | None = None) -> "Design":
        """Chooses the reference and forms the rows."""
        gyro = samples(recording, axis, mask)
        rate = recording.reference_rate(axis)
        if rate is not None:
            rows, averages, mean = with_reference(gyro, axis, rate)
            return cls(rows, averages, mean, "stationary" if recording.stationary else "rate")
        calibration = recording.reference_calibration(axis)
        rows, averages, readings = with_encoder(gyro, axis, *recording.codes(axis), calibration)
        rate = _slopes(rows, readings.angle_deg)
        return cls(rows, averages, rate, "encoder", readings)

    @property
    def moves(self) -> bool:
        """Whether the reference moved enough to tell a scale factor."""
        if self.readings is not None:
            return bool(np.ptp(self.readings.angle_deg) > MOVED_STEPS * self.readings.step_deg)
        return self.reference == "rate" and bool(np.ptp(self.rate) > 0.0)

    def output(self, delay_s: float) -> F64:
        """(n,) the gyro's mean output over the rows, its delay taken out."""
        return self.averages.output(delay_s)[0]

    def columns(self, delay_s: float, values: F64) -> F64:
        """(n, p) bias; then, where something moved, rate and delay (s, as a change from ``delay_s``)."""
        one = np.ones(len(self.rows))
        if not self.moves:
            return one[:, None]
        if self.readings is None:
            s = self.averages.samples
            grid = s.time_s[self.averages.at]
            rate = np.interp(grid - delay_s, grid, self.rate)
            return np.column_stack([one, rate, -values[1] * np.gradient(rate, grid)])
        change = self.averages.output(delay_s)[1]
        return np.column_stack([one, self.rate, np.where(self.averages.at < 0, -change, 0.0)])

    def solve(self) -> "Solution":
        """Noise and parameters by turns, the delay taken out as it is found and the codes read ever more sharply."""
        design, delay, values = self, 0.0, self.rough()
        y = self.output(delay)
        start = RowNoise(first_guess(self.rows, y), reading_deg=self._reading_noise(y, values))
        step = self.readings.step_deg if self.readings is not None else 0.0
        rounds = ROUNDS if start.reading_deg < SOFTEST * step else 1
        sites, noise = None, None
        for turn in range(rounds + 1):
            columns = design.columns(delay, values)
            if noise is None:
                values, _ = design.estimate(y, columns, start, values)
                noise = design._noise(y, columns, values, start)
            elif turn in (1, rounds):
                noise = design._noise(y, columns, values, noise.base, noise)
            values, covariance = design.estimate(y, columns, noise.noise, values)
            if len(values) > 1:
                delay, values[2] = delay + float(values[2]), 0.0
                y = self.output(delay)
            if turn < rounds and rounds > 1:
                sites = design._sharpened(y, columns, values, noise.noise, sites)
                design = self._at(sites)
                noise = replace(noise, base=replace(noise.base, reading_deg=0.0))
        assert noise is not None
        return Solution(y, columns, values, covariance, delay, noise, sites)

    def _noise(self, y: F64, columns: F64, values: F64, start: RowNoise, near: NoiseFit | None = None) -> NoiseFit:
        """The noise about the columns; the scale factor of an encoder is kept, for a free one would trade the codes'
        error, which it multiplies, for noise."""
        if self.readings is None or len(values) == 1:
            return fit_noise(self.rows, y, columns, 0.0, start, near, longest_s=self.longest_noise_s)
        others, scale_factor = np.delete(columns, 1, axis=1), float(values[1])
        rest = y - columns[:, 1] * scale_factor
        return fit_noise(self.rows, rest, others, scale_factor, start, near, longest_s=self.longest_noise_s)

    @property
    def longest_noise_s(self) -> float:
        """The longest correlation that noise of this record may have."""
        s = self.averages.samples
        return longest_correlation_s(s.interval_s, float(s.time_s[-1] - s.time_s[0]))

    def rough(self) -> F64:
        """Parameters (p,) from the integrals by plain least squares, to start from."""
        y, dt = self.output(0.0), self.rows.dt_s
        if not self.moves:
            return np.array([y.mean()])
        path = np.cumsum(np.column_stack([np.ones(len(y)), self.rate, y]) * dt[:, None], axis=0)
        path[:, 2] -= path[:, 0] * y.mean()
        known = np.column_stack([path[:, :2], np.ones(len(y))])
        bias, scale_factor, _ = np.linalg.lstsq(known, path[:, 2], rcond=None)[0]
        return np.array([bias + y.mean(), scale_factor, 0.0])

    def _reading_noise(self, y: F64, values: F64) -> float:
        """deg, beyond the step's own. From row to row the gyro hardly wanders, so what differs is the readings' doing;
        so are, at most, their distances from the straight line through their neighbours (a deaf gyro tells nothing)."""
        if self.readings is None or len(values) == 1 or len(self.readings.time_s) < 3:
            return 0.0
        moving = self.rows.after >= 0
        error = ((y - values[0]) / values[1] - self.rate)[moving] * self.rows.dt_s[moving]
        time, angle = self.readings.time_s, self.readings.angle_deg
        share = (time[1:-1] - time[:-2]) / (time[2:] - time[:-2])
        bend = angle[1:-1] - (1.0 - share) * angle[:-2] - share * angle[2:]
        most = np.median(bend**2 / (1.0 + share**2 + (1.0 - share) ** 2)) / CHI2_MEDIAN
        excess = min(float(np.mean(error**2)) / 2.0, float(most)) - self.readings.step_deg**2 / 12.0
        return float(np.sqrt(max(excess, 0.0)))

    def _at(self, sites: Sites) -> "Design":
        """The same rows with other readings."""
        rows = replace(self.rows, reading_variance=sites.variance)
        return replace(self, rows=rows, rate=_slopes(rows, sites.level_deg))

    def _sharpened(self, y: F64, columns: F64, values: F64, noise: RowNoise, sites: Sites | None) -> Sites:
        """One round of the codes' likelihood about the path that the fit implies."""
        readings, rows = self.readings, self.rows
        assert readings is not None
        if sites is None:
            sites = Sites(readings.angle_deg, rows.reading_variance + noise.reading_deg**2, 0.0)
        whitener = Whitener(rows, values[1], noise)
        pull = rows.to_readings(whitener.precision_times(whitener.whiten(y - columns @ values)))
        smooth = sites.level_deg - values[1] * sites.variance * pull
        ending, _ = rows.ends
        dt = rows.dt_s[ending]
        white, drift = noise.white**2 * self.averages.samples.interval_s / values[1] ** 2, (noise.ar1 / values[1]) ** 2
        decay = np.exp(-np.diff(readings.time_s, prepend=0.0) / noise.correlation_time_s)
        variance = path_variance(sites.variance, ending >= 0, dt, white * dt, drift, decay)
        return sharpen(readings.angle_deg, readings.step_deg, smooth, variance, sites)

    def estimate(self, y: F64, columns: F64, noise: RowNoise, values: F64) -> tuple[F64, F64]:
        """Parameters (p,) and covariance (p, p) for given noise, from the start ``values``.

        With r = y - Xb and C the covariance of the encoder's errors in the rate, the score of r'Σ⁻¹r in S is
        x'Σ⁻¹r + S·h'Ch, h = Σ⁻¹r: the second term is what x'Σ⁻¹r owes to the error that x and r share.
        """
        rows, shared = self._recurrent(), np.zeros(len(values))
        for _ in range(3):
            scale_factor = values[1] if len(values) > 1 else 0.0
            whitener = Whitener(rows, scale_factor, noise)
            white = whitener.whiten(np.column_stack([columns, y]))
            x, residual = white[:, :-1], white[:, -1] - white[:, :-1] @ values
            if self.readings is not None and len(values) > 1:
                pull = rows.to_readings(whitener.precision_times(residual))
                shared[1] = scale_factor * float((rows.reading_variance + noise.reading_deg**2) @ pull**2)
            q, root = _factors(x)
            step = root @ (q.T @ residual + root.T @ shared)
            values, covariance = values + step, root @ root.T
            if np.all(np.abs(step) < ENOUGH * np.sqrt(np.diag(covariance))):
                break
        return values, covariance

    def _recurrent(self) -> Rows:
        """The rows with each reading's variance as often as its codes recur."""
        if self.readings is None:
            return self.rows
        return replace(self.rows, reading_variance=self.rows.reading_variance * self.readings.recurrence)

    def encoder_share(self, columns: F64, noise: RowNoise, values: F64, covariance: F64) -> F64:
        """(p,) share of each parameter's variance that the readings' errors bring."""
        if self.readings is None or len(values) == 1:
            return np.zeros(len(values))
        rows = self._recurrent()
        whitener = Whitener(rows, values[1], noise)
        white = whitener.whiten(columns) @ covariance
        pull = np.array([rows.to_readings(whitener.precision_times(column)) for column in white.T])
        variance = values[1] ** 2 * (rows.reading_variance + noise.reading_deg**2)
        return np.asarray(np.clip(pull**2 @ variance / np.diag(covariance), 0.0, 1.0))

    def chi2(self, y: F64, columns: F64, noise: RowNoise, values: F64, softness: float) -> float:
        """χ² of the residual, the readings taken as the codes' middles with the variance of one reading."""
        rows = self.rows
        if self.readings is not None and self.readings.step_deg > 0.0:
            one = self.readings.step_deg**2 * (1.0 / 12.0 + softness**2)
            rows = replace(rows, reading_variance=np.full(len(rows.reading_variance), one))
        white = Whitener(rows, values[1] if len(values) > 1 else 0.0, noise).whiten(y - columns @ values)
        return float(white @ white)


@dataclass(frozen=True, eq=False)
class Solution:
    y: F64
    columns: F64
    values: F64
    covariance: F64
    delay_s: float
    noise: NoiseFit
    sites: Sites | None


def _slopes(rows: Rows, level_deg: F64) -> F64:
    """(n,) mean rate between the readings' levels (m,); zero in rows without readings."""
    moving = rows.after >= 0
    rate = np.zeros(len(rows))
    rate[moving] = (level_deg[rows.after[moving]] - level_deg[rows.before[moving]]) / rows.dt_s[moving]
    return rate


def _factors(columns: F64) -> tuple[F64, F64]:
    """Q (n, p) with orthonormal columns and R⁻¹ (p, p) with Q = columns·R⁻¹; units may differ by any factor."""
    scale = 1.0 / np.linalg.norm(columns, axis=0)
    q, r = np.linalg.qr(columns * scale)
    return q, np.asarray(scale[:, None] * np.linalg.inv(r))


def _report(design: Design, solution: Solution) -> Fit:
    suffix = SUFFIX[design.averages.samples.unit]
    names: tuple[str, ...] = (f"bias_{suffix}",)
    warnings: list[Mapping[str, object]] = []
    scale_factor = None
    if len(solution.values) > 1:
        names += (f"scale_factor_{suffix}_per_dps",)
        scale_factor = abs(float(solution.values[1]))
    elif design.reference == "encoder":
        warnings.append({"code": "fit.nothing_moved", "values": {}})
    p, noise = len(names), solution.noise.noise
    if noise.ar1 > 0.0 and noise.correlation_time_s >= solution.noise.longest_s:
        warnings.append({"code": "fit.wandering_bias", "values": {"correlation_time_s": noise.correlation_time_s}})
    softness = solution.sites.softness if solution.sites else 0.0
    columns = design.columns(solution.delay_s, solution.values)
    chi2 = design.chi2(solution.y, columns, noise, solution.values, softness)
    if solution.sites is not None:
        design = design._at(solution.sites)
    dof = _effective_dof(design, solution)
    share = design.encoder_share(solution.columns, noise, solution.values, solution.covariance)
    s = design.averages.samples
    return Fit(
        names=names,
        values=dict(zip(names, solution.values.tolist(), strict=False)),
        covariance=solution.covariance[:p, :p],
        dof=dict(zip(names, dof.tolist(), strict=False)),
        encoder_share=dict(zip(names, share.tolist(), strict=False)),
        noise={
            "white": noise.white,
            "ar1": noise.ar1,
            "white_dps": noise.white / scale_factor if scale_factor else None,
            "ar1_dps": noise.ar1 / scale_factor if scale_factor else None,
            "correlation_time_s": noise.correlation_time_s if noise.ar1 > 0.0 else None,
        },
        delay_s=solution.delay_s if len(solution.values) > 2 else float("nan"),
        delay_uncertainty_s=float(np.sqrt(solution.covariance[2, 2])) if len(solution.values) > 2 else float("nan"),
        chi2=chi2,
        rows=len(design.rows),
        samples=len(s.time_s),
        duration_s=float(s.time_s[-1] - s.time_s[0]),
        encoder_step_deg=design.readings.step_deg if design.readings else 0.0,
        warnings=tuple(warnings),
    )


def _effective_dof(design: Design, solution: Solution) -> F64:
    """Satterthwaite: 2·var²/variance(var), by the change of each variance with the noise parameters."""
    h, noise = 0.1, solution.noise
    variance = np.diag(solution.covariance)
    slope = np.empty((len(variance), len(noise.logarithms)))
    for k, e in enumerate(h * np.eye(slope.shape[1])):
        moved = design.estimate(solution.y, solution.columns, noise.at(noise.logarithms + e), solution.values)
        slope[:, k] = (np.diag(moved[1]) - variance) / h
    spread = np.einsum("ij,jk,ik->i", slope, noise.covariance, slope)
    return np.asarray(2.0 * variance**2 / np.maximum(spread, 1e-300))
