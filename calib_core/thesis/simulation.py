"""The thesis' simulation study (4.2) again: a 0.25 Hz sine, beta = 1.25 V, S = 0.005 V/(deg/s), white noise.

Three estimators on the same recordings: the thesis' own form of the adaptive law, the matched form, and the integral
fit. The encoder is quantised and read at its own times, as on the bench.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib_core import adaptation, integral_fit
from calib_core.recording import Recording

F64 = npt.NDArray[np.float64]
Progress = Callable[[int, int], None]

BIAS_V, SCALE_FACTOR = 1.25, 0.005
AMPLITUDE_DEG, FREQUENCY_HZ, DURATION_S, ROW_HZ = 30.0, 0.25, 100.0, 100.0
NOISE_V = 0.0012
STEP_DEG = 300.0 / 1023.0
JITTER_S = 0.002
"""Half the spread of the encoder's reading times."""
ESTIMATORS = ("thesis", "matched", "integral_fit")


@dataclass(frozen=True, eq=False)
class Study:
    """Bias (V) and scale factor (V per deg/s) by each estimator, arrays (seeds,)."""

    bias_V: Mapping[str, F64]
    scale_factor: Mapping[str, F64]


def recording(seed: int, frequency_hz: float = FREQUENCY_HZ) -> Recording:
    """One simulated estimation record of axis x."""
    rng = np.random.default_rng([42, seed])
    rows = round(DURATION_S * ROW_HZ)
    time = np.arange(0.5, rows) / ROW_HZ
    omega = 2.0 * np.pi * frequency_hz
    rate = AMPLITUDE_DEG * omega * np.cos(omega * time)
    volts = BIAS_V + SCALE_FACTOR * rate + NOISE_V * rng.standard_normal(rows)
    read_at = time + rng.uniform(-JITTER_S, JITTER_S, rows)
    codes = np.round(AMPLITUDE_DEG * np.sin(omega * read_at) / STEP_DEG) * STEP_DEG
    columns = {"x_gyro_v": volts, "x_position_deg": codes, "x_position_time_s": read_at}
    return Recording(time, columns, np.zeros(rows, np.int32), ("estimate_x",))


def study(seeds: int, frequency_hz: float = FREQUENCY_HZ, *, progress: Progress | None = None) -> Study:
    """The three estimates of recordings 0 … seeds - 1; ``progress`` is told how many are done, of how many."""
    bias: dict[str, list[float]] = {name: [] for name in ESTIMATORS}
    scale: dict[str, list[float]] = {name: [] for name in ESTIMATORS}
    for seed in range(seeds):
        record = recording(seed, frequency_hz)
        volts, encoder = record.gyro("x").values, record.position("x")
        for form in ("thesis", "matched"):
            found = adaptation.estimate(record.time_s, volts, *encoder, form=form, frequency_hz=frequency_hz)
            bias[form].append(found.bias_V)
            scale[form].append(found.scale_factor_V_per_dps)
        fit = integral_fit.fit(record, "x")
        bias["integral_fit"].append(fit.bias)
        scale["integral_fit"].append(fit.scale_factor)
        if progress:
            progress(seed + 1, seeds)
    return Study({k: np.array(v) for k, v in bias.items()}, {k: np.array(v) for k, v in scale.items()})
