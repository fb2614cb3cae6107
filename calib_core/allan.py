"""Overlapping Allan deviation of a still record, and the noise terms it shows (IEEE Std 952 annex C; NIST SP 1065)."""

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calib_core.kalman import F64
from calib_core.problem import Problem

LEAST = 64  # samples that the noise terms are asked of
FLICKER = 2.0 * math.log(2.0) / math.pi  # Allan variance of a bias instability B is B² times this


@dataclass(frozen=True, eq=False)
class Allan:
    """Deviation (k,) in the record's unit at averaging times tau_s (k,), with its standard uncertainty (k,)."""

    tau_s: F64
    deviation: F64
    standard_uncertainty: F64


@dataclass(frozen=True)
class Term:
    """A coefficient and its standard uncertainty; not ``seen`` when it is within two uncertainties of nothing."""

    value: float
    standard_uncertainty: float
    seen: bool


@dataclass(frozen=True)
class Terms:
    """For a record in U (deg/s, V): angle random walk in U/√Hz, bias instability in U, rate random walk in U·√Hz."""

    angle_random_walk: Term
    bias_instability: Term
    rate_random_walk: Term


def octaves(n: int) -> list[int]:
    """Averaging lengths 1, 2, 4 … up to a quarter of n samples."""
    return [1 << k for k in range(max(1, (n // 4).bit_length()))]


def deviation(x: F64, rate_hz: float, lengths: list[int] | None = None) -> Allan:
    """Overlapping Allan deviation of x (n,), sampled at rate_hz, over averages of ``lengths`` samples.

    σ²(mT) = ⟨(θ[i+2m] - 2θ[i+m] + θ[i])²⟩ / 2(mT)² with θ the running integral of x (NIST SP 1065, 5.2.4).
    x must have no gaps. Raises ValueError where a length does not fit twice into the record.
    """
    lengths = octaves(len(x)) if lengths is None else lengths
    if not lengths or max(lengths) * 2 > len(x):
        raise ValueError(f"{len(x)} samples; every averaging length must fit twice, asked {lengths}")
    theta = np.concatenate([[0.0], np.cumsum(x - np.mean(x))])  # the mean cancels; without it, digits survive
    sigma = np.empty(len(lengths))
    for k, m in enumerate(lengths):
        second = theta[2 * m :] - 2.0 * theta[m:-m] + theta[: -2 * m]
        sigma[k] = math.sqrt(float(second @ second) / (2.0 * len(second))) / m
    return Allan(np.array(lengths) / rate_hz, sigma, sigma / np.sqrt(2.0 * _freedom(len(theta), np.array(lengths))))


def _freedom(n: int, m: NDArray[np.int_]) -> F64:
    """Equivalent degrees of freedom, n integral samples: the fewer of white noise's and random walk's (Riley, NIST
    SP 1065, 5.4.2; Howe et al. 1981)."""
    white = (3.0 * (n - 1) / (2.0 * m) - 2.0 * (n - 2) / n) * 4.0 * m**2 / (4.0 * m**2 + 5.0)
    walk = (n - 2) / m * ((n - 1) ** 2 - 3.0 * m * (n - 1) + 4.0 * m**2) / (n - 3) ** 2
    return np.minimum(white, walk)


def terms(x: F64, rate_hz: float) -> Terms:
    """Noise terms of a still record x (n,) at rate_hz: σ²(τ) = N²/τ + B²·2ln2/π + K²·τ/3 over octaves of τ.

    Least squares with no negative term, weighted by the fit's own variance 2σ⁴/ν, with ν halved: neighbouring octaves
    overlap, and in white noise all of them together know 1/1.9 of the sum of what each knows. Problem
    allan.too_short below LEAST samples.
    """
    if len(x) < LEAST:
        raise Problem("allan.too_short", samples=len(x), needed=LEAST)
    lengths = octaves(len(x))
    measured = deviation(x, rate_hz, lengths)
    variance = measured.deviation**2
    if not variance.all():  # a stuck channel: nothing to fit, and no weights
        return Terms(*(Term(0.0, 0.0, False) for _ in range(3)))
    tau = measured.tau_s
    columns = np.stack([1.0 / tau, np.full(len(tau), FLICKER), tau / 3.0], axis=1)
    freedom = _freedom(len(x) + 1, np.array(lengths)) / 2.0
    fitted = variance
    for _ in range(10):  # the weights need the fit
        weight = np.sqrt(freedom / 2.0) / fitted
        square = _non_negative(columns * weight[:, None], variance * weight)
        fitted = columns @ square
    weight = np.sqrt(freedom / 2.0) / fitted
    spread = np.sqrt(np.diag(np.linalg.inv((columns * weight[:, None]).T @ (columns * weight[:, None]))))
    return Terms(*(_term(c, u) for c, u in zip(square.tolist(), spread.tolist(), strict=True)))


def _non_negative(a: F64, y: F64) -> F64:
    """Least squares a·c = y with c >= 0: the best of the few subsets of columns whose solution is positive."""
    best, best_misfit = np.zeros(a.shape[1]), float(y @ y)
    for size in range(1, a.shape[1] + 1):
        for subset in combinations(range(a.shape[1]), size):
            part = a[:, subset]
            c = np.linalg.lstsq(part, y, rcond=None)[0]
            misfit = float(np.sum((y - part @ c) ** 2))
            if np.all(c > 0) and misfit < best_misfit:
                best, best_misfit = np.zeros(a.shape[1]), misfit
                best[list(subset)] = c
    return best


def _term(square: float, uncertainty: float) -> Term:
    """From the squared coefficient; one that is not seen may be anything up to about the uncertainty given."""
    value = math.sqrt(square)
    seen = square > 2.0 * uncertainty
    return Term(value, uncertainty / (2.0 * value) if seen else math.sqrt(uncertainty), seen)
