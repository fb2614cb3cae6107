"""The noise of the rows, estimated from the rows: white plus AR(1) by restricted maximum likelihood (REML)."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_core.whitening import RowNoise, Rows, Whitener

F64 = NDArray[np.float64]

MAX_ROWS = 24_000
"""Longer records are sampled in blocks: that many rows know the noise to a per cent."""
BLOCK = 3_000
AR1_EVIDENCE = 8.0
"""2ΔlnL that two more parameters must buy."""
MAX_CORRELATION_S = 5.0
"""φ = 0.998 at 100 Hz; slower than this is not noise but a wandering bias."""


@dataclass(frozen=True)
class NoiseFit:
    noise: RowNoise
    parameters: F64
    """(k,) ln white [, ln ar1, ln correlation time]."""
    covariance: F64
    """(k, k) of the parameters."""

    def at(self, parameters: F64) -> RowNoise:
        return _noise(parameters)


def fit_noise(rows: Rows, y: F64, columns: F64, scale_factor: float) -> NoiseFit:
    """White and, where the record shows it, AR(1) noise of ``y`` (n,) about the span of ``columns`` (n, p)."""
    n = len(rows)
    if n > MAX_ROWS:
        starts = np.linspace(0, n - BLOCK, MAX_ROWS // BLOCK).astype(int)
        chosen = np.unique((starts[:, None] + np.arange(BLOCK)).ravel())
        rows, y, columns = rows.take(chosen), y[chosen], columns[chosen]
    columns = columns[:, np.abs(columns).max(axis=0) > 0.0]
    both = np.column_stack([columns / np.sqrt((columns**2).mean(axis=0)), y])

    def deviance(parameters: F64) -> float:
        """-2 ln of the restricted likelihood, up to a constant."""
        whitener = Whitener(rows, scale_factor, _noise(parameters))
        white = whitener.whiten(both)
        gram = white.T @ white
        upper = np.linalg.cholesky(gram).T
        return whitener.log_determinant + 2.0 * float(np.log(np.diag(upper)[:-1]).sum()) + float(upper[-1, -1] ** 2)

    white = np.array([math.log(_first_guess(rows, y))])
    white, low, curvature = _minimise(deviance, white)
    start = min(
        (np.array([white[0] + math.log(a), white[0] + math.log(b), math.log(tau)]) for a, b in ((0.95, 0.3), (0.8, 0.6))
         for tau in (0.05, 0.3, 2.0)),
        key=deviance,
    )  # fmt: skip
    if deviance(start) < low + 2.0:
        coloured, lower, curve = _minimise(deviance, start)
        if lower < low - AR1_EVIDENCE:
            white, curvature = coloured, curve
    return NoiseFit(_noise(white), white, 2.0 * np.linalg.inv(curvature))


def _noise(parameters: F64) -> RowNoise:
    white = math.exp(float(np.clip(parameters[0], -60.0, 60.0)))
    if len(parameters) == 1:
        return RowNoise(white)
    ar1, tau = np.exp(np.clip(parameters[1:], -60.0, 60.0))
    return RowNoise(white, float(ar1), float(np.clip(tau, 1e-3, MAX_CORRELATION_S)))


def _first_guess(rows: Rows, y: F64) -> float:
    """From third differences, which smooth motion hardly enters: an upper limit with an encoder, close without."""
    still = rows.after < 0
    if still.sum() < 50:
        return float(np.std(np.diff(y, 3)) / math.sqrt(20.0)) or 1e-9
    return float(np.std(np.diff(y[still], 3)) / math.sqrt(20.0)) or 1e-9


def _minimise(function: Callable[[F64], float], x: F64) -> tuple[F64, float, F64]:
    """Newton's method with differences and a limit on the step: minimum, value and Hessian there."""
    h, k = 0.05, len(x)
    value = function(x)
    for _ in range(25):
        unit = h * np.eye(k)
        up = np.array([function(x + e) for e in unit])
        down = np.array([function(x - e) for e in unit])
        gradient = (up - down) / (2.0 * h)
        hessian = np.diag((up - 2.0 * value + down) / h**2)
        for i in range(k):
            for j in range(i):
                both = function(x + unit[i] + unit[j])
                hessian[i, j] = hessian[j, i] = (both - up[i] - up[j] + value) / h**2
        power, vectors = np.linalg.eigh(hessian)
        power = np.maximum(np.abs(power), 1e-3)
        step = -vectors @ ((vectors.T @ gradient) / power)
        step *= min(1.0, 1.5 / float(np.abs(step).max()))
        while (after := function(x + step)) > value and np.abs(step).max() > 1e-3:
            step /= 3.0
        if after <= value:
            x, value = x + step, after
        if np.abs(step).max() < 0.01:
            break
    return x, value, (vectors * power) @ vectors.T
