"""Short columns for a screen: a long signal by its extremes, a residual along a covariate, its spectrum."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

SPECTRUM_SAMPLES = 1024
BINS = 16


def decimated(values: F64, most: int) -> Ints:
    """Indices of at most ``most`` values (k,): the lowest and the highest of each stretch, in order of time."""
    if len(values) <= most:
        return np.arange(len(values))
    edges = np.linspace(0, len(values), max(1, most // 2) + 1).astype(int)
    picked = [b + np.array([values[b:e].argmin(), values[b:e].argmax()]) for b, e in pairwise(edges.tolist())]
    return np.unique(np.concatenate(picked))


def stretches(at: F64, residual: F64, spread: F64) -> tuple[F64, F64, F64]:
    """Middle, mean residual and its standard deviation (noise alone) in up to ``BINS`` parts of the covariate."""
    order = np.argsort(at, kind="stable")
    least = float(np.ptp(at)) / (3.0 * BINS)
    rows, begin = [], 0
    for end in [*(np.arange(1, BINS) * len(order) // BINS), len(order)]:
        part = order[begin:end]
        if len(part) > 3 and (at[part[-1]] - at[part[0]] >= least or end == len(order)):
            # Windows overlap by half: two neighbours count as one and a half.
            sigma = np.sqrt(np.mean(spread[part] ** 2) / len(part)) * 1.2
            rows.append((at[part].mean(), residual[part].mean(), sigma))
            begin = end
    table = np.array(rows).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2]


def spectrum(values: F64, interval_s: float) -> tuple[F64, F64]:
    """Frequencies (f,) in Hz and amplitude density (f,) per √Hz, by Welch's mean over Hann windows half overlapped."""
    n = min(SPECTRUM_SAMPLES, len(values))
    window = np.hanning(n)
    pieces = np.lib.stride_tricks.sliding_window_view(values, n)[:: max(1, n // 2)]
    power = np.mean(np.abs(np.fft.rfft((pieces - pieces.mean(axis=1, keepdims=True)) * window)) ** 2, axis=0)
    density = np.sqrt(2.0 * power * interval_s / np.sum(window**2))
    return np.asarray(np.fft.rfftfreq(n, interval_s)[1:]), np.asarray(density[1:], np.float64)
