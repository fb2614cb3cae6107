"""Single samples that stand far out of a level on which their neighbours agree: a read error, or a part not yet awake.

No motion does that and no effect of the library, but one such sample in an hour is enough to be taken for one.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

FAR = 15.0
"""Deviations of the noise: no sample of 10⁹ is there by chance."""
FLAT = 6.0
"""And so many times the range of its neighbours."""
BESIDE = 4


def spikes(values: F64) -> Ints:
    """(m,) which of the samples (n,), in time order, are spikes; the first and the last may be."""
    if len(values) < 4 * BESIDE:
        return np.empty(0, np.int64)
    third = np.abs(np.diff(values, 3))
    # Where a coarse converter or a limit gives one value for long, its steps are the noise.
    noise = float(np.median(third[third > 0.0])) / (0.6745 * np.sqrt(20.0)) if third.any() else np.inf
    # What is bent no more than this is no spike: few samples are left to look at.
    bend = np.abs(np.diff(values, 2))
    at = np.concatenate([[0], np.flatnonzero(bend > FAR * noise) + 1, [len(values) - 1]])
    around = sliding_window_view(values, BESIDE + 1)[np.clip(at - BESIDE // 2, 0, len(values) - BESIDE - 1)]
    own = np.clip(at, BESIDE // 2, len(values) - 1 - BESIDE // 2) - at
    others = around[np.arange(BESIDE + 1) != (BESIDE // 2 - own)[:, None]].reshape(-1, BESIDE)
    out = np.abs(values[at] - others.mean(axis=1))
    return np.asarray(at[(out > FAR * noise) & (out > FLAT * np.ptp(others, axis=1))])
