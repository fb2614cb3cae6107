"""Motions of experiments: within every limit, the same as steps, as JSON and as a path."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib_core.excitation import Excitation, commanded, menu, plan_of, steps, warming
from calib_core.problem import Problem
from calib_core.sequence import MAX_FREQUENCY_HZ, Axis, Plan, Wave, check
from calib_core.twin_effects import parse
from server.devices import open_rig

FAST = (1.0137, 2.0171, 4.0313)
EVERY = (
    Excitation("x", "sine", 10.0, amplitude_deg=(20.0,), frequency_hz=(0.2513,)),
    Excitation("z", "multisine", 5.0, amplitude_deg=(3.0, 2.0, 1.0), frequency_hz=FAST),
    Excitation("x", "staircase", 30.0, rates_dps=(20.0, 60.0)),
    Excitation("x", "poses", 20.0, angles_deg=(-90.0, 45.0, 0.0)),
    Excitation("x", "hold", 4.0),
    Excitation("x", "heat", 6.0),
)


def rig(volts: float = 12.1, far: float = 150.0) -> dict[str, Axis]:
    return {a: Axis(a, -far, far, k * volts, 0.2933, "RX", volts) for a, k in (("x", 27.0), ("z", 21.0))}


@given(
    volts=st.floats(3.0, 18.0),
    far=st.floats(20.0, 150.0),
    sensor=st.sampled_from([30.0, 120.0, 1000.0]),
    axis=st.sampled_from("xz"),
)
@settings(max_examples=40, deadline=None)
def test_every_motion_offered_is_within_the_limits_of_rig_and_sensor(
    volts: float, far: float, sensor: float, axis: str
) -> None:
    axes = rig(volts, far)
    for motion in menu(axis, axes, {"x": sensor, "z": sensor}, heat=True):
        for step in steps(motion, "1"):
            for one in step.motions:
                assert one.peak_rate_dps <= min(axes[one.axis].max_rate_dps, sensor) or one.peak_rate_dps <= 60.0
                if isinstance(one, Wave):
                    assert max(one.frequencies_hz) <= MAX_FREQUENCY_HZ
                    axes[one.axis].check(one.peak_deg, 0.0)
                else:
                    axes[one.axis].check(one.to_deg, 0.0)


@pytest.mark.parametrize("axis", ["x", "z"])
def test_the_usual_bench_can_do_the_whole_menu(axis: str) -> None:
    axes = open_rig("twin:?seed=1").axes
    for motion in menu(axis, axes, {"x": 120.0, "z": 120.0}, heat=True):
        check(plan_of(motion, experiment="1", axis=axis), axes)


def test_sines_of_the_menu_do_not_lock_to_the_sample_clock() -> None:
    frequencies = {f for m in menu("x", rig(), {"x": 120.0}, heat=False) for e in m for f in e.frequency_hz}
    assert max(frequencies) > 4.0
    assert all(abs(100.0 / f - round(100.0 / f)) > 1e-3 for f in frequencies)


@pytest.mark.parametrize("one", EVERY, ids=lambda e: e.kind)
def test_a_motion_survives_json(one: Excitation) -> None:
    assert Excitation.from_json(one.to_json()) == one


def test_a_plan_survives_json_and_names_its_segments() -> None:
    plan = plan_of(EVERY, experiment="ab12", axis="x", seed=3)
    again = Plan.from_json(plan.to_json())
    assert again == plan
    assert again.states[0].steps == plan.states[0].steps
    named = {step.segment for step in plan.states[0].steps} - {"move", "hold"}
    assert named == {f"experiment/ab12/{i}-{e.kind}" for i, e in enumerate(EVERY, 1)}


@pytest.mark.parametrize(
    "given",
    [
        {"axis": "x", "kind": "spin", "duration_s": 5.0},
        {"axis": "y", "kind": "hold", "duration_s": 5.0},
        {"axis": "x", "kind": "hold"},
        {"axis": "x", "kind": "hold", "duration_s": math.inf},
        {"axis": "x", "kind": "sine", "amplitude_deg": [3.0], "frequency_hz": [], "duration_s": 5.0},
        {"axis": "x", "kind": "multisine", "amplitude_deg": [3.0], "frequency_hz": [1.0, 2.0], "duration_s": 5.0},
        {"axis": "x", "kind": "staircase", "rates_dps": [20.0, 0.0], "duration_s": 5.0},
        {"axis": "x", "kind": "poses", "angles_deg": ["far"], "duration_s": 5.0},
    ],
)
def test_a_motion_that_is_none_is_refused(given: dict[str, object]) -> None:
    with pytest.raises(Problem, match=r"experiment\.(motion|numbers)"):
        Excitation.from_json(given)


def test_the_path_is_what_the_motions_command_one_after_the_other_and_ends_at_zero() -> None:
    plan = steps(EVERY, "1")
    path = commanded(plan, 100.0)
    for axis in "xz":
        expected, here = [], 0.0
        for step in plan:
            own = [m for m in step.motions if m.axis == axis]
            for k in range(round(step.duration_s * 100.0)):
                expected.append(own[0].angle_deg(here, k / 100.0) if own else here)
            here = own[0].angle_deg(here, 1e9) if own else here
        # A wave that is cut off between two samples may have gone on for a sample's time.
        assert np.abs(path[axis] - np.array(expected)).max() < 1.0
        assert abs(path[axis][-1]) < 1e-9


def test_times_asked_for_are_kept() -> None:
    for one in EVERY:
        spent = sum(step.duration_s for step in one.steps("1", {}))
        assert spent == pytest.approx(one.duration_s, abs=12.0 if one.kind == "staircase" else 1.0)


def test_a_heater_warms_and_what_is_warm_cools() -> None:
    motion = [Excitation("x", kind, seconds) for kind, seconds in (("hold", 20.0), ("heat", 60.0), ("hold", 100.0))]
    warm = warming(steps(motion, "1"), 10.0)
    assert warm[:200].max() == 0.0
    assert warm[799] == pytest.approx(10.0 * (1.0 - math.exp(-60.0 / 25.0)), abs=0.1)
    assert warm[-1] < 0.3


def test_hidden_effects_are_read_from_an_address() -> None:
    found = parse("bandwidth_lag.tau:0.006;z.bias_temperature.k1:2e-4;z.bias_temperature.degree:1")
    assert [effect.name for effect in found["x"]] == ["bandwidth_lag"]
    assert {effect.name: effect.values for effect in found["z"]}["bias_temperature"]["k1"] == 2e-4


@pytest.mark.parametrize(
    "text",
    ["lag.tau:1", "bandwidth_lag.k:1", "bandwidth_lag.tau:much", "bandwidth_lag.tau:9", "y.bias_drift.r:1", "tau"],
)
def test_hidden_effects_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(Problem, match=r"effects\."):
        open_rig(f"twin:?effects={text}")
