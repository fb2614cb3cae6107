"""The model as truth: noise of the asked size at any rate, and blocks that join without a seam."""

import numpy as np
import pytest

from calib_core.model import Model, Noise, Truth


def output(model: Model, rate_hz: float, blocks: list[int], seed: int = 1) -> np.ndarray:
    simulate = model.simulator("x", rate_hz, np.random.default_rng(seed))
    at = np.cumsum([0, *blocks])
    return np.concatenate(
        [
            simulate(Truth((start + np.arange(n)) / rate_hz, {"x": np.full(n, 10.0)}))
            for start, n in zip(at, blocks, strict=False)
        ]
    )


@pytest.mark.parametrize("rate_hz", [100.0, 1000.0])
def test_white_noise_is_a_density_so_that_means_over_ten_ms_are_alike(rate_hz: float) -> None:
    v = output(Model(1.25, 0.006, noise=Noise(0.0012)), rate_hz, [200_000])
    assert v.mean() == pytest.approx(1.25 + 0.06, abs=2e-5)
    rows = v.reshape(-1, int(rate_hz / 100)).mean(axis=1)
    assert rows.std() == pytest.approx(0.0012, rel=0.02)


def test_coloured_noise_has_its_size_and_its_correlation_time_at_any_block_length() -> None:
    model = Model(0.0, 0.006, noise=Noise(0.0, 0.0008, 0.05))
    v = output(model, 1000.0, [7, 400, 150_000, 1, 49_592])
    v -= 0.06
    assert v.std() == pytest.approx(0.0008, rel=0.05)
    for lag in (20, 50, 100):
        assert np.mean(v[lag:] * v[:-lag]) / np.var(v) == pytest.approx(np.exp(-lag / 50.0), abs=0.05)


def test_a_seed_gives_the_same_noise_again_and_another_does_not() -> None:
    model = Model(1.25, 0.006, noise=Noise(0.0012, 0.0005))
    assert np.array_equal(output(model, 1000.0, [500, 500]), output(model, 1000.0, [500, 500]))
    assert not np.array_equal(output(model, 1000.0, [500, 500]), output(model, 1000.0, [500, 500], seed=2))


def test_rate_undoes_predict() -> None:
    model = Model(1.25, -0.006)
    rate = np.array([-100.0, 0.0, 47.1])
    np.testing.assert_allclose(model.rate(model.predict(rate)), rate, atol=1e-12)
