"""The six states as data: set-points, order, timing, and the check that comes before any motion."""

import json
from collections import Counter

import pytest

from calib_core.gyro_models import PRESETS, GyroModel
from calib_core.problem import Problem
from calib_core.sequence import STATES, Axis, Move, Plan, Profile, Wave, check, make_plan

OUT = PRESETS["LPY503AL-OUT"]
RIG = {
    "x": Axis("x", -150.0, 150.0, 327.0, 300 / 1023, "RX-28", 12.1),
    "z": Axis("z", -150.0, 150.0, 254.0, 300 / 1023, "RX-64", 12.1),
}


def set_points(plan: Plan, state: int, test: str) -> list[float]:
    segments = [step.segment.split("/") for step in plan.states[state].steps if "/" in step.segment]
    return [float(parts[2]) for parts in segments if parts[1] == test]


def refused(**asked: object) -> Problem:
    with pytest.raises(Problem) as caught:
        check(make_plan(**{"seed": 1, **asked}), RIG)  # type: ignore[arg-type]
    return caught.value


@pytest.mark.parametrize("profile", ["standard", "thesis"])
def test_the_whole_sequence_takes_about_45_minutes_and_267_000_rows(profile: str) -> None:
    plan = make_plan(profile, seed=3)
    assert [state.name for state in plan.states] == list(STATES)
    assert plan.duration_s / 60 == pytest.approx(45, abs=0.7)
    assert plan.duration_s * 100 == pytest.approx(267_000, rel=0.02)
    assert [state.readings for state in plan.states] == [0, 168, 248] * 2


def test_the_readings_of_the_tests_are_those_of_the_thesis() -> None:
    plan = make_plan("thesis", seed=3)
    rates, angles = set_points(plan, 1, "linearity"), set_points(plan, 2, "linearity")
    assert rates == sorted(rates)
    assert Counter(rates) == dict.fromkeys([s * r for s in (-1, 1) for r in (10, 20, 40, 60, 80, 100)], 3)
    assert angles == sorted(angles)
    assert Counter(angles) == dict.fromkeys([a for a in range(-120, 121, 10) if a], 3)
    assert Counter(set_points(plan, 4, "repeat")) == dict.fromkeys([20, 60, 100, -20, -60, -100], 22)
    assert Counter(set_points(plan, 5, "repeat")) == dict.fromkeys([30, 60, 90, 120, -30, -60, -90, -120], 22)
    assert all(len({step.segment for step in state.steps if "/" in step.segment}) == state.readings
               for state in plan.states)  # fmt: skip


def test_the_seed_alone_decides_the_order_and_one_state_repeated_keeps_it() -> None:
    plan = make_plan("standard", seed=7)
    assert plan == make_plan("standard", seed=7)
    assert set_points(plan, 1, "linearity") != sorted(set_points(plan, 1, "linearity"))
    assert set_points(plan, 2, "repeat") != set_points(make_plan("standard", seed=8), 2, "repeat")
    alone = make_plan("standard", seed=7, states=["position_x"])
    assert set_points(alone, 0, "repeat") == set_points(plan, 2, "repeat")


def test_a_plan_survives_json() -> None:
    plan = make_plan("standard", seed=2, readings=5, states=["rate_z", "estimate_x"], ranges={"z": {"rate_dps": 90}})
    again = Plan.from_json(json.loads(json.dumps(plan.to_json())))
    assert again == plan
    assert again.gyro_model == plan.gyro_model
    assert [state.name for state in again.states] == ["estimate_x", "rate_z"]
    assert again.short


def test_each_state_begins_with_a_still_hold_at_zero_kept_at_1_khz() -> None:
    for state in make_plan("standard", seed=1).states:
        hold = next(step for step in state.steps if step.segment != "move")
        assert (hold.segment, hold.motions, hold.keep_fast) == ("hold", (), True)
        assert hold.duration_s >= 3.0
        last = [motion for step in state.steps for motion in step.motions][-1]
        assert isinstance(last, Move)
        assert last.to_deg == 0.0


def test_strokes_and_moves_are_timed_as_in_the_method() -> None:
    plan = make_plan("thesis", seed=1)
    at = 0.0
    for step in plan.states[1].steps:
        for motion in step.motions:
            assert isinstance(motion, Move)
            if "/" in step.segment:
                rate = float(step.segment.split("/")[2])
                assert (at, motion.to_deg, motion.rate_dps) == pytest.approx((-0.9 * rate, 0.9 * rate, abs(rate)))
                assert step.duration_s == pytest.approx(1.8 + 0.4)
            elif len(step.motions) == 1:
                assert motion.rate_dps == 120.0
            at = motion.to_deg
    out, back = (step for step in plan.states[2].steps[1:3])
    assert out.segment == "position_x/linearity/-120/1"
    assert out.motions == (Move("x", -120.0, 50.0, start_s=0.2),)
    assert out.duration_s == pytest.approx(0.2 + 2.4 + 0.4)
    assert back.motions == (Move("x", 0.0, 100.0),)


