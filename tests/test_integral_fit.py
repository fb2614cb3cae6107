"""Truth recovered from records that other code made: values, intervals, noise, delay, and honest silence."""

from dataclasses import replace

import numpy as np
import pytest
from gyro_truth import STEP_DEG, Bench, Board, coloured, moves, recording, thesis

from calib_core.integral_fit import Fit, fit
from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.uncertainty import Budget

BIAS, SCALE = "bias_V", "scale_factor_V_per_dps"


def errors(boards: list[Board]) -> tuple[np.ndarray, list[Fit]]:
    """(boards, 2): scale factor in %, bias in mV; and the fits."""
    fits = [fit(board.recording, "x") for board in boards]
    rows = [
        (100.0 * (f.scale_factor / b.scale_factor - 1.0), 1e3 * (f.bias - b.bias))
        for f, b in zip(fits, boards, strict=True)
    ]
    return np.array(rows), fits


def test_thesis_simulation_locked_to_the_clock_over_twenty_seeds() -> None:
    error, fits = errors([thesis(seed) for seed in range(20)])
    assert np.abs(error[:, 0]).max() < 0.03
    assert np.abs(error[:, 1]).max() < 0.1
    assert np.mean([f.chi2 / f.rows for f in fits]) == pytest.approx(1.0, abs=0.05)
    assert np.mean([f.noise["white"] for f in fits]) == pytest.approx(0.0012, rel=0.1)


def test_bench_like_records_are_right_on_the_average_too() -> None:
    boards = [Bench().board(seed) for seed in range(12)]
    error, fits = errors(boards)
    rms, mean = np.sqrt(np.mean(error**2, axis=0)), np.abs(error.mean(axis=0))
    assert rms[0] < 0.02 / 2
    assert rms[1] < 0.1 / 4
    assert mean[0] < 0.02 / 3
    assert mean[1] < 0.1 / 3
    assert np.mean([f.chi2 / f.rows for f in fits]) == pytest.approx(1.0, abs=0.03)
    delays = np.array([(f.delay_s - 0.003) / f.delay_uncertainty_s for f in fits])
    assert np.sqrt(np.mean(delays**2)) < 1.5
    assert all(f.delay_uncertainty_s < 1e-4 for f in fits)


@pytest.mark.parametrize("coloured_V", [0.0, 0.0008])
def test_stated_intervals_hold_what_they_promise(coloured_V: float) -> None:
    boards = [Bench(seconds=40.0, coloured_V=coloured_V).board(100 + seed) for seed in range(24)]
    _, fits = errors(boards)
    for name, truth in ((SCALE, "scale_factor"), (BIAS, "bias")):
        off = [abs(f.values[name] - getattr(b, truth)) for f, b in zip(fits, boards, strict=True)]
        inside = sum(x < f.expanded_uncertainty(name) for x, f in zip(off, fits, strict=True))
        assert inside >= 20  # 95 % of 24; fewer comes up once in 167 campaigns
        z = np.array([x / f.standard_uncertainty(name) for x, f in zip(off, fits, strict=True)])
        assert 0.6 < np.sqrt(np.mean(z**2)) < 1.4, "neither too narrow nor too wide"


def test_noise_is_estimated_and_not_assumed() -> None:
    quiet = fit(Bench(noise_V=0.0006).board(1).recording, "x").noise
    loud = fit(Bench(noise_V=0.0024).board(1).recording, "x").noise
    assert quiet["white"] == pytest.approx(0.0006, rel=0.15)
    assert loud["white"] == pytest.approx(0.0024, rel=0.1)
    assert quiet["correlation_time_s"] is None
    board = Bench(coloured_V=0.0008, tau_s=0.3).board(2)
    found = fit(board.recording, "x")
    assert found.noise["ar1"] == pytest.approx(0.0008, rel=0.25)
    assert found.noise["correlation_time_s"] == pytest.approx(0.3, rel=0.5)
    assert found.noise["white_dps"] == pytest.approx(0.0012 / board.scale_factor, rel=0.1)
    assert found.dof[BIAS] < 200, "slow noise is known from few independent stretches"


