"""The table's driver on the emulated bus: HARDWARE's rules for motion, torque and faults."""

import math
import sys
import time
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

if sys.platform == "win32":
    pytest.skip("the servo bus is emulated behind a pseudo-terminal", allow_module_level=True)

from servos import Servos, start

from calib_core.problem import Problem
from calib_core.sequence import Move, Wave
from server.devices import DeviceError, dynamixel_bus, dynamixel_servos, dynamixel_table
from server.devices.dynamixel_registers import Register, to_deg, word
from server.devices.dynamixel_table import DynamixelTable

PATIENCE_S = 5.0


@pytest.fixture(scope="module")
def servos() -> Iterator[Servos]:
    with closing(start(seed=2)) as servos:
        yield servos


@pytest.fixture
def table(servos: Servos) -> Iterator[DynamixelTable]:
    """A connected table on servos that are well."""
    with closing(servos.table()) as table:
        table.open()
        table.read()
        servos.bus.written()
        yield table
    servos.bus.mend()


def wait(for_what: object, seconds: float = PATIENCE_S) -> None:
    """The emulated bench has its own clock."""
    until = time.perf_counter() + seconds
    while not for_what():  # type: ignore[operator]
        assert time.perf_counter() < until, "waited in vain"
        time.sleep(0.01)


def fault(table: DynamixelTable, seconds: float = PATIENCE_S) -> DeviceError:
    """The fault that ends the readings."""
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        try:
            table.read()
        except DeviceError as found:
            return found
        time.sleep(0.01)
    raise AssertionError("no fault")


def torque(servos: Servos) -> list[int]:
    return [servos.bus.peek(servo, Register.TORQUE_ENABLE)[0] for servo in (1, 2)]


def goals(written: list[tuple[float, int, int, bytes]], servo: int) -> list[tuple[float, int, int]]:
    """(time, goal, speed) of every goal written to a servo."""
    return [
        (at, int.from_bytes(values[:2], "little"), int.from_bytes(values[2:], "little"))
        for at, number, address, values in written
        if number == servo and address == Register.GOAL_POSITION
    ]


# --- starting --------------------------------------------------------------------------------------------------------
def test_torque_goes_off_before_anything_else_whatever_the_last_owner_left(servos: Servos) -> None:
    for servo in (1, 2):
        servos.bus.poke(servo, Register.TORQUE_ENABLE, 1)
    servos.bus.written()
    with closing(servos.table()) as table:
        table.open()
        first = servos.bus.written()[:2]
        assert [(servo, address, values) for _, servo, address, values in first] == [
            (1, Register.TORQUE_ENABLE, b"\0"),
            (2, Register.TORQUE_ENABLE, b"\0"),
        ]
        assert torque(servos) == [0, 0]


def test_both_servos_are_read_a_hundred_times_a_second(table: DynamixelTable, servos: Servos) -> None:
    table.read()
    time.sleep(1.0)
    for axis, readings in table.read().items():
        assert len(readings.time_s) > 60  # a busy machine loses some; `bench bus` holds it to 100
        assert (np.diff(readings.time_s) > 0.0).all()
        true = servos.plant.angles(axis, readings.time_s)
        assert np.abs(readings.angle_deg - true).max() < 0.2


def test_the_top_speed_follows_from_the_supply(servos: Servos) -> None:
    for servo in (1, 2):
        servos.bus.poke(servo, Register.PRESENT_VOLTAGE, 150)
    with closing(servos.table()) as table:
        table.open()
        assert [axis.max_rate_dps for axis in table.axes.values()] == pytest.approx([27 * 15.0, 21 * 15.0])
        with pytest.raises(Problem) as refused:
            table.start([Move("z", 10.0, 320.0)])
        assert (refused.value.code, refused.value.values["supply_V"]) == ("plan.rate_past_rig", 15.0)
    for servo in (1, 2):
        servos.bus.poke(servo, Register.PRESENT_VOLTAGE, 121)


