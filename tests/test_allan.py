"""Allan deviation against NIST's printed numbers, and its terms against noise made with known ones."""

import json

import numpy as np
import pytest
from shared import shared

from calib_core import allan
from calib_core.problem import Problem


def test_ten_point_set_gives_nist_printed_overlapping_deviation() -> None:
    data = json.loads(shared("reference/allan/nbs14_ten_point.json").read_text(encoding="utf-8"))["ten_point"]
    result = allan.deviation(np.array(data["freq"]), 1.0, data["tau"])
    np.testing.assert_allclose(result.tau_s, data["tau"])
    np.testing.assert_allclose(result.deviation, data["oadev"], rtol=0, atol=5e-6)


def test_white_noise_falls_with_the_root_of_time_and_within_its_uncertainty() -> None:
    x = 5.0 + np.random.default_rng(2).normal(0.0, 0.2, 100_000)
    result = allan.deviation(x, 100.0)
    miss = (result.deviation - 0.02 / np.sqrt(result.tau_s)) / result.standard_uncertainty
    assert np.abs(miss).max() < 3.5
    assert len(result.tau_s) == 15


@pytest.mark.parametrize("lengths", [[], [1, 6]])
def test_an_average_that_does_not_fit_twice_is_refused(lengths: list[int]) -> None:
    with pytest.raises(ValueError, match="fit twice"):
        allan.deviation(np.zeros(10), 1.0, lengths)


def test_terms_cover_the_truth_as_often_as_they_say() -> None:
    walk, noise, misses = 0.05, 0.02, []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        found = allan.terms(rng.normal(0.0, noise * 10, 10_000) + walk * np.cumsum(rng.normal(0.0, 0.1, 10_000)), 100.0)
        assert found.rate_random_walk.seen
        misses.append(
            [
                (found.angle_random_walk.value - noise) / found.angle_random_walk.standard_uncertainty,
                (found.rate_random_walk.value - walk) / found.rate_random_walk.standard_uncertainty,
            ]
        )
    inside = np.mean(np.abs(misses) < 2.0, axis=0)
    assert (inside >= 0.9).all(), inside


def test_white_noise_alone_shows_no_other_term() -> None:
    seen = []
    for seed in range(40):
        found = allan.terms(np.random.default_rng(seed).normal(0.0, 0.2, 5000), 100.0)
        assert found.angle_random_walk.seen
        seen.append(found.bias_instability.seen or found.rate_random_walk.seen)
    assert sum(seen) <= 2


def test_flicker_noise_shows_as_bias_instability() -> None:
    n, rate_hz, instability = 1 << 16, 100.0, 0.03
    found = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        f = np.fft.rfftfreq(4 * n, 1 / rate_hz)[1:]
        density = instability**2 / (np.pi * f)  # one-sided; IEEE Std 952 writes B²/2πf for the two-sided
        line = np.sqrt(density * rate_hz * 4 * n / 4) * (rng.normal(size=len(f)) + 1j * rng.normal(size=len(f)))
        found.append(allan.terms(np.fft.irfft(np.append(0.0, line))[:n], rate_hz).bias_instability)
    assert all(term.seen for term in found)
    assert np.mean([term.value for term in found]) == pytest.approx(instability, rel=0.1)


def test_a_stuck_channel_has_no_terms() -> None:
    assert not allan.terms(np.full(1000, 1.4), 100.0).angle_random_walk.seen


def test_too_short_a_hold_is_refused_with_a_sentence() -> None:
    with pytest.raises(Problem) as refused:
        allan.terms(np.zeros(63), 100.0)
    assert refused.value.code == "allan.too_short"
