"""Rate readings out of a recording."""

import time

import numpy as np
import pytest
from bench_recording import BIAS, SCALE, STEP, position_moves, rate_moves, record

from calib_core import position_test, rate_test
from calib_core.recording import Recording

RATES = (-100, -80, -60, -40, -20, -10, 10, 20, 40, 60, 80, 100)


@pytest.fixture(scope="module")
def session() -> Recording:
    return record(rate_moves(RATES, 3) + rate_moves((20, 60, 100, -20, -60, -100), 8, "repeat"))


def without(recording: Recording, rows: np.ndarray, column: str) -> Recording:
    values = np.where(rows, np.nan, recording.columns[column])
    return Recording(
        recording.time_s,
        {**recording.columns, column: values},
        recording.segment_codes,
        recording.segment_names,
        recording.header,
    )


def test_gyro_and_encoder_agree_within_their_noise(session: Recording) -> None:
    found = rate_test.readings(session, "x", BIAS, SCALE)
    assert len(found.points) == 12 * 3 + 6 * 8
    assert not found.warnings
    error = found.points.gyro - found.points.reference
    # 1.2 mV at 100 Hz over 1.6 s is 0.016 deg/s, the encoder's slope about as much.
    assert np.sqrt(np.mean(error**2)) < 0.04
    assert abs(error.mean()) < 0.01
    assert np.sqrt(np.mean(error**2)) < 1.5 * np.hypot(0.016, found.reference_u.max())


def test_the_reference_is_the_constant_rate_without_run_up_and_stop(session: Recording) -> None:
    points = rate_test.points(session, "x", BIAS, SCALE)
    assert np.abs(points.reference - points.set_point).max() < 0.1
    assert points.duration_s.min() > 1.3


def test_a_cubic_gyro_shows_its_cubic() -> None:
    cubic = 4e-6
    bent = record(rate_moves(RATES, 3), truth=lambda rate: BIAS + SCALE * (rate + cubic * rate**3))
    result = rate_test.run(bent, "x", bias=BIAS, scale_factor=SCALE)
    assert result.linearity is not None
    x = np.array(RATES, float)
    expected = x + cubic * x**3
    expected -= np.polyval(np.polyfit(x, expected, 1), x)
    assert np.abs(result.linearity.line.residual - np.array(expected)).max() < 0.06


@pytest.mark.parametrize("rate", [29.3255, 29.35, 58.651, 14.7, 97.75])
def test_a_rate_locked_to_the_encoders_step_is_still_measured(rate: float) -> None:
    """At one code a reading the quantisation does not average; the stated uncertainty need not cover that fully."""
    found = rate_test.readings(record(rate_moves((rate, -rate), 6)), "x", BIAS, SCALE)
    assert np.abs(found.points.gyro - found.points.reference).max() < 0.15


def test_the_thesis_profile_steps_as_the_thesis_does(session: Recording) -> None:
    found = rate_test.readings(session, "x", BIAS, SCALE, "thesis")
    assert len(found.points) == 12 * 3 + 6 * 8
    for at in (20.0, -60.0, 100.0):
        same = (found.points.set_point == at) & (found.points.test == "repeat")
        assert len(set(found.points.reference[same])) == 1
    error = found.points.gyro - found.points.reference
    assert 0.3 < np.std(error) < 1.5
    assert found.reference_u.max() == pytest.approx(STEP / 0.1 / 6**0.5, rel=1e-3)


def test_a_delayed_channel_is_compared_with_its_own_past() -> None:
    """The second channel is sampled later; at constant rate that must not matter, at the ends it would."""
    recording = record(rate_moves((60, -60), 4), header={"x_gyro_delay_s": "0.0001"})
    error = rate_test.points(recording, "x", BIAS, SCALE)
    assert np.abs(error.gyro - error.reference).max() < 0.08


def test_a_stalled_stroke_is_told_and_left_out(session: Recording) -> None:
    run = next(run for run in session.runs() if run.name == "rate_x/linearity/+60/2")
    columns = dict(session.columns)
    stuck = columns["x_position_deg"].copy()
    stuck[run.rows] = stuck[run.start]
    columns["x_position_deg"] = stuck
    stalled = Recording(session.time_s, columns, session.segment_codes, session.segment_names)
    found = rate_test.readings(stalled, "x", BIAS, SCALE)
    assert len(found.points) == 12 * 3 + 6 * 8 - 1
    (warning,) = found.warnings
    assert warning["code"] == "rate_test.no_constant_rate"
    assert warning["values"] | {"set_point": 60.0, "reading": 2} == warning["values"]
    said = [w["code"] for w in rate_test.run(stalled, "x", bias=BIAS, scale_factor=SCALE).warnings]
    assert said == ["rate_test.no_constant_rate", "test.readings_missing"]


