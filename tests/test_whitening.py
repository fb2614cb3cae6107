"""The banded whitener does what dense algebra does, and rows mean what they say."""

from dataclasses import replace

import numpy as np
import pytest
from gyro_truth import STEP_DEG, Bench, moves, recording
from numpy.typing import NDArray

from calib_core import encoder_noise
from calib_core.integral_fit import Design
from calib_core.whitening import RowNoise, Rows, Whitener

F64 = NDArray[np.float64]
SCALE_FACTOR = 0.0059


def dense_covariance(rows: Rows, noise: RowNoise) -> F64:
    """Σ entry by entry, from its definition."""
    n = len(rows)
    sigma = np.diag(noise.white**2 * rows.white_own)
    for j in range(n - 1):
        sigma[j, j + 1] = sigma[j + 1, j] = noise.white**2 * rows.white_next[j]
    errors = np.zeros((n, len(rows.reading_variance)))
    for j in np.flatnonzero(rows.after >= 0):
        errors[j, rows.before[j]] += SCALE_FACTOR / rows.dt_s[j]
        errors[j, rows.after[j]] -= SCALE_FACTOR / rows.dt_s[j]
    sigma += errors @ np.diag(rows.reading_variance + noise.reading_deg**2) @ errors.T
    together = np.cumsum(rows.start)
    lag = np.abs(rows.time_s[:, None] - rows.time_s)
    together = together[:, None] == together
    return np.asarray(sigma + noise.ar1**2 * np.exp(-lag / noise.correlation_time_s) * together)


NOISES = {
    "white": RowNoise(0.0012),
    "coloured": RowNoise(0.0012, 0.0008, 0.3),
    "loud readings": RowNoise(0.0012, reading_deg=0.2),
    "slow and loud": RowNoise(0.008, 0.1, 5.0),
}


@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES)
@pytest.mark.parametrize("interrupted", [False, True])
def test_whitening_equals_dense_algebra_with_rests_and_gaps(noise: RowNoise, interrupted: bool) -> None:
    mask = np.ones(len(moves(1, n=4).recording), bool)
    if interrupted:
        mask[260:275] = False
    rows = Design.of(moves(1, n=4).recording, "x", mask).rows
    assert rows.start.sum() == 1 + interrupted
    assert (np.diff(np.flatnonzero(rows.after < 0)) > 1).sum() >= 3, "there are rests between moves"
    sigma = dense_covariance(rows, noise)
    whitener = Whitener(rows, SCALE_FACTOR, noise)
    columns = np.random.default_rng(2).standard_normal((len(rows), 3))
    white = whitener.whiten(columns)
    solved = np.linalg.solve(sigma, columns)
    np.testing.assert_allclose(white.T @ white, columns.T @ solved, rtol=1e-7)
    np.testing.assert_allclose(whitener.whiten(columns[:, 0]), white[:, 0], rtol=1e-9, atol=1e-9)
    pulled = whitener.precision_times(white[:, 0])
    np.testing.assert_allclose(pulled, solved[:, 0], atol=1e-6 * np.abs(solved[:, 0]).max())
    assert whitener.log_determinant == pytest.approx(np.linalg.slogdet(sigma)[1], rel=1e-9)


def test_readings_errors_and_rows_are_adjoint() -> None:
    rows = Design.of(moves(3, n=3).recording, "x").rows
    rng = np.random.default_rng(1)
    errors, weights = rng.standard_normal(len(rows.reading_variance)), rng.standard_normal(len(rows))
    seen = np.zeros(len(rows))
    moving = rows.after >= 0
    seen[moving] = (errors[rows.before[moving]] - errors[rows.after[moving]]) / rows.dt_s[moving]
    assert errors @ rows.to_readings(weights) == pytest.approx(seen @ weights)


def test_a_part_of_the_rows_carries_nothing_over_what_was_left_out() -> None:
    rows = Design.of(moves(1, n=3).recording, "x").rows
    chosen = np.r_[20:90, 130:200]
    part = rows.take(chosen)
    assert np.flatnonzero(part.start).tolist() == [0, 70]
    noise = NOISES["coloured"]
    sigma = dense_covariance(part, noise)
    white = Whitener(part, SCALE_FACTOR, noise).whiten(np.eye(len(part)))
    np.testing.assert_allclose(white.T @ white @ sigma, np.eye(len(part)), atol=1e-6)