def test_an_encoder_noisy_enough_to_bias_plain_least_squares_does_not_bias_the_fit() -> None:
    rng = np.random.default_rng(1)
    time = np.arange(6000) * 0.01
    turn = 2.0 * np.pi * 0.2513
    deviation = 3.0  # deg: the regressor's own error, a tenth of its amplitude
    off = []
    for _ in range(8):
        v = 1.25 + 0.005 * 30.0 * turn * np.cos(turn * time) + 0.0012 * rng.standard_normal(len(time))
        angle = 30.0 * np.sin(turn * time) + deviation * rng.standard_normal(len(time))
        f = fit(recording(time, {"x_gyro_v": v, "x_position_deg": angle}), "x")
        off.append((f.scale_factor - 0.005) / f.standard_uncertainty(SCALE))
    # Ordinary least squares of ∫V on the angle would be low by 2·(3/30)² = 2 %, many of these uncertainties.
    assert f.standard_uncertainty(SCALE) / 0.005 < 0.004
    assert abs(np.mean(off)) < 1.2


def test_reading_noise_before_the_code_is_recognised() -> None:
    error, fits = errors([Bench(reading_noise_deg=0.3 * STEP_DEG, seconds=60.0).board(seed) for seed in range(6)])
    z = error[:, 0] / [100.0 * f.standard_uncertainty(SCALE) / f.scale_factor for f in fits]
    assert np.sqrt(np.mean(z**2)) < 1.8
    assert np.mean([f.noise["white"] for f in fits]) == pytest.approx(0.0012, rel=0.15)


def test_rests_and_moves_recover_the_truth() -> None:
    error, fits = errors([moves(seed) for seed in range(6)])
    z = error / [[1e2 * f.standard_uncertainty(SCALE) / 0.0059, 1e3 * f.standard_uncertainty(BIAS)] for f in fits]
    assert np.sqrt(np.mean(z**2)) < 1.6
    assert np.abs(error[:, 0]).max() < 0.1


def test_gaps_masks_and_missing_cells_take_part_in_nothing() -> None:
    board = Bench(seconds=40.0).board(3)
    r = board.recording
    rng = np.random.default_rng(1)
    columns = {name: values.copy() for name, values in r.columns.items()}
    columns["x_gyro_v"][rng.random(len(r)) < 0.01] = np.nan
    gone = rng.random(len(r)) < 0.3
    columns["x_position_deg"][gone] = np.nan
    columns["valid"] = np.ones(len(r))
    columns["valid"][2000:2200] = 0.0
    columns["x_gyro_v"][2000:2200] = 9.9
    holed = replace(r, columns=columns)
    mask = np.ones(len(r), bool)
    mask[2500:2600] = False
    columns["x_gyro_v"][2500:2600] = -9.9
    f = fit(holed, "x", mask=mask)
    assert f.samples < len(r) - 300
    assert abs(f.scale_factor - board.scale_factor) < 4.0 * f.standard_uncertainty(SCALE)
    assert abs(f.bias - board.bias) < 4.0 * f.standard_uncertainty(BIAS)
    assert f.standard_uncertainty(SCALE) < 5e-4 * board.scale_factor


def test_a_mask_of_the_tail_is_the_recording_of_the_tail() -> None:
    r = Bench(seconds=20.0).board(5).recording
    mask = r.time_s > 5.0
    masked, taken = fit(r, "x", mask=mask), fit(r.take(mask), "x")
    assert masked.scale_factor == pytest.approx(taken.scale_factor, rel=1e-6)


