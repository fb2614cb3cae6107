"""What is checked of a rig before it is believed: each thing that can be wrong is found, named, and has a cure."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calib_core.gyro_models import PRESETS
from calib_core.sequence import Move, make_plan
from calib_core.twin import Plant
from calib_core.twin_servo import RX28, RX64
from server.devices import start_checks
from server.devices.check import Check
from server.devices.rig import Rig
from server.devices.twin_rig import TwinDaq, TwinTable
from server.texts import render

OUT, FOUR = PRESETS["LPY503AL-OUT"], PRESETS["LPY503AL-4XOUT"]
Volts = Callable[[np.ndarray], np.ndarray]


class Wired(TwinDaq):
    """A twin's DAQ with something done to the volts (n, 2) of its gyro."""

    def __init__(self, table: TwinTable, wiring: Volts) -> None:
        super().__init__(table)
        self.wiring = wiring

    def read(self, n: int):
        samples = super().read(n)
        return replace(samples, volts=self.wiring(samples.volts))


def rig(wiring: Volts = lambda volts: volts, *, seed: int = 1, **parts: object) -> Rig:
    table = TwinTable(Plant(seed, **parts))
    made = Rig(f"twin:?seed={seed}", table, Wired(table, wiring), simulated=True)
    made.open()
    return made


def checked(made: Rig, model: object = OUT, **options: object) -> dict[str, Check]:
    found = {check.name: check for check in start_checks.run(made, model, **options)}
    for check in found.values():
        for lang in ("en", "th"):
            said = render(check.code, check.values, lang) + render(check.cure, check.values, lang) * bool(check.cure)
            assert "{" not in said, said
            assert check.code not in said, said
    assert not any(said.torque_on for said in made.table.telemetry().values())
    return found


def test_a_sound_rig_passes_every_check_and_is_left_at_0_and_safe() -> None:
    made = rig()
    found = checked(made)
    assert list(found) == ["servo x", "servo z", "daq", "range", "gyro x", "gyro z", "step x", "step z"]
    assert [check.ok for check in found.values()] == [True] * 8
    truth = made.table.plant.models
    for axis in "xz":
        assert found[f"gyro {axis}"].values["mV_per_dps"] == pytest.approx(1e3 * truth[axis].scale_factor, rel=0.01)
        assert found[f"step {axis}"].values["rate_error_pct"] < 3.18
        assert found[f"step {axis}"].values["position_error_pct"] < 0.29
        assert abs(made.table.plant.servos[axis].motion(np.array([made.table.plant.now_s]))[0][0]) < 0.5


def floating(volts: np.ndarray) -> np.ndarray:
    return 1.4 + 1e-3 * np.random.default_rng(0).standard_normal(volts.shape)


GYRO_FAULTS: dict[str, Volts] = {
    "gyro_floating": floating,
    "gyro_still": lambda volts: 0.0 * volts + 1.2,
    "gyro_rail": lambda volts: np.full_like(volts, 2.4988),
    "gyro_swapped": lambda volts: volts[:, ::-1],
    "gyro_reversed": lambda volts: 2.5 - volts,
    "gyro_other_model": lambda volts: 1.25 + 4.0 * (volts - 1.25),
    "gyro_crooked": lambda volts: volts + 0.3 * (volts[:, ::-1] - 1.25),
}


@pytest.mark.parametrize("what", GYRO_FAULTS)
def test_a_gyro_that_is_not_as_it_should_be_is_named_before_anything_turns_fast(what: str) -> None:
    found = checked(rig(GYRO_FAULTS[what]))
    assert [found[name].code for name in ("gyro x", "gyro z")] == [f"check.{what}"] * 2
    assert found["gyro x"].cure == f"cure.{what}"
    assert "step x" not in found


def test_one_open_input_is_told_from_the_other_sound_one() -> None:
    found = checked(rig(lambda volts: np.column_stack([floating(volts)[:, 0], volts[:, 1]])))
    assert found["gyro x"].code == "check.gyro_floating"
    assert found["gyro z"].ok


@pytest.mark.parametrize("source_kohm", [0.0, 33.0])
def test_the_breakout_boards_33_kohm_is_no_fault(source_kohm: float) -> None:
    g = 144.0 / (144.0 + source_kohm)  # HARDWARE: V = g V_src + (1 - g) 1.4
    found = checked(rig(lambda volts: g * (1.23 + (volts - 1.23) * 8.3 / 5.9) + (1.0 - g) * 1.4))
    assert found["gyro x"].ok
    assert found["gyro x"].values["mV_per_dps"] == pytest.approx(g * 8.3, rel=0.05)


