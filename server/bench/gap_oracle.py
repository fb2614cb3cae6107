"""What could be detected at best in a recording whose truth is known: METHOD 3's scale of strengths.

The oracle knows the effect's shape in this recording and the noise; only bias and scale factor are free.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from server.bench.gap_records import ADC_STEP_V, ENCODER_STEP_DEG, Record, record

F64 = NDArray[np.float64]

POWERED = 4.2
"""√NCP at which a test at 0.02/25 has 80 % power."""
INTERVAL_S = 0.01
RESTING = 40
"""So many equal codes in a row are a rest: the rate is known to be zero, and the encoder's error stays as it is."""


def detectable(seed: int, effect: str, options: Mapping[str, Any]) -> float:
    """The strength of ``effect`` at which the oracle's √NCP is 4.2."""
    strength = 1.0
    for _ in range(4):  # not all effects grow in proportion to their strength
        seen = evidence(seed, {effect: strength}, options)
        strength *= float(np.clip(POWERED / max(seen, 1e-9), 0.05, 20.0))
        if abs(seen / POWERED - 1.0) < 0.02:
            break
    return strength


@lru_cache(maxsize=2)
def _plain(seed: int, options: tuple[tuple[str, Any], ...]) -> Record:
    """The same recording without any effect."""
    return record(seed, {}, **dict(options))


def evidence(seed: int, effects: Mapping[str, float], options: Mapping[str, Any]) -> float:
    """√NCP of all that the effects do to output and encoder and that bias and scale factor do not explain."""
    left = _left(seed, effects, options)
    return float(np.sqrt(left @ left))


def apart(seed: int, truth: str, rival: str, strength: float, options: Mapping[str, Any]) -> float:
    """√NCP of what ``truth`` does and ``rival``, of whatever size, does not do."""
    left, other = (_left(seed, {name: strength}, options) for name in (truth, rival))
    left = left - other * float(left @ other) / float(other @ other)
    return float(np.sqrt(left @ left))


def _left(seed: int, effects: Mapping[str, float], options: Mapping[str, Any]) -> F64:
    """(n,) whitened: what the effects do and bias and scale factor do not explain."""
    made, plain = record(seed, effects, **options), _plain(seed, tuple(options.items()))
    scale = float(str(made.truth["scale_factor_V_per_dps"]))
    axis = made.truth["axis"]
    white = np.hypot(options.get("white_V", 1.2e-3), ADC_STEP_V / np.sqrt(12.0)) / scale
    noise = (white, options.get("ar1_V", 0.0) / scale, options.get("phi", 0.0))
    clean, clean_plain = (r.columns[f"{axis}_gyro_v"] / scale - r.gyro_noise_dps for r in (made, plain))
    if made.truth["reference"] == "rate":
        base = (np.ones(len(clean)), made.columns[f"{axis}_rate_dps"])
        shape = whitened(np.column_stack([clean - clean_plain, *base]), *noise)
    else:
        codes = made.columns[f"{axis}_position_deg"]
        encoder, encoder_plain = (r.columns[f"{axis}_position_deg"] - r.encoder_error_deg for r in (made, plain))
        base = (np.ones(len(clean)), np.gradient(encoder_plain, INTERVAL_S))
        columns = np.column_stack([clean - clean_plain, *base])
        shape = _on_the_encoder(columns, encoder - encoder_plain, codes, *noise)
    return np.asarray(shape[:, 0] - shape[:, 1:] @ np.linalg.lstsq(shape[:, 1:], shape[:, 0], rcond=None)[0])


def whitened(values: F64, white: float, ar1: float, phi: float) -> F64:
    """Columns (n, p) in which white noise plus AR(1) noise is white of unit variance.

    The sum is ARMA(1, 1), x_k - φx_{k-1} = e_k - ϑe_{k-1}; ϑ and the variance of e follow from two autocovariances.
    """
    if ar1 <= 0.0:
        return values / white
    from scipy.signal import lfilter

    variance = white**2 * (1.0 + phi**2) + ar1**2 * (1.0 - phi**2)
    half = variance / (2.0 * phi * white**2)
    theta = half - np.sqrt(half**2 - 1.0)
    innovation = np.sqrt(phi * white**2 / theta)
    # What went before was as the first value, as far as the filter knows: a constant stays one.
    constant = values[0] * (1.0 - phi) / (1.0 - theta)
    return np.asarray((lfilter([1.0, -phi], [1.0, -theta], values - values[0], axis=0) + constant)[1:] / innovation)


def _on_the_encoder(values: F64, moved: F64, codes: F64, white: float, ar1: float, phi: float) -> F64:
    """Innovations (n, p), in units of their deviation, of columns seen through integrals against a coarse encoder.

    In motion the gyro's noise adds up between readings, each off by its code's rounding; at rest the rate is known to
    be zero and the gyro's noise is seen as it is. The first column is what the output gains, less the encoder's gain.
    """
    run = _run_length(codes)
    rest = run >= RESTING
    rounding = ENCODER_STEP_DEG**2 / 12.0 * np.maximum(1.0, run / 2.0)
    slope = np.gradient(values, axis=0)
    steps = INTERVAL_S * ((values[1:] + values[:-1]) / 2.0 - (slope[1:] - slope[:-1]) / 12.0)
    steps[:, 0] -= np.diff(moved)
    # State: what the integral is off, and the gyro's slow noise; their covariance is [[p, c], [c, q]].
    p, c, q = float(rounding[0]), 0.0, ar1**2
    integral, off, slow = np.zeros(3), np.zeros(3), np.zeros(3)
    out = np.zeros_like(values)
    for k in range(1, len(values)):
        slow_before, slow = slow, phi * slow
        if rest[k] and rest[k - 1]:
            c, q = phi * c, phi**2 * q + ar1**2 * (1.0 - phi**2)
            surprise, variance, gain = values[k] - slow, q + white**2, (c, q)
        else:
            integral = integral + steps[k - 1]
            off = off + INTERVAL_S * slow_before
            p += 2.0 * INTERVAL_S * c + INTERVAL_S**2 * (q + white**2)
            c, q = phi * (c + INTERVAL_S * q), phi**2 * q + ar1**2 * (1.0 - phi**2)
            surprise, variance, gain = integral - off, p + float(rounding[k]), (p, c)
        off, slow = off + gain[0] / variance * surprise, slow + gain[1] / variance * surprise
        p, c, q = p - gain[0] ** 2 / variance, c - gain[0] * gain[1] / variance, q - gain[1] ** 2 / variance
        out[k] = surprise / np.sqrt(variance)
    return out


def _run_length(codes: F64) -> F64:
    """(n,) how many equal codes each sample stands among."""
    first = np.flatnonzero(np.diff(codes, prepend=np.nan) != 0.0)
    length = np.diff(np.append(first, len(codes)))
    return np.repeat(length, length).astype(float)
