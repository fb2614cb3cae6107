"""The noise of the rows, estimated from the rows: white plus AR(1) by restricted maximum likelihood (REML)."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_core.whitening import RowNoise, Rows, Whitener

F64 = NDArray[np.float64]

MAX_ROWS = 24_000
"""Longer records are sampled in blocks: that many rows know the noise to a per cent."""
BLOCK = 3_000
AR1_EVIDENCE = 8.0
"""2ΔlnL that the two parameters of AR(1) noise must buy."""
GUESSES = [(0.95, 0.05), (0.95, 0.3), (0.95, 2.0), (0.8, 0.05), (0.8, 0.3), (0.8, 2.0), (0.99, 1.0), (0.995, 3.0)]
"""White noise's share, and the correlation time of the rest: the slower, the less of it is plain to see."""
ALIKE = 1e-11
"""What is added to squares, so that columns as good as alike once they are whitened do no harm."""
SPANNED = 1e-7
"""Of a column, what must be its own."""
IMPOSSIBLE = 1e12
"""In place of a -2lnL that cannot be had."""
ENOUGH = 0.02
"""A relative step in the noise that no longer matters."""
MAX_CORRELATION_S = 5.0
"""Of noise; slower than this is a wandering bias."""
MAX_SAMPLES, MOST_OF_RECORD = 500.0, 0.1
"""φ = 0.998 from sample to sample, which is that at 100 Hz. Where samples come more rarely what wanders cannot be told
from noise any sooner; but of a longer correlation than a tenth of the record there are too few to know it by."""


@dataclass(frozen=True)
class NoiseFit:
    """Estimated logarithms of some fields of ``RowNoise``, the others staying as in ``base``."""

    base: RowNoise
    fields: tuple[str, ...]
    logarithms: F64
    """(k,) ln of those fields."""
    covariance: F64
    """(k, k) of the logarithms."""
    longest_s: float = MAX_CORRELATION_S
    """The correlation time is at most this."""

    def at(self, logarithms: F64) -> RowNoise:
        """The noise at other values of the logarithms (k,)."""
        values = np.exp(np.clip(logarithms, -60.0, 60.0)).tolist()
        noise = replace(self.base, **dict(zip(self.fields, values, strict=True)))
        return replace(noise, correlation_time_s=min(max(noise.correlation_time_s, 1e-3), self.longest_s))

    @property
    def noise(self) -> RowNoise:
        return self.at(self.logarithms)


def longest_correlation_s(interval_s: float, duration_s: float) -> float:
    """How slow noise may be in a record of this length with samples at this interval."""
    return max(MAX_CORRELATION_S, min(MAX_SAMPLES * interval_s, MOST_OF_RECORD * duration_s))


