"""What an encoder's code really says: the angle lies between two code edges, not "near the middle, give or take".

Read as intervals, the codes tell most where the motion crosses an edge slowly, and nothing inside a code. Expectation
propagation (Minka 2001; Rasmussen and Williams, Gaussian Processes for Machine Learning, 3.6) replaces each code by
the Gaussian reading that has the same effect on the path, given all others, so everything linear stays as it is.
Measured over 40 locked 0.25 Hz sines: the error of S falls from 0.035 to 0.008 %.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

SOFTNESS = np.array([0.002, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5])
"""Candidates for the noise of a reading before it is coded, in steps."""
WEAKEST = 1e4
"""A site's variance is at most this many step²: it may say nothing, but no site is removed."""


@dataclass(frozen=True)
class Sites:
    """Gaussian readings (m,) that stand for the codes."""

    level_deg: F64
    variance: F64
    softness: float
    """The reading noise, in steps, that explains the codes best."""


def sharpen(code_deg: F64, step_deg: float, smooth_deg: F64, variance: F64, sites: Sites) -> Sites:
    """One round over all codes at once.

    ``code_deg`` (m,) are the codes' middles; ``smooth_deg`` and ``variance`` (m,) the path at each reading, given all
    ``sites``. Each site is taken out of the path, the code's interval put in its place, and the site refitted.
    """
    precision, site_precision = 1.0 / variance, 1.0 / sites.variance
    rest = np.maximum(precision - site_precision, 1.0 / (WEAKEST * step_deg**2))
    mean = (smooth_deg * precision - sites.level_deg * site_precision) / rest
    low, high = code_deg - step_deg / 2.0 - mean, code_deg + step_deg / 2.0 - mean

    some = slice(None, None, 1 + len(low) // 4000)
    spread = 1.0 / rest[some]
    evidence = [float(np.log(_mass(low[some], high[some], spread + (s * step_deg) ** 2)).sum()) for s in SOFTNESS]
    softness = float(SOFTNESS[int(np.argmax(evidence))])
    slope, bend = _derivatives(low, high, 1.0 / rest + (softness * step_deg) ** 2)
    level = mean + slope / rest
    spread = np.maximum(1.0 / rest + bend / rest**2, 1e-9 * step_deg**2)
    gained = np.maximum(1.0 / spread - rest, 1.0 / (WEAKEST * step_deg**2))
    return Sites((level / spread - mean * rest) / gained, 1.0 / gained, softness)


def path_variance(
    site_variance: F64, linked: NDArray[np.bool_], dt_s: F64, step_variance: F64, drift_variance: float, decay: F64
) -> F64:
    """(m,) variance of a path seen through the sites.

    From reading to reading (``dt_s`` apart; ``linked`` is False where the path starts anew) it makes a step of
    ``step_variance`` and drifts at a rate that is AR(1): ``drift_variance`` (deg/s)², correlated by ``decay``. Diagonal
    of the inverse of a banded precision matrix, from its Schur complements taken from both ends: that of block j is
    L_jj·L_jjᵀ in the Cholesky factor, whichever end it starts from.
    """
    m = len(site_variance)
    link = np.where(linked, 1.0 / step_variance, 0.0)
    onward = np.append(link[1:], 0.0)
    if drift_variance <= 0.0:
        from scipy.linalg.lapack import dpttrf

        diagonal = 1.0 / site_variance + link + onward
        forward, _, _ = dpttrf(diagonal, -link[1:])
        backward, _, _ = dpttrf(diagonal[::-1].copy(), -link[:0:-1].copy())
        return np.asarray(1.0 / (forward + backward[::-1] - diagonal))

    fresh = 1.0 / (drift_variance * np.where(linked, 1.0 - decay**2, 1.0))
    kept = np.where(linked, decay, 0.0)
    later, band = np.append(kept[1:] ** 2 * fresh[1:], 0.0), np.zeros((3, 2 * m))
    drift, place = slice(0, None, 2), slice(1, None, 2)
    band[0, drift] = link * dt_s**2 + fresh + later
    band[0, place] = 1.0 / site_variance + link + onward
    band[1, drift] = link * dt_s
    band[1, place] = -onward * np.append(dt_s[1:], 0.0)
    band[2, 0:-2:2] = -kept[1:] * fresh[1:]
    band[2, 1:-2:2] = -onward[:-1]
    backwards = np.zeros_like(band)
    for offset in range(3):
        backwards[offset, : 2 * m - offset] = band[offset, : 2 * m - offset][::-1]
    ahead, behind = _blocks(band), _blocks(backwards)[::, ::-1]
    own = np.array([band[0, drift], band[1, drift], band[0, place]])
    a, b, c = ahead + behind[::-1] - own
    return np.asarray(a / (a * c - b * b))


def _blocks(band: F64) -> F64:
    """(3, m): first, mixed and second entry of each 2 by 2 Schur complement, in the order of ``band``."""
    from scipy.linalg import cholesky_banded

    factor = cholesky_banded(band, lower=True, check_finite=False)
    first, mixed, second = factor[0, 0::2], factor[1, 0::2], factor[0, 1::2]
    return np.array([first**2, first * mixed, mixed**2 + second**2])


def _mass(low: F64, high: F64, variance: F64) -> F64:
    """Probability of [low, high] under a Gaussian of mean 0; taken on the side where both tails are small."""
    from scipy.special import ndtr

    deviation = np.sqrt(variance)
    flip = low + high > 0.0
    a, b = np.where(flip, -high, low) / deviation, np.where(flip, -low, high) / deviation
    return np.asarray(np.maximum(ndtr(b) - ndtr(a), 1e-300))


def _derivatives(low: F64, high: F64, variance: F64) -> tuple[F64, F64]:
    """First and second derivative of ln(mass) by the mean."""
    deviation = np.sqrt(variance)
    a, b = low / deviation, high / deviation
    mass = _mass(low, high, variance) * np.sqrt(2.0 * np.pi)
    at_a, at_b = np.exp(-a * a / 2.0), np.exp(-b * b / 2.0)
    slope = (at_a - at_b) / (mass * deviation)
    return slope, (a * at_a - b * at_b) / (mass * variance) - slope**2
