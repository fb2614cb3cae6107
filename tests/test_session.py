"""A whole recording becomes certified numbers; the truth is the twin's."""

import json
from dataclasses import replace

import numpy as np
import pytest
from sessions import BOARD, SEED, session_recording

from calib_core import comparison, session
from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.sequence import STATES, make_plan
from calib_core.twin import board_truth
from server.devices import open_rig
from server.engine import record

TEST_FIGURES = ("nonlinearity_pct_fs", "repeatability_pct_fs")
UNIT_FIGURES = (
    "max_linearity_error", "max_bias_error", "max_random_error", "max_standard_deviation",
    "uncertainty_type_a", "uncertainty_type_b",
)  # fmt: skip


@pytest.fixture(scope="module")
def whole() -> session.Session:
    return session.analyse(session_recording())


def state_rows(recording: Recording, state: str) -> Recording:
    """The rows of a state, from its hold on."""
    runs = recording.runs()
    of_state = [i for i, run in enumerate(runs) if run.name.split("/")[0] in (state, state.replace("estimate", "step"))]
    start = next(run.start for run in reversed(runs[: of_state[0]]) if run.name == "hold")
    return recording.take(slice(start, runs[of_state[-1]].stop))


def only(recording: Recording, *prefixes: str) -> Recording:
    return recording.take(recording.where(lambda name: name.startswith(prefixes)))


def test_every_certified_number_of_the_contract_is_there_for_both_axes(whole: session.Session) -> None:
    assert list(whole.states) == list(STATES)
    for axis in "xz":
        figures = whole.axes[axis]
        for name in ("bias_V", "scale_factor_V_per_dps"):
            assert {"value", "standard_uncertainty", "expanded_uncertainty"} <= set(figures[name])
        assert set(figures["adaptive"]) == {"bias_V", "scale_factor_V_per_dps"}
        for test, unit in (("rate", "dps"), ("position", "deg")):
            assert set(figures[test]) == {*TEST_FIGURES, *(f"{name}_{unit}" for name in UNIT_FIGURES)}
    json.dumps(whole.states, allow_nan=False)


def test_the_hold_shows_the_angle_random_walk_of_the_simulated_board(whole: session.Session) -> None:
    for axis, model in board_truth(SEED, BOARD).items():
        still = whole.states[f"estimate_{axis}"]["still"]
        assert still["tau_s"][0] == pytest.approx(0.01)
        walk = 60.0 * model.noise.white / model.scale_factor / np.sqrt(100.0)  # deg/√h of white noise at 100 Hz
        found, u = still["angle_random_walk_deg_per_sqrt_h"], still["angle_random_walk_standard_uncertainty"]
        assert abs(found - walk) < 4 * u < 0.5 * walk


def test_the_truth_of_the_simulated_board_lies_inside_four_uncertainties(whole: session.Session) -> None:
    for axis, model in board_truth(SEED, BOARD).items():
        bias, scale_factor = whole.axes[axis]["bias_V"], whole.axes[axis]["scale_factor_V_per_dps"]
        assert abs(bias["value"] - model.bias) < 4 * bias["standard_uncertainty"] < 1e-4
        assert abs(scale_factor["value"] / model.scale_factor - 1) < 2e-4
        assert abs(scale_factor["value"] - model.scale_factor) < 4 * scale_factor["standard_uncertainty"]


def test_the_adaptive_estimate_beside_it_is_within_half_a_percent(whole: session.Session) -> None:
    for axis, model in board_truth(SEED, BOARD).items():
        adaptive = whole.axes[axis]["adaptive"]
        assert adaptive["scale_factor_V_per_dps"] == pytest.approx(model.scale_factor, rel=5e-3)
        assert adaptive["bias_V"] == pytest.approx(model.bias, abs=1e-3)


def test_our_filter_agrees_with_filterpy_on_the_record(whole: session.Session) -> None:
    for axis in "xz":
        assert whole.states[f"estimate_{axis}"]["kalman"]["filterpy_difference"] < 1e-9


def test_a_healthy_board_is_told_of_nothing_but_its_few_readings(whole: session.Session) -> None:
    assert {warning["code"] for warning in whole.warnings} <= {"test.too_few_repeats"}


def test_a_state_analysed_as_it_ends_gives_what_the_whole_recording_gives(whole: session.Session) -> None:
    recording = session_recording()
    alone = session.analyse_state(
        state_rows(recording, "rate_x"),
        "rate_x",
        profile="standard",
        gyro_model=session.model_of(recording),
        estimates=session.estimates_of(whole.states),
    )
    for name, value in session.axes_of({"rate_x": alone})["x"]["rate"].items():
        assert value == pytest.approx(whole.axes["x"]["rate"][name], rel=1e-6)


def test_a_recording_of_one_state_gives_the_figures_of_that_state_only() -> None:
    found = session.analyse(state_rows(session_recording(), "estimate_x"))
    assert set(found.axes) == {"x"}
    assert "rate" not in found.axes["x"]
    assert found.axes["x"]["step_check"]["rate_error_pct"] < 5


def test_a_test_without_an_estimate_of_its_axis_is_refused() -> None:
    with pytest.raises(Problem, match=r"session\.no_estimate") as refused:
        session.analyse(only(session_recording(), "hold", "estimate_x", "rate_x", "rate_z"))
    assert refused.value.values == {"axis": "z", "state": "rate_z"}
    with pytest.raises(Problem, match=r"session\.no_estimate"):
        session.check_states(["rate_x"])
    session.check_states(["rate_x"], estimated=["x"])