def fit_noise(
    rows: Rows,
    y: F64,
    columns: F64,
    scale_factor: float,
    start: RowNoise,
    near: NoiseFit | None = None,
    guess: RowNoise | None = None,
    *,
    longest_s: float = MAX_CORRELATION_S,
) -> NoiseFit:
    """White and, where the record shows it, AR(1) noise of ``y`` (n,) about the span of ``columns`` (n, p), its
    correlation time at most ``longest_s``.

    The error of the encoder's readings is estimated too where the rows bring no variance for it. ``near`` is a fit to
    almost the same rows: the same kind of noise is fitted again, from there. Coloured noise is looked for about the
    ``guess`` too.
    """
    n = len(rows)
    if n > MAX_ROWS:
        begin = np.linspace(0, n - BLOCK, MAX_ROWS // BLOCK).astype(int)
        chosen = np.unique((begin[:, None] + np.arange(BLOCK)).ravel())
        rows, y, columns = rows.take(chosen), y[chosen], columns[chosen]
    both = np.column_stack([_apart(columns), y])

    alike = ALIKE * np.eye(both.shape[1])

    def deviance_of(fit: NoiseFit) -> Callable[[F64], float]:
        def deviance(logarithms: F64) -> float:
            """-2 ln of the restricted likelihood, up to a constant."""
            whitener = Whitener(rows, scale_factor, fit.at(logarithms))
            white = whitener.whiten(both)
            gram = white.T @ white
            size = np.sqrt(np.diag(gram))
            try:
                diagonal = size * np.diag(np.linalg.cholesky(gram / np.outer(size, size) + alike))
            except np.linalg.LinAlgError:
                return IMPOSSIBLE  # a step too far
            return float(whitener.log_determinant + 2.0 * np.log(diagonal[:-1]).sum() + diagonal[-1] ** 2)

        return deviance

    def fitted(fields: tuple[str, ...], values: list[float]) -> tuple[NoiseFit, float]:
        fit = NoiseFit(start, fields, np.log(values), np.empty((0, 0)), longest_s)
        logarithms, deviance, curvature = _minimise(deviance_of(fit), fit.logarithms)
        return replace(fit, logarithms=logarithms, covariance=_covariance(curvature)), deviance

    if near is not None:
        near = replace(near, base=start)
        logarithms, _, curvature = _minimise(deviance_of(near), near.logarithms)
        return replace(near, logarithms=logarithms, covariance=_covariance(curvature))
    fields = ("white", "reading_deg") if start.reading_deg > 0.0 and not rows.reading_variance.any() else ("white",)
    plain, low = fitted(fields, [getattr(start, field) for field in fields])
    base = plain.noise
    trial = replace(plain, fields=("white", "ar1", "correlation_time_s"), base=base)
    deviance = deviance_of(trial)
    slow = [(0.8, 0.3 * longest_s)] if longest_s > MAX_CORRELATION_S else []
    guesses = [
        np.log([share * base.white, math.sqrt(1.0 - share**2) * base.white, tau]) for share, tau in (*GUESSES, *slow)
    ]
    if guess is not None:
        guesses = [np.log([guess.white, guess.ar1, guess.correlation_time_s]), *guesses[3:]]
    best = min(guesses, key=deviance)
    if deviance(best) > low + 2.0:
        return plain
    white, ar1, tau = np.exp(best).tolist()
    known = {"white": white, "reading_deg": base.reading_deg, "ar1": ar1, "correlation_time_s": tau}
    coloured = (*fields, "ar1", "correlation_time_s")
    better, lower = fitted(coloured, [known[field] for field in coloured])
    return better if lower < low - AR1_EVIDENCE else plain


def first_guess(rows: Rows, y: F64) -> float:
    """White noise from third differences of ``y`` (n,), which smooth motion hardly enters."""
    still = rows.after < 0
    chosen = y[still] if still.sum() > 50 else y
    return max(float(np.std(np.diff(chosen, 3))) / math.sqrt(20.0), 1e-12)


def _apart(columns: F64) -> F64:
    """(n, q) of mean square one, that span what ``columns`` (n, p) do: powers of one temperature are nearly alike."""
    columns = columns[:, np.abs(columns).max(axis=0) > 0.0]
    q, r = np.linalg.qr(columns / np.sqrt((columns**2).mean(axis=0)))
    size = np.abs(np.diag(r))
    return np.asarray(q[:, size > SPANNED * size.max(initial=0.0)] * np.sqrt(len(q)))


def _covariance(curvature: F64) -> F64:
    return np.asarray(2.0 * np.linalg.inv(curvature))


def _minimise(function: Callable[[F64], float], x: F64) -> tuple[F64, float, F64]:
    """Newton's method with differences and a limit on the step: minimum, value and Hessian there."""
    h, k = 0.05, len(x)
    unit, value = h * np.eye(k), function(x)
    for _ in range(25):
        up = np.array([function(x + e) for e in unit])
        down = np.array([function(x - e) for e in unit])
        hessian = np.diag((up - 2.0 * value + down) / h**2)
        for i in range(k):
            for j in range(i):
                both = function(x + unit[i] + unit[j])
                hessian[i, j] = hessian[j, i] = (both - up[i] - up[j] + value) / h**2
        power, vectors = np.linalg.eigh(hessian)
        power = np.maximum(np.abs(power), 1e-3)
        step = -vectors @ ((vectors.T @ (up - down)) / (2.0 * h * power))
        step *= min(1.0, 1.5 / max(float(np.abs(step).max()), 1e-300))
        while (after := function(x + step)) > value and np.abs(step).max() > 1e-3:
            step /= 3.0
        if after <= value:
            x, value = x + step, after
        if np.abs(step).max() < ENOUGH:
            break
    return x, value, np.asarray((vectors * power) @ vectors.T)