def test_fast_strokes_never_leave_120_degrees() -> None:
    wide = GyroModel.from_json(
        {"id": "fast", "axes": {"x": {"bias_V": 1.2, "scale_factor_V_per_dps": 0.002, "range_dps": 400}}}
    )
    plan = make_plan("standard", seed=1, states=["rate_x"], ranges={"x": {"rate_dps": 325}}, gyro_model=wide)
    check(plan, RIG)
    assert max(abs(m.to_deg) for step in plan.states[0].steps for m in step.motions if isinstance(m, Move)) == 120.0


def test_the_frequencies_of_the_profiles_are_the_thesis_and_an_unlocked_one() -> None:
    waves = {}
    for profile in ("thesis", "standard"):
        (wave,) = (
            m for step in make_plan(profile, seed=1).states[0].steps for m in step.motions if isinstance(m, Wave)
        )
        waves[profile] = wave
        assert wave.duration_s == pytest.approx(100, abs=1)
        assert wave.duration_s * wave.frequencies_hz[0] == pytest.approx(25)
    assert waves["thesis"].frequencies_hz == (0.25,)
    assert waves["standard"].frequencies_hz == (0.2513,)
    assert waves["thesis"].peak_rate_dps == pytest.approx(47.1, abs=0.05)


def test_ranges_scale_set_points_and_speeds_and_come_from_the_gyro_model() -> None:
    plan = make_plan("standard", seed=1, gyro_model=PRESETS["LPY503AL-4XOUT"])
    check(plan, RIG)
    assert max(set_points(plan, 1, "linearity")) == 25.0
    assert max(set_points(plan, 2, "linearity")) == 120.0
    half = make_plan("standard", seed=1, ranges={"x": {"rate_dps": 50.0}})
    assert max(set_points(half, 1, "repeat")) == 50.0
    assert max(set_points(half, 4, "repeat")) == 100.0


def test_limit_is_found_before_motion() -> None:
    past_sensor = refused(ranges={"x": {"rate_dps": 130.0}})
    assert past_sensor.code == "plan.rate_past_sensor"
    assert past_sensor.values["highest"] == 120.0
    assert refused(gyro_model=PRESETS["LPY503AL-4XOUT"], ranges={"x": {"sine_deg": 30}}).code == "plan.rate_past_sensor"
    past_rig = refused(ranges={"z": {"position_deg": 160.0}})
    assert (past_rig.code, past_rig.values["asked"], past_rig.values["axis"]) == ("plan.angle_past_rig", 160.0, "z")


def test_a_speed_past_the_servo_is_refused_with_the_servo_and_its_supply() -> None:
    with pytest.raises(Problem) as caught:
        RIG["x"].check(0.0, 999.0)
    assert caught.value.code == "plan.rate_past_rig"
    assert caught.value.values == {"axis": "x", "asked": 999.0, "highest": 327.0, "part": "RX-28", "supply_V": 12.1}


def test_motion_past_4_1_hz_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for frequency, code in ((4.0313, None), (4.2, "plan.frequency")):
        profile = Profile("standard", sine_hz=frequency, sine_cycles=25, shuffle_linearity=True)
        monkeypatch.setattr("calib_core.sequence.PROFILES", {"standard": profile})
        asked = make_plan("standard", seed=1, states=["estimate_x"], ranges={"x": {"sine_deg": 2.0}})
        if code is None:
            check(asked, RIG)
        else:
            with pytest.raises(Problem, match=code):
                check(asked, RIG)


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        ({"profile": "quick"}, "plan.profile"),
        ({"states": ["rate_y"]}, "plan.state"),
        ({"states": []}, "plan.no_state"),
        ({"readings": 2}, "plan.readings"),
        ({"seed": -1}, "plan.seed"),
        ({"ranges": {"x": {"rate_dps": -5}}}, "gyro_model.value"),
    ],
)
def test_a_plan_that_makes_no_sense_is_refused(asked: dict[str, object], code: str) -> None:
    assert refused(**asked).code == code


def test_gyro_models_survive_json_and_bad_ones_are_refused() -> None:
    for model in PRESETS.values():
        assert GyroModel.from_json(json.loads(json.dumps(model.to_json()))) == model
    for change in ({"axes": {}}, {"axes": {"x": {"bias_V": 1.2}}}, {"output_max_V": -1}, {"axes": {"q": {}}}):
        with pytest.raises(Problem, match="gyro_model"):
            GyroModel.from_json({**OUT.to_json(), **change})