@pytest.mark.parametrize(
    ("address", "values", "code"),
    [
        (Register.MODEL, [12], "rig.servo_model"),
        (Register.CCW_LIMIT, [0, 0], "rig.servo_wheel"),
        (Register.SHUTDOWN, [4], "rig.servo_unguarded"),
        (Register.STATUS_RETURN, [0], "rig.servo_quiet"),
        (Register.BAUD, [34], "rig.servo_silent"),
        (Register.ID, [9], "rig.servo_silent"),
        (Register.PRESENT_TEMPERATURE, [90], "rig.overheat"),
        (Register.PRESENT_VOLTAGE, [55], "rig.supply"),
    ],
)
def test_a_servo_that_is_set_up_wrongly_is_named(
    servos: Servos, address: Register, values: list[int], code: str
) -> None:
    before = servos.bus.peek(2, address, len(values))
    servos.bus.poke(2, address, *values)
    with closing(servos.table()) as table:
        try:
            with pytest.raises(DeviceError) as found:
                table.open()
        finally:  # the other tests have the same servos
            servos.bus.poke(2, address, *before)
        assert (found.value.code, found.value.values["axis"]) == (code, "z")
        table.open()  # mended, it works


def test_exchanged_ids_are_told_with_the_right_order(servos: Servos) -> None:
    with (
        closing(DynamixelTable(servos.port, {"x": 2, "z": 1}, latency=1.0)) as table,
        pytest.raises(DeviceError) as found,
    ):
        table.open()
    assert (found.value.code, found.value.values["ids"]) == ("rig.servos_exchanged", "1,2")


# --- motion ----------------------------------------------------------------------------------------------------------
def test_a_servo_takes_hold_where_it_stands_before_it_turns(table: DynamixelTable, servos: Servos) -> None:
    servos.bus.poke(1, Register.GOAL_POSITION, *word(900))  # left by the last owner: torque on would jump there
    stands = int.from_bytes(servos.bus.peek(1, Register.PRESENT_POSITION, 2), "little")
    table.start([Move("x", 20.0, 50.0)])
    wait(lambda: torque(servos)[0] == 1)
    sent = servos.bus.written()
    order = [(address, values) for _, servo, address, values in sent if servo == 1]
    assert order[0][0] == Register.GOAL_POSITION
    assert abs(goals(sent, 1)[0][1] - stands) <= 1
    assert order[1] == (Register.TORQUE_LIMIT, word(614))
    assert order[2] == (Register.TORQUE_ENABLE, b"\1")


@pytest.mark.parametrize(("rate_dps", "register"), [(10.0, 15), (100.0, 150)])
def test_a_constant_rate_is_one_goal_at_its_speed(
    table: DynamixelTable, servos: Servos, rate_dps: float, register: int
) -> None:
    table.start([Move("z", 0.0, 100.0)])
    wait(lambda: abs(servos.plant.shaft("z")[0]) < 0.3)
    servos.bus.written()
    table.start([Move("z", 12.0, rate_dps)])
    wait(lambda: abs(servos.plant.shaft("z")[0] - 12.0) < 0.4)
    assert {(goal, speed) for _, goal, speed in goals(servos.bus.written(), 2)} == {(553, register)}


def test_a_stream_leads_by_forty_milliseconds_and_never_by_speed_zero(table: DynamixelTable, servos: Servos) -> None:
    table.start([Move("x", 0.0, 50.0)])
    wait(lambda: abs(servos.plant.shaft("x")[0]) < 0.3)
    servos.bus.written()
    wave = Wave("x", (30.0,), (0.5,), 2.0)
    began = time.perf_counter()
    table.start([wave])
    time.sleep(2.2)
    sent = goals(servos.bus.written(), 1)
    assert len(sent) > 70  # 50 Hz for two seconds, less what a busy machine loses
    assert np.median(np.diff([at for at, _, _ in sent])) == pytest.approx(0.02, abs=0.004)
    for at, goal, speed in sent:
        assert speed >= 1
        led = [abs(wave.angle_deg(0.0, at - began + lead) - to_deg(goal)) for lead in np.arange(-0.02, 0.046, 0.005)]
        assert min(led) < 0.8
    assert servos.plant.shaft("x")[0] == pytest.approx(0.0, abs=1.0)