def test_a_gyro_mounted_the_other_way_round_has_a_negative_scale_factor() -> None:
    board = Bench(seconds=20.0).board(4)
    columns = dict(board.recording.columns)
    columns["x_gyro_v"] = 2.0 * board.bias - columns["x_gyro_v"]
    f = fit(replace(board.recording, columns=columns), "x")
    assert f.scale_factor == pytest.approx(-board.scale_factor, rel=1e-3)
    assert f.delay_s == pytest.approx(0.003, abs=3e-4)
    assert (f.noise["white_dps"] or 0.0) > 0.0


def test_a_channel_that_is_sampled_later_by_its_header_shows_no_delay_of_its_own() -> None:
    board = Bench(seconds=40.0, delay_s=0.0).board(6)
    columns = {name.replace("x_", "z_"): values for name, values in board.recording.columns.items()}
    earlier = 0.005
    columns["z_position_time_s"] = columns["z_position_time_s"] + earlier
    header = {"gyro_average_s": "0.01", "z_gyro_delay_s": str(earlier)}
    f = fit(replace(board.recording, columns=columns, header=header), "z")
    assert f.delay_s == pytest.approx(0.0, abs=4.0 * f.delay_uncertainty_s)
    assert f.scale_factor == pytest.approx(board.scale_factor, rel=1e-3)


@pytest.mark.parametrize(("column", "suffix"), [("x_gyro_dps", "dps"), ("x_gyro_counts", "counts")])
def test_names_carry_the_recordings_unit(column: str, suffix: str) -> None:
    board = Bench(seconds=10.0).board(7)
    factor = 1.0 / board.scale_factor
    columns = {name: values for name, values in board.recording.columns.items() if name != "x_gyro_v"}
    columns[column] = (board.recording.columns["x_gyro_v"] - board.bias) * factor + 0.5
    f = fit(replace(board.recording, columns=columns), "x")
    assert f.names == (f"bias_{suffix}", f"scale_factor_{suffix}_per_dps")
    assert f.values[f.names[0]] == pytest.approx(0.5, abs=0.05)
    assert f.scale_factor == pytest.approx(1.0, abs=3e-3)


def test_a_reference_rate_takes_the_same_entrance() -> None:
    rng = np.random.default_rng(1)
    time = np.arange(5000) * 0.01
    turn = 2.0 * np.pi * 0.31

    def rate(at: np.ndarray) -> np.ndarray:
        return np.asarray(30.0 * np.cos(turn * at))

    v = 1.25 + 0.005 * rate(time - 0.004) + 0.0012 * rng.standard_normal(len(time))
    f = fit(recording(time, {"x_gyro_v": v, "x_rate_dps": rate(time)}), "x")
    assert f.delay_s == pytest.approx(0.004, abs=4.0 * f.delay_uncertainty_s)
    assert abs(f.scale_factor - 0.005) < 4.0 * f.standard_uncertainty(SCALE)
    assert abs(f.bias - 1.25) < 4.0 * f.standard_uncertainty(BIAS)
    assert f.standard_uncertainty(BIAS) == pytest.approx(0.0012 / np.sqrt(len(time)), rel=0.05)


def test_a_stationary_record_gives_a_bias_whose_interval_knows_of_slow_noise() -> None:
    time = np.arange(6000) * 0.01
    inside = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        v = 0.7 + 0.1 * rng.standard_normal(len(time)) + coloured(len(time), 0.01, 0.05, 0.4, rng)
        f = fit(recording(time, {"x_gyro_dps": v}, {"reference": "stationary"}), "x")
        assert f.names == ("bias_dps",)
        assert np.isnan(f.delay_s)
        assert np.isnan(f.scale_factor)
        inside += abs(f.bias - 0.7) < f.expanded_uncertainty("bias_dps")
    assert inside >= 16


def test_a_table_that_never_turned_gives_a_bias_and_says_so() -> None:
    board = Bench(seconds=0.0, rest_s=5.0).board(8)
    f = fit(board.recording, "x")
    assert f.names == (BIAS,)
    assert [w["code"] for w in f.warnings] == ["fit.nothing_moved"]
    assert abs(f.bias - board.bias) < 4.0 * f.standard_uncertainty(BIAS)


