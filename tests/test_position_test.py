"""Position readings out of a recording."""

import numpy as np
import pytest
from bench_recording import BIAS, SCALE, STEP, position_moves, record

from calib_core import position_test
from calib_core.recording import Recording

ANGLES = (-120, -90, -60, -30, -10, 10, 30, 60, 90, 120)


@pytest.fixture(scope="module")
def session() -> Recording:
    return record(position_moves(ANGLES, 3) + position_moves((30, 120, -120, -30), 8, "repeat"))


def test_gyro_and_encoder_agree_within_noise_and_one_step(session: Recording) -> None:
    found = position_test.readings(session, "x", BIAS, SCALE)
    assert len(found.points) == 10 * 3 + 4 * 8
    assert not found.warnings
    error = found.points.gyro - found.points.reference
    assert np.abs(error).max() < STEP
    # Repeats share the encoder's error; what scatters is the gyro's noise, 0.02 deg/sqrt(s) over at most 3.1 s.
    for at in (30.0, 120.0, -120.0, -30.0):
        assert np.std(error[found.points.set_point == at]) < 0.08


def test_repeats_do_not_average_the_encoders_step(session: Recording) -> None:
    found = position_test.readings(session, "x", BIAS, SCALE)
    assert found.reference_u == pytest.approx(STEP / 6**0.5, rel=1e-3)
    result = position_test.run(session, "x", bias=BIAS, scale_factor=SCALE)
    assert result.type_b >= 0.99 * STEP / 6**0.5


def test_a_wrong_bias_grows_with_the_time_of_the_move(session: Recording) -> None:
    drift_dps = 0.5
    right = position_test.points(session, "x", BIAS, SCALE)
    wrong = position_test.points(session, "x", BIAS - drift_dps * SCALE, SCALE)
    assert wrong.gyro - right.gyro == pytest.approx(drift_dps * right.duration_s, rel=1e-9)


def test_type_b_holds_the_drift_that_the_bias_uncertainty_allows(session: Recording) -> None:
    loose = position_test.run(session, "x", bias=BIAS, scale_factor=SCALE, bias_u=0.5 * SCALE)
    longest = position_test.points(session, "x", BIAS, SCALE).duration_s.max()
    assert loose.type_b == pytest.approx(np.hypot(STEP / 6**0.5, 0.5 * longest), rel=1e-3)


def test_the_thesis_profile_integrates_the_filtered_gyro(session: Recording) -> None:
    raw = position_test.points(session, "x", BIAS, SCALE)
    smooth = position_test.points(session, "x", BIAS, SCALE, "thesis")
    change = smooth.gyro - raw.gyro
    assert 0.05 < np.abs(change).max() < 2.0


def test_a_short_rest_is_told_and_left_out() -> None:
    moves = position_moves((60, -60), 2)
    segment, start, end, rate, _, _ = moves[0]
    moves[0] = (segment, start, end, rate, 0.2, 0.0)
    found = position_test.readings(record(moves), "x", BIAS, SCALE)
    assert [w["code"] for w in found.warnings] == ["position_test.not_at_rest"]
    assert len(found.points) == 3


def test_a_table_that_stays_or_stops_short_is_told() -> None:
    moves = [
        ("position_x/linearity/+90/1", 0.0, 0.0, 50.0, 1.0, 1.0),
        ("position_x/linearity/+60/1", 0.0, 40.0, 50.0, 0.2, 0.4),
    ]
    found = position_test.readings(record(moves), "x", BIAS, SCALE)
    assert [w["code"] for w in found.warnings] == ["position_test.no_move", "position_test.off_target"]
    assert found.points.reference == pytest.approx([40.0], abs=0.3)
    assert found.points.gyro == pytest.approx(found.points.reference, abs=0.4)


def test_an_encoder_that_flickers_at_rest_is_one_reading(session: Recording) -> None:
    rng = np.random.default_rng(3)
    columns = dict(session.columns)
    columns["x_position_deg"] = columns["x_position_deg"] + STEP * (rng.random(len(session)) < 0.2)
    flickering = Recording(session.time_s, columns, session.segment_codes, session.segment_names)
    found = position_test.readings(flickering, "x", BIAS, SCALE)
    assert not found.warnings
    assert np.abs(found.points.gyro - found.points.reference).max() < 1.5 * STEP


@pytest.mark.parametrize("profile", ["standard", "thesis"])
def test_a_recording_without_moves_is_no_crash(profile: str) -> None:
    rest = record([("rest", 0.0, 0.0, 1.0, 1.0, 2.0)])
    result = position_test.run(rest, "x", bias=BIAS, scale_factor=SCALE, profile=profile)
    assert [w["code"] for w in result.warnings] == ["test.set_points_missing"] * 2
    assert result.to_json()["points"] == {"linearity": [], "repeat": []}
