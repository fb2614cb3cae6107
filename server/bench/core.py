"""Filters: speed against what users would use (METHOD 6), agreement, and thesis 4.2 simulated."""

import numpy as np
from numpy.typing import NDArray

from calib_core import adaptation, kalman
from calib_core.thesis import simulation
from server.bench import Row, fastest, per_sample

F64 = NDArray[np.float64]
DT = 0.01
GAIN = kalman.tuning(1.2e-3**2 * DT)
GAMMA_1 = adaptation.GAMMA_1
GAMMA_2 = GAMMA_1 / 1110.0  # mean square rate of the thesis' sine, (deg/s)²
BIAS, SCALE = 1.23, 0.0083  # the datasheet's, where the rule starts


def run(*, quick: bool) -> list[Row]:
    return [*kalman_filter(quick), *mit_rule(quick), *thesis_simulation(5 if quick else 20)]


def kalman_filter(quick: bool) -> list[Row]:
    rng = np.random.default_rng(1)
    n, compared = 1_000_000, 5_000 if quick else 100_000
    v = 1.25 + 0.25 * np.sin(0.016 * np.arange(n)) + rng.normal(0.0, 1.2e-3, n)
    reference = kalman.reference_filter(GAIN, DT, float(v[0]))
    samples = v[:compared].tolist()

    def loop() -> None:
        for z in samples:
            reference.predict()
            reference.update(z)

    ours, theirs = fastest(lambda: kalman.filter_record(v, DT, GAIN), loop, rounds=8 if quick else 4)
    ours, theirs = ours / n, theirs / compared

    stream = kalman.Filter(GAIN, DT)
    edges = np.sort(rng.integers(0, n, 2000))
    pieces = np.concatenate([stream.update(part) for part in np.split(v, edges)])
    apart = float(np.max(np.abs(pieces - kalman.filter_record(v, DT, GAIN))))
    check = kalman.filterpy_difference(v[:1000], DT, GAIN)
    return [
        Row(
            "Kalman filter, 1e6 samples", theirs / ours, "×", 400, at_least=True,
            ours=f"{per_sample(ours)} a sample", theirs=f"filterpy's loop {per_sample(theirs)}",
        ),
        Row("Kalman filter, streaming from whole record", apart, "V", 1e-9, ours="2001 blocks of random length"),
        Row("Kalman filter, from filterpy", check, "V", 1e-9, ours="first 1000 samples, from the same start"),
    ]  # fmt: skip


def mit_rule(quick: bool) -> list[Row]:
    rng = np.random.default_rng(2)
    n, boards, settled = (2_000 if quick else 10_000), 1_000, 1_700
    rate = rng.normal(0.0, 33.0, (n, boards))
    v = 1.25 + 0.005 * rate + rng.normal(0.0, 1.2e-3, (n, boards))
    one_rate, one_v = rate.ravel()[:10_000].copy(), v.ravel()[:10_000].copy()  # an estimate state of 100 s
    every = {"gamma2": GAMMA_2, "bias": BIAS, "scale_factor": SCALE}
    each = {name: np.full(boards, value) for name, value in every.items()}

    ours_one, numpy_one, python_one, ours_many = fastest(
        lambda: adaptation.adapt(one_v, one_rate, DT, gamma1=GAMMA_1, **every),
        lambda: numpy_steps(one_v, one_rate),
        lambda: python_steps(one_v, one_rate, settled),
        lambda: adaptation.adapt_many(v, rate, DT, gamma1=GAMMA_1, **each, first=settled),
        rounds=8,
    )
    ours_one, numpy_one, python_one = ours_one / len(one_v), numpy_one / len(one_v), python_one / len(one_v)
    ours_many /= n * boards
    return [
        Row(
            "MIT rule, one board, trace", numpy_one / ours_one, "×", 8, at_least=True,
            ours=f"{per_sample(ours_one)} a sample", theirs=f"numpy at each step {per_sample(numpy_one)}",
        ),
        Row(
            "MIT rule, 1000 boards, settled means", python_one / ours_many, "×", 25, at_least=True,
            ours=f"{per_sample(ours_many)} a sample", theirs=f"Python, board by board {per_sample(python_one)}",
        ),
    ]  # fmt: skip


def numpy_steps(v: F64, rate: F64) -> F64:
    """The rule as it is written on paper, with vectors of two at every step."""
    gain = np.array([GAMMA_1, GAMMA_2]) * DT
    parameters = np.array([BIAS, SCALE])
    trace = np.empty((len(v), 2))
    for k in range(len(v)):
        regressor = np.array([1.0, rate[k]])
        error = v[k] - regressor @ parameters
        parameters = parameters + gain * error * regressor
        trace[k] = parameters
    return trace


def python_steps(v: F64, rate: F64, settled: int) -> tuple[float, float]:
    """The rule as it is written on paper, in plain Python numbers, and the means of the settled trace."""
    bias, scale, biases, scales = BIAS, SCALE, [], []
    for y, w in zip(v.tolist(), rate.tolist(), strict=True):
        error = y - (scale * w + bias)
        bias += GAMMA_1 * error * DT
        scale += GAMMA_2 * error * w * DT
        biases.append(bias)
        scales.append(scale)
    kept = len(biases) - settled
    return sum(biases[settled:]) / kept, sum(scales[settled:]) / kept


def thesis_simulation(seeds: int) -> list[Row]:
    """Thesis 4.2: S 0.005, β 1.25 V, ±30° at 0.25 Hz, 100 s at 100 Hz, 1.2 mV of noise, quantised encoder."""
    limits = {"integral_fit": (0.03, 0.1), "matched": (0.5, 1.0), "thesis": (None, None)}
    names = {"integral_fit": "integral fit", "matched": "adaptive, matched", "thesis": "adaptive, thesis' own form"}
    study = simulation.study(seeds)
    rows = []
    for estimator, (of_scale, of_bias) in limits.items():
        scale_pct = 100.0 * (study.scale_factor[estimator] / simulation.SCALE_FACTOR - 1.0)
        bias_mV = 1e3 * (study.bias_V[estimator] - simulation.BIAS_V)
        for what, error, unit, limit in (("scale factor", scale_pct, "%", of_scale), ("bias", bias_mV, "mV", of_bias)):
            rows.append(
                Row(
                    f"thesis 4.2, {names[estimator]}: {what}", float(np.max(np.abs(error))), unit, limit,
                    ours=f"worst of {seeds} seeds, mean {np.mean(error):+.2g} {unit}",
                )
            )  # fmt: skip
    return rows
