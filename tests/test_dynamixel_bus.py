"""The driver's bytes against the RX-28 manual, and each way of HARDWARE in which a reply goes wrong, byte by byte."""

import sys
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest

if sys.platform == "win32":
    pytest.skip("needs pseudo-terminals", allow_module_level=True)

from line import Line, packet, status

from server.devices import DeviceError
from server.devices.dynamixel_bus import Bus, NoReply
from server.devices.dynamixel_registers import Alarm, speed_code, state, to_code, to_deg

BLOCK = bytes([0x00, 0x02, 0x00, 0x00, 0x00, 0x00, 121, 34])  # 0 deg, still, 12.1 V, 34 degC
OTHER = bytes([0xFF, 0x03, 0x00, 0x00, 0x00, 0x00, 121, 34])


@pytest.fixture
def line() -> Iterator[Line]:
    line = Line()
    yield line
    line.close()


@pytest.fixture
def bus(line: Line) -> Iterator[Bus]:
    """An open bus whose servos 1 and 2 have been found: the first packets are behind it."""
    line.then = honest
    bus = Bus(line.port, 1_000_000, latency=20)  # time enough for a busy test machine
    bus.open()
    for servo in (1, 2):
        bus.registers(servo, 36, 8)
    line.then = lambda asked: b""  # noqa: ARG005
    line.asked.clear()
    yield bus
    bus.close()


def honest(asked: bytes) -> bytes:
    """A servo that does what it is asked: its block, or its id and what follows."""
    servo, address, length = asked[2], asked[5], asked[6]
    return status(servo, 0, BLOCK if (address, length) == (36, 8) else bytes([servo, 1, 0, 0, 0][:length]))


def first_data(bus: Bus) -> bytes:
    """What the driver takes for the answer at last."""
    for _ in range(20):
        with suppress(NoReply):
            return bus.read(1, 36, 8).data
    raise AssertionError("no answer was taken")


# --- the manual's examples -------------------------------------------------------------------------------------------
def test_a_read_is_the_manuals_packet_and_its_answer_is_understood(bus: Bus, line: Line) -> None:
    line.say(packet("FF FF 01 03 00 20 DB"))
    assert bus.read(1, 0x2B, 1).data == bytes([32])  # 32 degC
    assert line.asked == [packet("FF FF 01 04 02 2B 01 CC")]


def test_a_group_write_is_the_manuals_packet(bus: Bus, line: Line) -> None:
    rows = {0: (0x010, 0x150), 1: (0x220, 0x360), 2: (0x030, 0x170), 3: (0x220, 0x380)}
    bus.write(30, {servo: b"".join(value.to_bytes(2, "little") for value in row) for servo, row in rows.items()})
    line.say(packet("FF FF 01 03 00 20 DB"))
    bus.read(1, 0x2B, 1)  # the write has no answer; this one says that it has gone out
    sent = "FF FF FE 18 83 1E 04 00 10 00 50 01 01 20 02 60 03 02 30 00 70 01 03 20 02 80 03 12"
    assert line.asked[0] == packet(sent)


def test_one_read_brings_position_speed_load_voltage_and_temperature(bus: Bus, line: Line) -> None:
    line.say(status(2, 0, bytes([0xE9, 0x01, 0x0A, 0x04, 0x66, 0x00, 118, 41])))
    before = time.perf_counter()
    reply = bus.read(2, 36, 8)
    said = state(reply.data)
    assert before < reply.time_s < time.perf_counter()
    assert said is not None
    assert said.angle_deg == pytest.approx((489 - 512) * 300 / 1023)
    assert said.speed_dps == pytest.approx(-6.66)
    assert said.load_pct == pytest.approx(9.97, abs=0.01)
    assert (said.supply_V, said.temperature_degC) == (11.8, 41.0)


# --- replies that are no data ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "reply",
    [
        b"",
        status(1, 0, BLOCK)[:-1] + b"\x00",
        status(1, 0, BLOCK)[:7],
        status(1, 0, BLOCK[:7]),  # the SDK gives its checksum as the eighth byte, with success
        status(1, 0, BLOCK + b"\x00"),
        status(2, 0, BLOCK),
        status(1, 0x10, BLOCK),  # the servo heard a wrong checksum
        bytes([0xFF, 0xFF, 1, 0, 0, 0xFE]),
        bytes([0x00, 0xFF, 0x12]),
    ],
    ids=["no reply", "bad checksum", "truncated", "short", "long", "wrong id", "misheard", "empty", "noise"],
)
def test_a_reply_that_is_not_the_answer_is_never_data(bus: Bus, line: Line, reply: bytes) -> None:
    line.say(reply)
    line.then = honest
    with pytest.raises(NoReply):
        bus.read(1, 36, 8)
    assert first_data(bus) == BLOCK