def test_a_recording_without_any_state_is_refused() -> None:
    with pytest.raises(Problem, match=r"session\.no_state"):
        session.analyse(only(session_recording(), "hold", "move"))


def test_an_unplugged_gyro_is_refused_and_not_certified() -> None:
    recording = state_rows(session_recording(), "estimate_x")
    floating = {**recording.columns, "x_gyro_v": 1.4 + 0.001 * np.sin(np.arange(len(recording)))}
    with pytest.raises(Problem, match=r"session\.no_answer|adaptation"):
        session.analyse(replace(recording, columns=floating))


def test_a_sensor_mounted_the_other_way_round_is_pointed_out() -> None:
    recording = state_rows(session_recording(), "estimate_x")
    turned = {**recording.columns, "x_gyro_v": 2.5 - recording.columns["x_gyro_v"]}
    found = session.analyse(replace(recording, columns=turned))
    assert found.axes["x"]["scale_factor_V_per_dps"]["value"] < 0
    assert "session.reversed" in {warning["code"] for warning in found.warnings}


def test_noise_that_grows_when_the_table_moves_is_pointed_out() -> None:
    recording = state_rows(session_recording(), "estimate_x")
    moving = recording.where(lambda name: name == "estimate_x")
    noise = np.where(moving, np.random.default_rng(1).normal(0, 5e-3, len(recording)), 0.0)
    noisy = {**recording.columns, "x_gyro_v": recording.columns["x_gyro_v"] + noise}
    found = session.analyse(replace(recording, columns=noisy))
    assert "session.noise_grew" in {warning["code"] for warning in found.warnings}


def test_when_a_state_was_repeated_the_last_one_counts() -> None:
    recording = state_rows(session_recording(), "estimate_x")
    spoilt = replace(recording, columns={**recording.columns, "x_gyro_v": recording.columns["x_gyro_v"] * 1.01})
    shift = recording.time_s[-1] + 1.0
    moved = {
        name: values + shift if name.endswith("position_time_s") else values
        for name, values in recording.columns.items()
    }
    twice = Recording.join([spoilt, replace(recording, time_s=recording.time_s + shift, columns=moved)])
    once = session.analyse(recording).axes["x"]["scale_factor_V_per_dps"]["value"]
    assert session.analyse(twice).axes["x"]["scale_factor_V_per_dps"]["value"] == pytest.approx(once, rel=1e-6)


def test_full_scale_follows_the_ranges_of_the_plan(whole: session.Session) -> None:
    assert whole.states["rate_x"]["full_scale"] == 200
    assert whole.states["position_z"]["full_scale"] == 240
    recording = only(session_recording(), "hold", "estimate_x", "rate_x/linearity")
    silent = replace(recording, header={"board": "B"})
    assert session.analyse(silent).states["rate_x"]["full_scale"] == 200


def test_a_header_that_is_not_json_is_refused_by_its_key() -> None:
    recording = only(session_recording(), "hold", "estimate_x")
    with pytest.raises(Problem, match=r"session\.header") as refused:
        session.analyse(replace(recording, header={"gyro_model": "{broken"}))
    assert refused.value.values == {"key": "gyro_model"}


def test_profile_thesis_certifies_its_own_estimator_and_owns_up_to_its_deviation() -> None:
    found = session.analyse(session_recording("thesis", states=("estimate_x",)))
    result, truth = found.states["estimate_x"], board_truth(SEED, BOARD)["x"]
    assert result["adaptive"]["form"] == "thesis"
    assert result["scale_factor_V_per_dps"]["value"] == result["adaptive"]["scale_factor_V_per_dps"]
    assert "estimator" in {row["name"] for row in result["budget"]["scale_factor"]}
    deviation = abs(result["scale_factor_V_per_dps"]["value"] - truth.scale_factor)
    assert deviation < result["scale_factor_V_per_dps"]["expanded_uncertainty"]
    assert abs(result["integral_fit"]["scale_factor_V_per_dps"] / truth.scale_factor - 1) < 2e-4


def test_estimated_parameters_follow_the_encoder_where_the_datasheets_do_not() -> None:
    found = comparison.of_session(session_recording(), "x", max_points=500)
    assert len(found["time_s"]) == len(found["encoder"]["rate_dps"]) == len(found["datasheet"]["angle_deg"]) == 500
    assert found["estimated"]["angle_rms_deg"] < 0.3 < 5 < found["datasheet"]["angle_rms_deg"]
    assert found["estimated"]["rate_rms_dps"] < 0.8 < 5 < found["datasheet"]["rate_rms_dps"]
    json.dumps(found, allow_nan=False)


def test_the_step_is_held_against_the_speed_and_angle_that_the_plan_asked_for() -> None:
    for rate_dps, asked in ((50.0, 30.0), (110.0, 60.0)):
        plan = make_plan(seed=1, states=("estimate_x",), ranges={"x": {"rate_dps": rate_dps, "position_deg": 90.0}})
        [step] = [step for step in plan.states[0].steps if step.segment == "step_x"]
        [move] = step.motions
        ranges = {"x": {"rate_dps": rate_dps, "position_deg": 90.0, "sine_deg": 30.0}}
        recording = record(plan, open_rig("twin:?seed=1"), header={"ranges": json.dumps(ranges)})
        check = session.analyse(recording).states["estimate_x"]["step_check"]
        assert (check["rate_dps"], check["to_deg"]) == (move.rate_dps, move.to_deg) == (asked, 90.0)
        assert check["rate_error_pct"] < 4
