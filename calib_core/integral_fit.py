"""The fit of bias and scale factor by matching integrals, with noise estimated from the record itself (METHOD 2).

    mean V over an interval = β + S · mean true rate + Σ c_j · mean φ_j + errors,   errors ~ Σ(S, noise)

The encoder's error multiplies S, so Σ depends on S and the encoder's column carries its own error. Both are accounted
for by solving the score of r'Σ(S)⁻¹r in full: the plain least-squares S would be biased (errors in variables).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_core.noise_fit import NoiseFit, fit_noise
from calib_core.recording import Recording
from calib_core.rows import Averages, samples, with_encoder, with_reference
from calib_core.uncertainty import coverage_factor
from calib_core.whitening import RowNoise, Rows, Whitener

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

SUFFIX = {"V": "V", "deg/s": "dps", "counts": "counts"}
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
    ``fit.too_short`` or ``fit.no_reference``.
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
    recurrence: F64
    """(m,) by which the readings' variance grows where motion repeats the same codes."""
    encoder_step_deg: float

    @classmethod
    def of(cls, recording: Recording, axis: str, mask: Mask | None = None) -> "Design":
        """Chooses the reference and forms the rows."""
        gyro = samples(recording, axis, mask)
        rate = recording.reference_rate(axis)
        if rate is not None:
            rows, averages, mean = with_reference(gyro, rate)
            return cls(rows, averages, mean, "stationary" if recording.stationary else "rate", np.empty(0), 0.0)
        rows, averages, mean, readings = with_encoder(gyro, *recording.position(axis))
        return cls(rows, averages, mean, "encoder", readings.recurrence.astype(float), readings.step_deg)

    @property
    def moves(self) -> bool:
        """Whether the reference moved enough to tell a scale factor."""
        if self.reference == "encoder":
            travel = np.cumsum(self.rate * self.rows.dt_s)
            return bool(np.ptp(travel) > MOVED_STEPS * self.encoder_step_deg)
        return self.reference == "rate" and bool(np.ptp(self.rate) > 0.0)

    def output(self, delay_s: float) -> F64:
        """(n,) the gyro's mean output over the rows, its delay taken out."""
        s = self.averages.samples
        return self.averages.mean(s.output, shift_s=delay_s, average_s=s.average_s)

    def columns(self, delay_s: float, scale_factor: float) -> F64:
        """(n, p) bias; then, where something moved, rate and delay (s, as a change from ``delay_s``)."""
        one = np.ones(len(self.rows))
        if not self.moves:
            return one[:, None]
        if self.reference == "rate":
            s = self.averages.samples
            grid = s.time_s[self.averages.at]
            rate = np.interp(grid - delay_s, grid, self.rate)
            return np.column_stack([one, rate, -scale_factor * np.gradient(rate, grid)])
        change = self.averages.change(self.averages.samples.output)
        return np.column_stack([one, self.rate, np.where(self.averages.at < 0, -change, 0.0)])

    def solve(self) -> "Solution":
        """Noise and parameters by turns: rough, then with the noise estimated, then with the delay taken out."""
        p = self.columns(0.0, 0.0).shape[1]
        values = np.zeros(p)
        if p > 1:
            level = self.output(0.0) * self.rows.dt_s
            path = np.column_stack(
                [np.cumsum(self.rows.dt_s), np.cumsum(self.rate * self.rows.dt_s), np.ones(len(level))]
            )
            values[:2] = np.linalg.lstsq(path, np.cumsum(level), rcond=None)[0][:2]
        delay, noise = 0.0, None
        for _ in range(2):
            y, columns = self.output(delay), self.columns(delay, values[1] if p > 1 else 0.0)
            if noise is None:
                noise = fit_noise(self.rows, y, columns, values[1] if p > 1 else 0.0)
            values[2:] = 0.0
            values, covariance = self.estimate(y, columns, noise.noise, values)
            if p == 1:
                break
            delay += float(values[2])
        return Solution(y, columns, values, covariance, delay, noise)

    def estimate(self, y: F64, columns: F64, noise: RowNoise, values: F64) -> tuple[F64, F64]:
        """Parameters (p,) and covariance (p, p) for given noise, from the start ``values``.

        With r = y - Xb and C = cov of the encoder's errors in the rate, the score of r'Σ⁻¹r in S is x'Σ⁻¹r + S·h'Ch,
        h = Σ⁻¹r: the second term is what x'Σ⁻¹r owes to the error that x and r share.
        """
        weighted = replace(self.rows, reading_variance=self.rows.reading_variance * self.recurrence)
        values = values.copy()
        for _ in range(3):
            scale_factor = values[1] if len(values) > 1 else 0.0
            whitener = Whitener(weighted, scale_factor, noise)
            white = whitener.whiten(np.column_stack([columns, y]))
            x, residual = white[:, :-1], white[:, -1] - white[:, :-1] @ values
            score = x.T @ residual
            if len(weighted.reading_variance) and len(values) > 1:
                shared = weighted.to_readings(whitener.precision_times(residual))
                score[1] += scale_factor * float(weighted.reading_variance @ shared**2)
            covariance = _inverse(x.T @ x)
            step = covariance @ score
            values = values + step
            if np.all(np.abs(step) < 1e-3 * np.sqrt(np.diag(covariance))):
                break
        return values, covariance

    def chi2(self, y: F64, columns: F64, noise: RowNoise, values: F64) -> float:
        """χ² of the residual, each reading with its own variance however often its codes recur."""
        white = Whitener(self.rows, values[1] if len(values) > 1 else 0.0, noise).whiten(y - columns @ values)
        return float(white @ white)


@dataclass(frozen=True, eq=False)
class Solution:
    y: F64
    columns: F64
    values: F64
    covariance: F64
    delay_s: float
    noise: NoiseFit


def _inverse(gram: F64) -> F64:
    """Of a positive definite matrix whose columns have very different units."""
    scale = 1.0 / np.sqrt(np.diag(gram))
    return np.asarray(np.linalg.inv(gram * np.outer(scale, scale)) * np.outer(scale, scale))


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
    chi2 = design.chi2(solution.y, solution.columns, noise, solution.values)
    dof = _effective_dof(design, solution)
    s = design.averages.samples
    return Fit(
        names=names,
        values=dict(zip(names, solution.values.tolist(), strict=False)),
        covariance=solution.covariance[:p, :p],
        dof=dict(zip(names, dof.tolist(), strict=False)),
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
        encoder_step_deg=design.encoder_step_deg,
        warnings=tuple(warnings),
    )


def _effective_dof(design: Design, solution: Solution) -> F64:
    """Satterthwaite: 2·var²/variance(var), by the change of each variance with the noise parameters."""
    h = 0.1
    variance = np.diag(solution.covariance)
    slope = np.empty((len(variance), len(solution.noise.parameters)))
    for k, e in enumerate(h * np.eye(slope.shape[1])):
        moved = design.estimate(
            solution.y, solution.columns, solution.noise.at(solution.noise.parameters + e), solution.values
        )
        slope[:, k] = (np.diag(moved[1]) - variance) / h
    spread = np.einsum("ij,jk,ik->i", slope, solution.noise.covariance, slope)
    return np.asarray(2.0 * variance**2 / np.maximum(spread, 1e-300))
