"""What effects depend on, as a recording tells it: direction at reversals, slow covariates, motion through gaps."""

import numpy as np
import pytest

from calib_core import covariates
from calib_core.integral_fit import Design
from calib_core.recording import Recording


def test_after_a_rest_the_reversal_is_where_motion_began_and_not_where_noise_crossed_zero() -> None:
    rest = 0.1 * np.random.default_rng(3).standard_normal(80)
    rest[-12:] = -np.abs(rest[-12:])
    rate = np.concatenate([np.full(100, 30.0), rest, np.linspace(-6.0, -30.0, 5), np.full(100, -30.0)])
    found = covariates.direction(rate)
    assert np.all(found[:179] == 1.0)
    assert np.all(found[180:] == -1.0)


def test_where_the_table_mostly_rests_noise_beside_a_rest_is_no_motion() -> None:
    rng = np.random.default_rng(5)
    rate = np.zeros(2000)
    rate[100:150], rate[1000:1050] = 20.0, 20.0
    noise = 0.2 * np.convolve(rng.standard_normal(2000), np.full(3, 1 / 3), mode="same")
    near = (np.arange(2000) % 200) < 60
    found = covariates.direction(rate + np.where(near, noise, 0.0))
    assert np.all(found[100:] == 1.0)


def test_a_reversal_in_motion_is_where_the_rate_passed_zero() -> None:
    time = np.arange(0.0, 8.0, 0.01)
    found = covariates.direction(40.0 * np.cos(2.0 * np.pi * 0.25 * time))
    flips = time[1:][np.diff(found > 0.0)]
    assert flips == pytest.approx([1.0, 3.0, 5.0, 7.0], abs=0.015)


def _recording(left_out: slice | None = None) -> Recording:
    """A sine of 30 deg at 0.25 Hz read in codes, beside a supply that swings by 15 mV every 7 s."""
    time = np.arange(0.0, 40.0, 0.01)
    angle = 30.0 * np.sin(2.0 * np.pi * 0.2513 * time)
    rate = np.gradient(angle, 0.01)
    rng = np.random.default_rng(4)
    columns = {
        "x_gyro_v": 1.25 + 0.0059 * rate + rng.normal(0.0, 1.2e-3, len(time)),
        "x_position_deg": np.round(angle / 0.2933) * 0.2933,
        "supply_v": 3.0 + 0.015 * np.sin(2.0 * np.pi * time / 7.0) + rng.normal(0.0, 1e-3, len(time)),
    }
    if left_out is not None:
        columns["x_gyro_v"][left_out] = np.nan
    return Recording(time, columns, np.zeros(len(time), np.int32), ("",), {})


def test_a_slow_swing_of_the_supply_keeps_its_size() -> None:
    recording = _recording()
    found = covariates.of(recording, "x", Design.of(recording, "x"), 1.25, 0.0059)
    swing = np.sin(2.0 * np.pi * found.time_s / 7.0)
    assert found.supply_v is not None
    assert 2.0 * np.mean((found.supply_v - 3.0) * swing) == pytest.approx(0.015, rel=0.02)


def test_motion_goes_on_through_a_gap_that_is_left_out() -> None:
    recording = _recording(slice(2000, 2060))
    found = covariates.of(recording, "x", Design.of(recording, "x"), 1.25, 0.0059)
    truth = 30.0 * np.sin(2.0 * np.pi * 0.2513 * found.time_s)
    near = np.abs(found.time_s - 20.3) < 1.0
    assert np.abs(found.position_deg - truth)[near].max() < 0.3
    assert np.abs(found.rate_dps - np.gradient(truth, found.time_s))[near].max() < 3.0
