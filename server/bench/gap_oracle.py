"""What could be detected at best in a recording whose truth is known: METHOD 3's scale of strengths.

The oracle knows the effect's shape, its column in this recording and the noise; only bias and scale factor are free.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from server.bench.gap_records import Record, record

F64 = NDArray[np.float64]

POWERED = 4.2
"""√NCP at which a test at 0.02/25 has 80 % power."""


def detectable(seed: int, effect: str, options: Mapping[str, Any]) -> float:
    """The strength of ``effect`` at which the oracle's √NCP is 4.2, in a record with an exact reference rate."""
    strength = 1.0
    for _ in range(4):  # not all effects grow in proportion to their strength
        seen = evidence(record(seed, {effect: strength}, **options), options)
        strength *= float(np.clip(POWERED / max(seen, 1e-9), 0.05, 20.0))
    return strength


def evidence(made: Record, options: Mapping[str, Any]) -> float:
    """√NCP of all that bias and scale factor do not explain in the noiseless output."""
    axis = made.truth["axis"]
    scale = float(str(made.truth["scale_factor_V_per_dps"]))
    clean = made.columns[f"{axis}_gyro_v"] - scale * made.gyro_noise_dps
    base = np.column_stack([np.ones(len(clean)), made.columns[f"{axis}_rate_dps"]])
    step = 5.0 / 4096.0
    white = np.hypot(options.get("white_V", 1.2e-3), step / np.sqrt(12.0))
    shape = whitened(np.column_stack([clean, base]), white, options.get("ar1_V", 0.0), options.get("phi", 0.0))
    left = shape[:, 0] - shape[:, 1:] @ np.linalg.lstsq(shape[:, 1:], shape[:, 0], rcond=None)[0]
    return float(np.sqrt(left @ left))


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
    return np.asarray(lfilter([1.0, -phi], [1.0, -theta], values - values[0], axis=0)[1:] / innovation)