def test_no_reference_and_too_few_samples_are_refused() -> None:
    time = np.arange(300) * 0.01
    bare = recording(time, {"x_gyro_v": 1.25 + 0.001 * np.sin(time)})
    with pytest.raises(Problem, match=r"fit\.no_reference"):
        fit(bare, "x")
    with pytest.raises(Problem, match=r"fit\.too_short"):
        fit(bare, "x", mask=time < 0.05)
    all_nan = recording(time, {"x_gyro_v": np.full(300, np.nan), "x_position_deg": np.zeros(300)})
    with pytest.raises(Problem, match=r"fit\.too_short"):
        fit(all_nan, "x")


def test_a_stuck_channel_is_refused_and_a_deaf_one_has_no_scale_factor_to_speak_of() -> None:
    r = Bench(seconds=10.0).board(9).recording
    stuck = replace(r, columns={**r.columns, "x_gyro_v": np.full(len(r), 1.25)})
    with pytest.raises(Problem, match=r"fit\.stuck"):
        fit(stuck, "x")
    hum = 1.4 + 0.0012 * np.random.default_rng(1).standard_normal(len(r))
    f = fit(replace(r, columns={**r.columns, "x_gyro_v": hum}), "x")
    assert f.bias == pytest.approx(1.4, abs=1e-3)
    assert abs(f.scale_factor) < 5.0 * f.standard_uncertainty(SCALE) + 1e-5


def test_the_fit_is_the_same_each_time() -> None:
    r: Recording = Bench(seconds=10.0).board(10).recording
    assert fit(r, "x").values == fit(r, "x").values


def test_the_fits_part_of_a_budget_adds_up_to_the_fit() -> None:
    f = fit(Bench(seconds=40.0).board(11).recording, "x")
    for name in f.names:
        budget = Budget(f.values[name], f.contributions(name))
        assert [c.name for c in budget.contributions] == ["gyro_noise", "encoder_step"]
        assert budget.standard_uncertainty == pytest.approx(f.standard_uncertainty(name))
        assert budget.dof == pytest.approx(f.dof[name])
    loud = fit(Bench(seconds=40.0, noise_V=0.012).board(11).recording, "x")
    assert loud.encoder_share[SCALE] < 0.3 * f.encoder_share[SCALE]
    assert 0.01 < f.encoder_share[SCALE] < 0.5


def test_a_bias_that_wanders_is_pointed_out() -> None:
    time = np.arange(12_000) * 0.01
    rng = np.random.default_rng(1)
    v = 0.7 + 0.1 * rng.standard_normal(len(time)) + 0.004 * np.cumsum(rng.standard_normal(len(time)))
    f = fit(recording(time, {"x_gyro_dps": v}, {"reference": "stationary"}), "x")
    assert [w["code"] for w in f.warnings] == ["fit.wandering_bias"]


@pytest.mark.parametrize("step_deg", [0.003, 0.0003])
def test_a_fine_encoder_tells_the_delay_although_the_gyro_is_noisy(step_deg: float) -> None:
    bench = Bench(seconds=40.0, step_deg=step_deg)
    for seed in range(3):
        f = fit(bench.board(seed).recording, "x")
        assert f.delay_s == pytest.approx(0.003, abs=max(4.0 * f.delay_uncertainty_s, 2e-5))
        assert f.delay_uncertainty_s < 2e-4


def test_slow_noise_keeps_its_correlation_time_when_codes_are_read_as_intervals() -> None:
    fits = [fit(Bench(coloured_V=0.0008, tau_s=0.5).board(200 + seed).recording, "x") for seed in range(5)]
    assert np.mean([f.noise["correlation_time_s"] for f in fits]) == pytest.approx(0.5, rel=0.2)
    assert np.mean([f.noise["ar1"] for f in fits]) == pytest.approx(0.0008, rel=0.1)