def test_the_fourfold_output_is_found_with_the_single_one_chosen_and_the_other_way_round() -> None:
    assert checked(rig(), FOUR)["gyro x"].code == "check.gyro_other_model"
    assert checked(rig(GYRO_FAULTS["gyro_other_model"]), FOUR)["gyro x"].ok


def test_a_gyro_of_one_axis_is_checked_on_that_axis() -> None:
    found = checked(rig(), replace(OUT, axes={"x": OUT.axes["x"]}))
    assert list(found) == ["servo x", "servo z", "daq", "range", "gyro x", "step x"]
    assert all(check.ok for check in found.values())


def test_set_points_past_the_sensor_or_the_rig_are_found_before_the_table_moves() -> None:
    plan = make_plan(seed=1, gyro_model=OUT, ranges={"x": {"rate_dps": 130.0}})
    found = checked(rig(), plan=plan)
    assert found["range"].code == "plan.rate_past_sensor"
    slow = {"x": replace(RX28, supply_V=3.0), "z": RX64}
    assert checked(rig(servos=slow))["range"].code == "plan.rate_past_rig"


def test_a_servo_that_is_silent_ends_the_checks_with_its_name() -> None:
    made = rig()
    made.table.silent.add("z")
    found = checked(made)
    assert [(check.name, check.code) for check in found.values()] == [("servo z", "rig.servo_silent")]


def test_readings_that_come_too_seldom_are_told_with_the_latency_timer_as_cure() -> None:
    made = rig()
    read = made.table.read
    made.table.read = lambda: {
        axis: replace(seen, time_s=seen.time_s[::4], angle_deg=seen.angle_deg[::4]) for axis, seen in read().items()
    }
    found = checked(made)
    assert found["servo x"].code == "check.servo_slow"
    assert "latency" in render(found["servo x"].cure, {})


def test_readings_that_a_busy_computer_was_late_for_are_not_blamed_on_the_adapter() -> None:
    made = rig()
    read = made.table.read
    made.table.read = lambda: {
        axis: replace(seen, time_s=seen.time_s[::2], angle_deg=seen.angle_deg[::2], late=len(seen.time_s) // 2)
        for axis, seen in read().items()
    }
    found = checked(made)
    assert found["servo x"].code == "check.host_busy"
    assert "computer" in render(found["servo x"].code, found["servo x"].values)


def test_a_daq_that_is_gone_ends_the_checks() -> None:
    made = rig()
    made.daq.unplugged = True
    assert [(check.name, check.ok) for check in checked(made).values()] == [("daq", False)]


def test_a_step_worse_than_the_thesis_is_told_with_its_figures() -> None:
    made = rig(servos={"x": replace(RX28, speed_error=-0.05), "z": RX64})
    read = made.table.read
    made.table.read = lambda: {
        axis: replace(seen, angle_deg=seen.angle_deg * (1.006 if axis == "z" else 1.0)) for axis, seen in read().items()
    }
    found = checked(made)
    assert found["step x"].code == "check.step_rate"
    assert found["step x"].values["rate_error_pct"] == pytest.approx(5.0, abs=0.3)
    assert found["step z"].code == "check.step_angle"
    assert found["step z"].values["position_error_pct"] == pytest.approx(0.6, abs=0.25)


@pytest.mark.parametrize(
    ("gravity_pct", "friction_pct", "code"),
    [(0.0, 30.0, "check.step"), (30.0, 10.0, "check.step_balance"), (0.0, 70.0, "check.step_load")],
)
def test_load_and_balance_are_watched_while_the_table_steps(gravity_pct: float, friction_pct: float, code: str) -> None:
    made = rig()
    way = {"x": 0.0, "z": 0.0}
    start, told = made.table.start, made.table.telemetry

    def noting(motions: tuple[Move, ...]) -> float:
        for move in motions:
            way[move.axis] = 1.0 if move.to_deg > 0 else -1.0
        return start(motions)

    made.table.start = noting
    made.table.telemetry = lambda: {
        axis: replace(said, load_pct=gravity_pct + way[axis] * friction_pct) for axis, said in told().items()
    }
    assert checked(made)["step x"].code == code


def test_a_stop_ends_the_checks_within_one_block() -> None:
    import threading

    made, abort = rig(), threading.Event()
    seen = []
    for check in start_checks.run(made, OUT, abort=abort):
        seen.append(check.code)
        if check.name == "range":
            abort.set()
    assert seen[-1] == "rig.stopped"
    assert not any(said.torque_on for said in made.table.telemetry().values())


def test_closing_the_checks_early_leaves_the_rig_safe() -> None:
    made = rig()
    checks = start_checks.run(made, OUT)
    next(checks)
    checks.close()
    assert not any(said.torque_on for said in made.table.telemetry().values())