@pytest.mark.parametrize(
    ("motion", "code"),
    [
        (Move("x", 151.0, 10.0), "plan.angle_past_rig"),
        (Move("x", 10.0, 400.0), "plan.rate_past_rig"),
        (Wave("z", (160.0,), (0.01,), 5.0), "plan.angle_past_rig"),
        (Wave("z", (30.0,), (4.0,), 5.0), "plan.rate_past_rig"),
    ],
)
def test_what_is_past_the_limits_is_refused_before_a_byte_is_sent(
    table: DynamixelTable, servos: Servos, motion: Move | Wave, code: str
) -> None:
    with pytest.raises(Problem) as refused:
        table.start([motion])
    assert refused.value.code == code
    time.sleep(0.05)
    assert servos.bus.written() == []


def test_narrower_angle_limits_of_a_servo_are_its_axis_limits(servos: Servos) -> None:
    servos.bus.poke(1, Register.CW_LIMIT, *word(102), *word(921))
    with closing(servos.table()) as table:
        table.open()
        assert (table.axes["x"].min_deg, table.axes["x"].max_deg) == pytest.approx((-120.2, 119.9), abs=0.1)
    servos.bus.poke(1, Register.CW_LIMIT, *word(0), *word(1023))


def test_a_goal_that_is_lost_on_its_way_is_sent_again(table: DynamixelTable, servos: Servos) -> None:
    table.start([Move("x", 0.0, 50.0)])
    wait(lambda: abs(servos.plant.shaft("x")[0]) < 0.3)
    servos.bus.deafen(2)
    table.start([Move("x", 10.0, 50.0)])
    wait(lambda: abs(servos.plant.shaft("x")[0] - 10.0) < 0.4)


def test_a_servo_that_never_takes_its_goal_ends_it(table: DynamixelTable, servos: Servos) -> None:
    table.start([Move("x", 0.0, 50.0)])
    wait(lambda: torque(servos)[0] == 1)
    servos.bus.deafen(40)
    table.start([Move("x", 10.0, 50.0)])
    assert fault(table).code == "rig.command_lost"
    servos.bus.mend()
    table.safe()
    assert torque(servos) == [0, 0]


# --- stopping --------------------------------------------------------------------------------------------------------
def test_safe_lets_go_within_a_tenth_of_a_second_idle_and_busy_and_twice(table: DynamixelTable, servos: Servos) -> None:
    took = []
    for motions in ((), (Wave("x", (20.0,), (0.5,), 9.0), Move("z", 60.0, 30.0))):
        table.start(motions)
        time.sleep(0.3)
        for _ in range(2):
            began = time.perf_counter()
            table.safe()
            took.append(time.perf_counter() - began)
            assert torque(servos) == [0, 0]
    assert min(took) < 0.1
    assert sorted(took)[2] < 0.3


def test_nothing_moves_after_a_stop(table: DynamixelTable, servos: Servos) -> None:
    table.start([Wave("x", (20.0,), (0.5,), 9.0)])
    time.sleep(0.2)
    table.safe()
    servos.bus.written()
    time.sleep(0.2)
    assert servos.bus.written() == []


def test_safe_and_close_work_before_open(servos: Servos) -> None:
    table = servos.table()
    table.safe()
    table.close()
    table.safe()


def test_torque_goes_off_when_nobody_reads_any_more(
    table: DynamixelTable, servos: Servos, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dynamixel_table, "HEARTBEAT_S", 0.3)
    table.start([Wave("x", (20.0,), (0.5,), 9.0)])
    wait(lambda: torque(servos)[0] == 1)
    wait(lambda: torque(servos) == [0, 0])


def test_closing_lets_go(servos: Servos) -> None:
    table = servos.table()
    table.open()
    table.start([Move("x", 30.0, 10.0)])
    wait(lambda: torque(servos)[0] == 1)
    table.close()
    assert torque(servos) == [0, 0]


# --- faults that end a run -------------------------------------------------------------------------------------------
def test_a_blocked_shaft_ends_it_with_overload_and_recovers_once_it_is_free(
    table: DynamixelTable, servos: Servos
) -> None:
    table.start([Move("x", 60.0, 20.0), Move("z", 30.0, 10.0)])
    time.sleep(0.4)
    servos.plant.jam("x")
    found = fault(table)
    assert (found.code, found.values["axis"]) == ("rig.overload", "x")
    assert torque(servos) == [0, 0]
    assert servos.bus.peek(1, Register.TORQUE_LIMIT, 2) == word(0)
    servos.plant.jam("x", False)
    table.open()
    table.start([Move("x", 0.0, 60.0)])
    wait(lambda: abs(servos.plant.shaft("x")[0]) < 0.4)


