"""METHOD 1's MIT rule: where the encoder's rate comes from decides the answer, and the simulation of thesis 4.2."""

import numpy as np
import pytest

from calib_core.adaptation import (
    GAMMA_1,
    Adapter,
    Form,
    adapt,
    adapt_many,
    compensate,
    encoder_rate,
    estimate,
)
from calib_core.kalman import F64, filter_record, tuning
from calib_core.problem import Problem

DT, STEP_DEG = 0.01, 300 / 1023
BIAS, SCALE = 1.25, 0.005
T = np.arange(10_000) * DT


def angle(time_s: F64, frequency_hz: float) -> F64:
    """The encoder's codes of the thesis' sine, ±30 deg."""
    return np.asarray(np.round(30 * np.sin(2 * np.pi * frequency_hz * time_s) / STEP_DEG) * STEP_DEG)


def output(seed: int, frequency_hz: float) -> F64:
    """Thesis 4.2: S 0.005 V/(deg/s), bias 1.25 V, 1.2 mV of white noise, 100 s at 100 Hz."""
    rate = 30 * 2 * np.pi * frequency_hz * np.cos(2 * np.pi * frequency_hz * T)
    return np.asarray(BIAS + SCALE * rate + np.random.default_rng(seed).normal(0.0, 1.2e-3, len(T)))


@pytest.mark.parametrize("frequency_hz", [0.25, 0.2513])
@pytest.mark.parametrize("jitter_s", [0.0, 0.003])
def test_matched_estimate_is_within_half_a_percent_and_a_millivolt(frequency_hz: float, jitter_s: float) -> None:
    for seed in range(20):
        rng = np.random.default_rng([seed, 1])
        read_at = T + (0.004 + rng.uniform(-jitter_s, jitter_s, len(T)) if jitter_s else 0.0)
        found = estimate(
            T, output(seed, frequency_hz), read_at, angle(read_at, frequency_hz),
            frequency_hz=frequency_hz, start=(1.23, 0.0083),
        )  # fmt: skip
        assert found.scale_factor_V_per_dps == pytest.approx(SCALE, rel=0.001)  # the bar is 0.005
        assert found.bias_V == pytest.approx(BIAS, abs=1e-4)  # the bar is 1e-3


# Error of the scale factor in %, METHOD 1. Where only the gyro is filtered the two differ by 0.3 and 0.5: this filter
# raises 0.25 Hz by 2.2 % (2.6 % before the update), METHOD's by 2.7 to 2.9 %, and its discrete form is not told.
@pytest.mark.parametrize(
    ("span_s", "filters", "printed_pct", "tolerance"),
    [
        (0.01, "none", -13.5, 0.1),
        (0.01, "gyro", -11.2, 0.4),
        (0.01, "both", -0.3, 0.1),
        (0.1, "none", -2.2, 0.1),
        (0.1, "gyro", +0.6, 0.6),
        (0.1, "both", -2.1, 0.1),
    ],
)
def test_source_of_the_rate_decides_the_answer_as_simulated(
    span_s: float, filters: str, printed_pct: float, tolerance: float
) -> None:
    gain = tuning(1.2e-3**2 * DT)
    rate = encoder_rate(T, angle(T, 0.25), T, span_s, held=True)
    first = int(np.sum(np.isnan(rate)))
    rate, v = rate[first:], output(7, 0.25)[first:]
    if filters != "none":
        v = filter_record(v, DT, gain)
    if filters == "both":
        rate = filter_record(rate, DT, gain)
    gamma2 = GAMMA_1 / np.mean(rate**2)
    _, scales = adapt(v, rate, DT, gamma1=GAMMA_1, gamma2=gamma2, bias=1.2, scale_factor=0.0)
    assert 100 * (np.mean(scales[-8000:]) / SCALE - 1) == pytest.approx(printed_pct, abs=tolerance)


def test_thesis_form_is_the_unmatched_one() -> None:
    found = estimate(T, output(7, 0.25), T, angle(T, 0.25), form="thesis", frequency_hz=0.25)
    assert 100 * (found.scale_factor_V_per_dps / SCALE - 1) == pytest.approx(0.15, abs=0.1)
    assert found.bias_V == pytest.approx(BIAS, abs=1e-4)


def test_held_differences_step_by_the_encoder_step_over_their_span() -> None:
    rate = encoder_rate(T, angle(T, 0.25), T, 0.1, held=True)
    assert np.isnan(rate[:10]).all()
    codes = rate[10:] / (STEP_DEG / 0.1)
    np.testing.assert_allclose(codes, np.round(codes), atol=1e-9)


