"""Codes read as intervals: exact where it can be worked out by brute force, and better where that was the promise."""

import numpy as np
import pytest
from gyro_truth import thesis
from numpy.typing import NDArray

from calib_core import integral_fit
from calib_core.code_likelihood import Sites, path_variance, sharpen

F64 = NDArray[np.float64]


@pytest.mark.parametrize("drift_variance", [0.0, 0.7])
def test_path_variance_equals_dense_algebra(drift_variance: float) -> None:
    rng = np.random.default_rng(1)
    m = 12
    site, dt, step = rng.uniform(0.5, 3.0, m), rng.uniform(0.5, 1.5, m), rng.uniform(0.1, 0.5, m)
    decay, linked = rng.uniform(0.3, 0.9, m), np.ones(m, bool)
    linked[[0, 5]] = False
    # One row per statement about the drifts (even) and places (odd): coefficients, variance.
    statements: list[tuple[dict[int, float], float]] = [({2 * j + 1: 1.0}, site[j]) for j in range(m)]
    for j in range(m):
        tiny = max(drift_variance, 1e-12)
        statements.append(({2 * j: 1.0}, tiny) if not linked[j] else ({}, 1.0))
        if linked[j]:
            statements.append(({2 * j + 1: 1.0, 2 * j - 1: -1.0, 2 * j: dt[j]}, step[j]))
            statements.append(({2 * j: 1.0, 2 * j - 2: -decay[j]}, tiny * (1.0 - decay[j] ** 2)))
    precision = np.zeros((2 * m, 2 * m))
    for coefficients, variance in statements:
        row = np.zeros(2 * m)
        row[list(coefficients)] = list(coefficients.values())
        precision += np.outer(row, row) / variance
    dense = np.diag(np.linalg.inv(precision))[1::2]
    np.testing.assert_allclose(path_variance(site, linked, dt, step, drift_variance, decay), dense, rtol=1e-6)


def test_one_reading_becomes_the_mean_and_variance_of_its_interval() -> None:
    # A path known to lie at 0.05 ± 0.2 and a code that says [-0.5, 0.5]: by numerical integration.
    grid = np.linspace(-0.5, 0.5, 20_001)
    weight = np.exp(-0.5 * ((grid - 0.4) / 0.2) ** 2)
    mean = float((weight @ grid) / weight.sum())
    variance = float(weight @ (grid - mean) ** 2 / weight.sum())
    sites = Sites(np.array([0.0]), np.array([1e6]), 0.0)
    precision = 1.0 / 0.2**2 + 1e-6
    found = sharpen(np.array([0.0]), 1.0, np.array([0.4 / 0.2**2 / precision]), np.array([1.0 / precision]), sites)
    together = 1.0 / 0.2**2 + 1.0 / found.variance[0]
    assert (0.4 / 0.2**2 + found.level_deg[0] / found.variance[0]) / together == pytest.approx(mean, abs=2e-3)
    assert 1.0 / together == pytest.approx(variance, rel=0.01)


def test_a_reading_far_inside_its_code_says_nothing_and_one_far_outside_is_survived() -> None:
    sites = Sites(np.zeros(2), np.full(2, 1e3), 0.0)
    found = sharpen(np.zeros(2), 1.0, np.array([0.01, 40.0]), np.full(2, 1e-4), sites)
    assert found.variance[0] > 1e2
    assert np.isfinite(found.level_deg).all()
    assert (found.variance > 0.0).all()


def test_intervals_take_most_of_the_error_out_of_locked_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    boards = [thesis(seed) for seed in range(6)]

    def rms_pct() -> float:
        off = [integral_fit.fit(b.recording, "x").scale_factor / b.scale_factor - 1.0 for b in boards]
        return 100.0 * float(np.sqrt(np.mean(np.square(off))))

    intervals = rms_pct()
    monkeypatch.setattr(integral_fit, "SOFTEST", 0.0)
    middles = rms_pct()
    assert intervals < 0.5 * middles