def test_a_late_reply_is_not_the_answer_to_the_next_read(bus: Bus, line: Line) -> None:
    late = status(1, 0, OTHER)
    line.say([(0.09, late)])
    line.then = honest
    with pytest.raises(NoReply) as caught:
        bus.read(1, 36, 8)
    assert caught.value.why == "silent"
    assert first_data(bus) == BLOCK


def test_a_reply_that_comes_with_the_next_question_is_found_out(bus: Bus, line: Line) -> None:
    # Worse than late: the old answer arrives just before the new one, whatever was drained in between.
    line.say(b"", status(1, 0, OTHER) + status(1, 0, bytes([1, 1, 1])))
    line.then = honest
    for _ in range(2):
        with pytest.raises(NoReply):
            bus.read(1, 36, 8)
    assert bus.read(1, 36, 8).data == BLOCK


def test_a_reply_that_came_too_late_to_be_stamped_is_dropped(bus: Bus, line: Line) -> None:
    line.say([(0.03, status(1, 0, OTHER))], status(1, 0, BLOCK))
    with pytest.raises(NoReply):
        bus.read(1, 36, 8)
    assert bus.lost["unstamped"] == 1
    assert bus.read(1, 36, 8).data == BLOCK


def test_an_overloaded_servos_value_is_data_and_its_alarm_is_told(bus: Bus, line: Line) -> None:
    line.say(status(1, 0x20, BLOCK))
    assert bus.read(1, 36, 8).data == BLOCK
    assert (bus.alarms(1), bus.alarms(1)) == (Alarm.OVERLOAD, Alarm(0))


def test_another_servos_answer_in_between_is_passed_over(bus: Bus, line: Line) -> None:
    line.say(status(2, 0, OTHER) + status(1, 0, BLOCK))
    assert bus.read(1, 36, 8).data == BLOCK


def test_noise_without_end_does_not_hang(bus: Bus, line: Line) -> None:
    line.say([(0.0, b"\xff" * 200)] * 12)
    began = time.perf_counter()
    with pytest.raises(NoReply):
        bus.read(1, 36, 8)
    assert time.perf_counter() - began < 0.5


def test_a_block_no_servo_can_say_is_no_state() -> None:
    assert state(bytes([0x00, 0x04, 0, 0, 0, 0, 121, 34])) is None  # position 1024
    assert state(bytes([0x00, 0x02, 0, 8, 0, 0, 121, 34])) is None
    assert state(BLOCK) is not None


# --- the port --------------------------------------------------------------------------------------------------------
def test_waiting_for_a_reply_does_not_spin(bus: Bus) -> None:
    began, spent = time.perf_counter(), time.thread_time()
    for _ in range(4):
        with pytest.raises(NoReply):
            bus.read(1, 36, 8)
    assert time.thread_time() - spent < 0.2 * (time.perf_counter() - began)


def test_a_port_that_goes_away_is_told_once_and_opens_again(bus: Bus, line: Line) -> None:
    line.unplug()
    for _ in range(2):
        with pytest.raises(DeviceError) as caught:
            bus.read(1, 36, 8)
        assert caught.value.code == "rig.port_gone"
    with pytest.raises(DeviceError) as caught:
        bus.open()
    assert caught.value.code == "rig.port_absent"
    line.say(status(1, 0, bytes([1, 1, 1])), status(1, 0, BLOCK))
    line.plug()
    bus.open()
    assert bus.read(1, 36, 8).data == BLOCK


def test_a_port_has_one_owner(bus: Bus) -> None:
    with pytest.raises(DeviceError) as caught:
        Bus(bus.port, 1_000_000).open()
    assert caught.value.code == "rig.port_taken"


def test_a_speed_the_adapter_does_not_have_is_refused(line: Line) -> None:
    with pytest.raises(DeviceError) as caught:
        Bus(line.port, 12_345).open()
    assert caught.value.code == "rig.baud"


# --- what numbers mean -----------------------------------------------------------------------------------------------
def test_speed_zero_is_never_written_because_it_means_top_speed() -> None:
    assert [speed_code(rate) for rate in (0.0, 0.2, 10.0, 100.0)] == [1, 1, 15, 150]


def test_angles_and_codes_agree_at_both_ends() -> None:
    assert (to_code(0.0), to_code(to_deg(0)), to_code(to_deg(1023))) == (512, 0, 1023)
    with pytest.raises(ValueError, match="no code"):
        to_code(151.0)