def test_a_slow_servo_is_told_and_measured_against_the_encoder() -> None:
    moves = [
        ("move", 0.0, -54.0, 120.0, 0.0, 0.3),
        ("rate_x/linearity/+60/1", -54.0, 54.0, 45.0, 0.0, 0.4),
        ("move", 54.0, 0.0, 120.0, 0.0, 0.3),
    ]
    found = rate_test.readings(record(moves), "x", BIAS, SCALE)
    assert [w["code"] for w in found.warnings] == ["rate_test.off_speed"]
    assert found.points.reference[0] == pytest.approx(45.0, abs=0.1)
    assert found.points.gyro[0] == pytest.approx(found.points.reference[0], abs=0.1)


def test_missing_gyro_samples_are_told_not_bridged(session: Recording) -> None:
    run = next(run for run in session.runs() if run.name == "rate_x/repeat/+100/3")
    rows = np.zeros(len(session), bool)
    rows[run.start + 60 : run.start + 80] = True
    found = rate_test.readings(without(session, rows, "x_gyro_v"), "x", BIAS, SCALE)
    assert [w["code"] for w in found.warnings] == ["test.gyro_missing"]
    assert len(found.points) == 12 * 3 + 6 * 8 - 1


@pytest.mark.parametrize("profile", ["standard", "thesis"])
def test_a_recording_without_strokes_or_without_an_encoder_is_no_crash(profile: str) -> None:
    rest = record([("rest", 0.0, 0.0, 1.0, 1.0, 2.0)])
    assert len(rate_test.points(rest, "x", BIAS, SCALE, profile)) == 0
    result = rate_test.run(rest, "x", bias=BIAS, scale_factor=SCALE, profile=profile)
    assert [w["code"] for w in result.warnings] == ["test.set_points_missing"] * 2
    blind = record(rate_moves((60,), 1))
    blind = without(blind, np.ones(len(blind), bool), "x_position_deg")
    found = rate_test.readings(blind, "x", BIAS, SCALE, profile)
    assert [w["code"] for w in found.warnings] == ["test.no_encoder"]


def test_a_reading_taken_twice_counts_once() -> None:
    twice = record(rate_moves((60, -60), 1) * 2)
    found = rate_test.readings(twice, "x", BIAS, SCALE)
    assert len(found.points) == 2
    assert [w["code"] for w in found.warnings] == ["test.reading_repeated"] * 2


def test_one_stroke_alone_gives_the_same_reading(session: Recording) -> None:
    """The live page measures each stroke as it comes."""
    run = next(run for run in session.runs() if run.name == "rate_x/repeat/-60/5")
    alone = rate_test.points(session.take(run.rows), "x", BIAS, SCALE)
    every = rate_test.points(session, "x", BIAS, SCALE)
    same = (every.test == "repeat") & (every.set_point == -60) & (every.reading == 5)
    assert alone.gyro[0] == pytest.approx(every.gyro[same][0], abs=2e-3)
    assert alone.reference[0] == every.reference[same][0]


def test_scaled_ranges_expect_scaled_set_points() -> None:
    assert rate_test.expected("standard", 50.0)["repeat"] == [5.0, 15.0, 25.0, -5.0, -15.0, -25.0]


def test_type_b_grows_with_what_compensates(session: Recording) -> None:
    plain = rate_test.run(session, "x", bias=BIAS, scale_factor=SCALE)
    loose = rate_test.run(session, "x", bias=BIAS, scale_factor=SCALE, bias_u=1e-3, scale_factor_u=SCALE * 1e-3)
    assert loose.type_b == pytest.approx(np.sqrt(plain.type_b**2 + (1e-3 / SCALE) ** 2 + 0.1**2), rel=1e-2)


def test_an_axis_of_a_whole_session_is_tested_within_its_budget() -> None:
    """168 strokes and 248 moves; 0.075 s is half of the 0.15 s allowed for both axes."""
    moves = [
        *rate_moves(RATES, 3),
        *rate_moves((20, 60, 100, -20, -60, -100), 22, "repeat"),
        *position_moves([angle for angle in range(-120, 121, 10) if angle], 3),
        *position_moves((30, 60, 90, 120, -120, -90, -60, -30), 22, "repeat"),
    ]
    whole = record(moves)
    took = []
    for _ in range(4):
        before = time.process_time()
        rates = rate_test.run(whole, "x", bias=BIAS, scale_factor=SCALE)
        angles = position_test.run(whole, "x", bias=BIAS, scale_factor=SCALE)
        took.append(time.process_time() - before)
        assert not rates.warnings
        assert not angles.warnings
    assert min(took) < 0.075