def test_rates_add_up_to_the_angle_that_was_read_whatever_the_jitter() -> None:
    read_at = np.sort(T + np.random.default_rng(1).uniform(-0.004, 0.004, len(T)))
    read = angle(read_at, 0.2513)
    rows = T[10:-10]
    total = np.sum(encoder_rate(read_at, read, rows, DT)) * DT
    ends = np.interp([rows[0] - DT / 2, rows[-1] + DT / 2], read_at, read)
    assert total == pytest.approx(ends[1] - ends[0], abs=1e-9)


@pytest.mark.parametrize("held", [False, True])
def test_no_rate_where_the_encoder_was_not_read(held: bool) -> None:
    kept = (T > 1.0) & (T < 90.0) & ~((T > 40.0) & (T < 40.5))
    rate = encoder_rate(T[kept], 5.0 * T[kept], T, 0.02, held=held)
    missing = np.isnan(rate)
    assert missing[T < 1.0].all()
    assert missing[T > 90.2].all()
    assert missing[(T > 40.05) & (T < 40.45)].all()
    np.testing.assert_allclose(rate[~missing], 5.0)
    assert missing.sum() < 100 + 1000 + 60


def test_no_readings_give_no_rate() -> None:
    assert np.isnan(encoder_rate(np.empty(0), np.empty(0), T[:5], DT)).all()


@pytest.mark.parametrize("form", ["matched", "thesis"])
def test_gaps_in_rows_and_samples_do_not_move_the_estimate(form: Form) -> None:
    v = output(3, 0.25)
    whole = estimate(T, v, T, angle(T, 0.25), form=form, frequency_hz=0.25)
    v[5000:5030] = np.nan
    rows = np.delete(np.arange(len(T)), slice(7000, 7040))
    part = estimate(T[rows], v[rows], T[rows], angle(T, 0.25)[rows], form=form, frequency_hz=0.25)
    assert len(part.bias_trace) == len(whole.bias_trace)
    assert part.scale_factor_V_per_dps == pytest.approx(whole.scale_factor_V_per_dps, rel=1e-3)


def test_trace_comes_in_blocks_as_it_comes_at_once() -> None:
    rng = np.random.default_rng(1)
    v, rate = 1.25 + rng.normal(0, 0.2, 5000), rng.normal(0, 40, 5000)
    v[[0, 77]] = rate[[99, 4999]] = np.nan
    stream = Adapter(0.3, 2e-4, DT, 1.2, 0.0)
    parts = [stream.update(v[k : k + 33], rate[k : k + 33]) for k in range(0, 5000, 33)]
    whole = adapt(v, rate, DT, gamma1=0.3, gamma2=2e-4, bias=1.2, scale_factor=0.0)
    np.testing.assert_allclose(np.concatenate(parts, axis=1), whole, rtol=0, atol=1e-13)


def test_many_boards_give_each_board_s_own_answer() -> None:
    rng = np.random.default_rng(2)
    v, rate = rng.normal(1.25, 0.2, (2000, 7)), rng.normal(0, 40, (2000, 7))
    gamma2, bias, scale = rng.uniform(1e-4, 3e-4, 7), rng.uniform(1.2, 1.3, 7), rng.uniform(0, 0.01, 7)
    many = adapt_many(v, rate, DT, gamma1=0.3, gamma2=gamma2, bias=bias, scale_factor=scale, first=500)
    for k in range(7):
        one = adapt(v[:, k], rate[:, k], DT, gamma1=0.3, gamma2=gamma2[k], bias=bias[k], scale_factor=scale[k])
        np.testing.assert_allclose([many[0][k], many[1][k]], np.mean(np.array(one)[:, 500:], axis=1), rtol=1e-12)


def test_compensation_undoes_the_model() -> None:
    rate = np.array([-100.0, 0.0, 47.1])
    np.testing.assert_allclose(compensate(SCALE * rate + BIAS, BIAS, SCALE), rate, atol=1e-12)


def test_too_short_a_record_and_a_table_that_stands_still_are_refused() -> None:
    with pytest.raises(Problem) as refused:
        estimate(T[:1500], output(1, 0.25)[:1500], T, angle(T, 0.25), frequency_hz=0.25)
    assert refused.value.code == "adaptation.too_short"
    for read in (np.zeros_like(T), np.full_like(T, np.nan)):
        with pytest.raises(Problem) as refused:
            estimate(T, output(1, 0.25), T, read)
        assert refused.value.code == "adaptation.no_motion"