def test_an_overload_alarm_ends_it_though_the_value_is_good(table: DynamixelTable, servos: Servos) -> None:
    table.start([Move("x", 20.0, 10.0)])
    wait(lambda: torque(servos)[0] == 1)
    time.sleep(0.1)
    servos.bus.fault("overload", 1)
    assert fault(table).code == "rig.overload"
    assert torque(servos) == [0, 0]


@pytest.mark.parametrize(
    ("address", "bad", "good", "code"),
    [
        (Register.PRESENT_TEMPERATURE, 82, 34, "rig.overheat"),
        (Register.PRESENT_VOLTAGE, 58, 121, "rig.supply"),
    ],
)
def test_heat_and_a_failing_supply_end_it_with_their_reason(
    table: DynamixelTable, servos: Servos, address: Register, bad: int, good: int, code: str
) -> None:
    table.start([Move("x", 20.0, 10.0)])
    wait(lambda: torque(servos)[0] == 1)
    servos.bus.poke(1, address, bad)
    assert fault(table).code == code
    assert torque(servos) == [0, 0]
    servos.bus.poke(1, address, good)
    table.open()


def test_a_servo_that_falls_silent_ends_it_and_the_other_lets_go(table: DynamixelTable, servos: Servos) -> None:
    table.start([Move("x", 20.0, 10.0), Move("z", 20.0, 10.0)])
    wait(lambda: torque(servos) == [1, 1])
    servos.bus.silence(1)
    found = fault(table)
    assert (found.code, found.values["axis"]) == ("rig.servo_silent", "x")
    assert servos.bus.peek(2, Register.TORQUE_ENABLE) == b"\0"
    servos.bus.rejoin(1)
    table.open()
    assert torque(servos) == [0, 0]


def test_a_busy_host_is_no_silent_servo_and_ends_it_only_after_a_while(
    table: DynamixelTable, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(dynamixel_bus, "STAMP_S", -1.0)  # every reply comes too late to know when it was made
        began = time.perf_counter()
        wait(
            lambda: time.perf_counter() - began > 1.5 * dynamixel_servos.SILENT_S and not len(table.read()["x"].time_s)
        )
    wait(lambda: len(table.read()["x"].time_s))
    monkeypatch.setattr(dynamixel_servos, "BUSY_S", 2.0 * dynamixel_servos.SILENT_S)
    monkeypatch.setattr(dynamixel_bus, "STAMP_S", -1.0)
    assert fault(table).code == "rig.host_busy"


def test_a_port_that_goes_away_ends_it_and_lets_go_as_soon_as_it_is_back(table: DynamixelTable, servos: Servos) -> None:
    table.start([Move("x", 30.0, 10.0)])
    wait(lambda: torque(servos)[0] == 1)
    servos.bus.unplug()
    assert fault(table).code == "rig.port_gone"
    with pytest.raises(DeviceError) as caught:
        table.safe()
    assert caught.value.code == "rig.not_safe"
    with pytest.raises(DeviceError) as caught:
        table.start([Move("x", 0.0, 10.0)])
    assert caught.value.code == "rig.port_gone"
    servos.bus.plug()
    wait(lambda: torque(servos) == [0, 0])  # nobody asked
    table.open()
    table.safe()
    table.start([Move("x", 0.0, 60.0)])
    wait(lambda: abs(servos.plant.shaft("x")[0]) < 0.4)


def test_telemetry_says_what_the_servos_say(table: DynamixelTable, servos: Servos) -> None:
    servos.bus.poke(2, Register.PRESENT_TEMPERATURE, 37)
    wait(lambda: table.telemetry()["z"].temperature_degC == 37.0)
    said = table.telemetry()["z"]
    assert (said.supply_V, said.torque_on) == (12.1, False)
    assert not math.isnan(said.load_pct)
    servos.bus.poke(2, Register.PRESENT_TEMPERATURE, 34)
