"""Thesis 3.5-3.9 and METHOD 1: the steady gain, its discrete twin, and the fast forms that must not differ."""

import math

import numpy as np
import pytest

from calib_core import kalman
from calib_core.kalman import (
    Filter,
    discrete_gain,
    filter_record,
    filterpy_difference,
    noise_density,
    tuning,
    whiteness,
)

DT = 0.01
GAIN = tuning(1.2e-3**2 * DT)


def measured(n: int, seed: int = 1) -> kalman.F64:
    t = np.arange(n) * DT
    return 1.25 + 0.25 * np.sin(1.6 * t) + np.random.default_rng(seed).normal(0.0, 1.2e-3, n)


@pytest.mark.parametrize("q2", [0.0, 1e-9, 1e-4, 1.0])
def test_riccati_equation_gives_the_closed_form(q2: float) -> None:
    q1, r = 1e-4, 1e-8
    gain = kalman.steady_gain(q1, q2, r)
    assert gain.k1 == pytest.approx(math.sqrt(q1 / r), rel=1e-12)
    assert gain.k2 == pytest.approx(math.sqrt(q2 / r + 2 * math.sqrt(q1 / r)), rel=1e-12)


def test_tuning_puts_the_filter_at_ten_rad_per_s_whatever_the_noise() -> None:
    for density in (1e-12, 1e-8, 1e-2):
        assert math.sqrt(tuning(density).k1) == pytest.approx(10.0, rel=1e-9)


@pytest.mark.parametrize(("q1", "q2", "r"), [(0.0, 0.0, 1.0), (1.0, -1.0, 1.0), (1.0, 0.0, 0.0)])
def test_densities_without_an_answer_are_refused(q1: float, q2: float, r: float) -> None:
    with pytest.raises(ValueError, match="Riccati"):
        kalman.steady_gain(q1, q2, r)


def test_discrete_gain_is_the_fixed_point_and_tends_to_the_continuous_one() -> None:
    for dt, tolerance in ((1e-3, 1e-2), (1e-5, 1e-4)):
        k1, k2 = discrete_gain(GAIN, dt)
        assert k1 / dt == pytest.approx(GAIN.k1, rel=tolerance)
        assert k2 / dt == pytest.approx(GAIN.k2, rel=tolerance)
        p = np.array([[0.0, 0.0], [0.0, 0.0]])
        p[[0, 0, 1], [0, 1, 1]] = kalman._twin(GAIN, dt).prior
        p[1, 0] = p[0, 1]
        phi = np.array([[1.0, 0.0], [dt, 1.0]])
        q1, q12, q2 = kalman._twin(GAIN, dt).q
        after = p - np.outer([k1, k2], p[1])
        assert phi @ after @ phi.T + [[q1, q12], [q12, q2]] == pytest.approx(p, rel=1e-11)


def test_filterpy_agrees_on_the_first_thousand_samples() -> None:
    assert filterpy_difference(measured(1000), DT, GAIN) < 1e-12


def test_filterpy_agrees_where_samples_are_missing() -> None:
    v = measured(1000)
    v[[0, 1, 50, 400, 401, 402, 999]] = np.nan
    assert filterpy_difference(v, DT, GAIN) < 1e-12


def test_check_of_record_sees_a_wrong_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kalman, "filter_record", lambda v, dt, gain: filter_record(v, dt, tuning(gain.r, 10.001)))
    assert filterpy_difference(measured(1000), DT, GAIN) > 1e-9


def test_blocks_of_any_length_give_what_the_whole_record_gives() -> None:
    v = measured(20_000)
    v[[0, 700, 701, 5000, 19_999]] = np.nan
    stream, rng, parts, done = Filter(GAIN, DT), np.random.default_rng(3), [], 0
    while done < len(v):
        step = int(rng.integers(1, 400))
        parts.append(stream.update(v[done : done + step]))
        done += step
    np.testing.assert_allclose(np.concatenate(parts), filter_record(v, DT, GAIN), rtol=0, atol=1e-13)


def test_block_products_are_the_plain_recursion() -> None:
    v = measured(3000)
    k1, k2 = discrete_gain(GAIN, DT)
    filtered = filter_record(v, DT, GAIN)
    start = 1000  # past the transient; the slope there follows from two filtered values
    value = filtered[start]
    slope = (filtered[start + 1] - value - k2 * (v[start + 1] - value)) / (DT * (1 - k2))
    for k in range(start + 1, len(v)):
        predicted = value + DT * slope
        slope += k1 * (v[k] - predicted)
        value = predicted + k2 * (v[k] - predicted)
        assert filtered[k] == pytest.approx(value, abs=1e-12)


def test_missing_samples_hold_the_slope() -> None:
    v = 1.2 + 0.3 * np.arange(2000) * DT
    v[1500:1510] = np.nan
    np.testing.assert_allclose(filter_record(v, DT, GAIN)[1000:], 1.2 + 0.3 * np.arange(1000, 2000) * DT, atol=1e-9)


def test_a_record_without_a_sample_stays_without_one() -> None:
    assert np.isnan(filter_record(np.full(5, np.nan), DT, GAIN)).all()
    assert filter_record(np.empty(0), DT, GAIN).shape == (0,)


def test_noise_density_looks_through_the_motion() -> None:
    assert noise_density(measured(10_000), DT) == pytest.approx(GAIN.r, rel=0.05)


def model_output(n: int, seed: int, noise: float = 1.0) -> kalman.F64:
    """V that is exactly what the gain was made for: an integrated random walk in noise."""
    rng = np.random.default_rng(seed)
    q1, q12, q2 = kalman._twin(GAIN, DT).q
    variance = GAIN.r / DT
    slope_step, value_step = np.linalg.cholesky([[q1, q12], [q12, q2]]) @ rng.normal(size=(2, n)) * math.sqrt(variance)
    slope = np.cumsum(slope_step)
    value = np.cumsum(value_step + DT * (slope - slope_step))
    return 1.25 + value + rng.normal(0.0, noise * math.sqrt(variance), n)


def test_innovations_of_the_right_gain_are_white_at_the_stated_rate() -> None:
    tests = [whiteness(v, filter_record(v, DT, GAIN), DT, GAIN) for v in (model_output(3000, s) for s in range(60))]
    p = np.array([t.p for t in tests])
    assert 0.3 < np.mean(p) < 0.7
    assert np.sum(p < 0.01) <= 3
    assert np.mean([t.variance_ratio for t in tests]) == pytest.approx(1.0, abs=0.02)


def test_a_fixed_gain_is_told_when_the_noise_has_grown() -> None:
    v = model_output(3000, 5, noise=3.0)
    result = whiteness(v, filter_record(v, DT, GAIN), DT, GAIN)
    assert not result.ok
    assert result.variance_ratio > 4