def test_integrals_keep_a_fast_sine_that_the_trapezoid_rule_would_bend() -> None:
    bench = Bench(frequency_hz=4.0313, seconds=5.0, delay_s=0.0)
    board = bench.board(1)
    averages = Design.of(board.recording, "x").averages
    turn = 2.0 * np.pi * 4.0
    sine = turn * np.cos(turn * averages.samples.time_s)
    inside = averages.at < 0
    begin, end = averages.begin_s[inside], averages.end_s[inside]
    exact = (np.sin(turn * end) - np.sin(turn * begin)) / (end - begin)
    error = np.abs(averages.mean(sine)[inside] - exact)[5:-5]
    assert error.max() < 1e-3 * turn
    both = averages.mean(np.stack([sine, np.ones(len(sine))], axis=1))
    np.testing.assert_allclose(both[inside, 0][5:-5], exact[5:-5], atol=1e-3 * turn)
    np.testing.assert_allclose(both[:, 1], 1.0, rtol=1e-12)
    slope = (turn * np.cos(turn * end) - turn * np.cos(turn * begin)) / (end - begin)
    assert np.abs((averages.change(sine)[inside] - slope) * (end - begin))[5:-5].max() < 0.02 * turn


def test_samples_that_are_means_get_back_what_the_mean_took() -> None:
    time = np.arange(800) * 0.01
    turn = 2.0 * np.pi * 4.0
    mean_of_ten_ms = np.cos(turn * time) * turn * np.sinc(turn * 0.01 / 2.0 / np.pi)
    angle = np.sin(turn * time)
    columns = {"x_gyro_v": mean_of_ten_ms, "x_position_deg": angle}
    for header, worst in (({"gyro_average_s": "0.01"}, 5e-4), ({}, 5e-3)):
        design = Design.of(recording(time, columns, header), "x")
        error = np.abs(design.averages.output(0.0)[0] - design.rate)[5:-5].max() / turn
        assert error < worst
    assert error > 5e-4, "without the header's word the loss shows"


def test_encoder_step_is_found_and_printed_digits_are_not_taken_for_one() -> None:
    smooth = np.round(30.0 * np.sin(np.arange(2000) * 0.0157), 4)
    codes = np.round(np.round(smooth / STEP_DEG) * STEP_DEG, 4)
    assert encoder_noise.step_of(codes) == pytest.approx(STEP_DEG, rel=1e-5)
    printed = np.array([float(f"{angle:.3g}" if abs(angle) < 1.0 else f"{angle:.4g}") for angle in codes])
    assert encoder_noise.step_of(printed) == pytest.approx(STEP_DEG, rel=1e-4)
    assert encoder_noise.step_of(smooth) == 0.0
    assert encoder_noise.step_of(np.full(50, 3.2)) == 0.0


def test_a_rest_is_one_reading_and_slow_motion_is_no_rest() -> None:
    time = np.arange(1000) * 0.01
    stop = np.where(time < 3.0, 20.0 * time, np.where(time < 6.0, 60.0, 60.0 + 20.0 * (time - 6.0)))
    readings = encoder_noise.inspect(time, np.round(stop / STEP_DEG) * STEP_DEG)
    resting = readings.rest >= 0
    assert resting[330:580].all()
    assert not resting[:300].any()
    assert not resting[605:].any()
    assert len(set(readings.rest[resting].tolist())) == 1
    crawl = encoder_noise.inspect(time, np.round(0.5 * time / STEP_DEG) * STEP_DEG)
    assert (crawl.rest[100:-100] < 0).all(), "0.5 deg/s stays 0.59 s on each code, and moves all the same"


def test_motion_locked_to_the_clock_is_seen_to_repeat_its_codes() -> None:
    time = np.arange(10_000) * 0.01

    def median_recurrence(frequency_hz: float) -> float:
        angle = 30.0 * np.sin(2.0 * np.pi * frequency_hz * time + 0.3)
        return float(np.median(encoder_noise.inspect(time, np.round(angle / STEP_DEG) * STEP_DEG).recurrence))

    assert median_recurrence(0.25) == 25
    assert median_recurrence(0.2513) <= 2


def test_rows_of_a_rest_do_not_depend_on_where_the_whitener_puts_them() -> None:
    rows = Design.of(moves(2, n=3).recording, "x").rows
    column = np.random.default_rng(3).standard_normal(len(rows))
    white = Whitener(rows, SCALE_FACTOR, NOISES["white"]).whiten(column)
    # An AR(1) part too small to matter takes the other path, where rows stay in time order.
    also = Whitener(rows, SCALE_FACTOR, replace(NOISES["white"], ar1=1e-9)).whiten(column)
    assert white @ white == pytest.approx(also @ also, rel=1e-6)
