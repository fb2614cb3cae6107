"""The emulated servo against the RX-28 manual's printed exchanges, and what HARDWARE says a real one does."""

import sys
import time
from collections.abc import Callable
from typing import Any

import pytest

if sys.platform == "win32":
    pytest.skip("the servo bus is emulated behind a pseudo-terminal", allow_module_level=True)

from line import packet
from servos import start

from server.devices.dynamixel_registers import Alarm, Register, word
from server.emulators import servo as emulated
from server.emulators.servo import Instruction, Servo
from server.emulators.servo_bus import status, take


class Shaft:
    """A shaft that goes where it is told at once, unless it is blocked."""

    def __init__(self) -> None:
        self.angle_deg, self.turned = 0.0, []
        self.blocked = self.held = False

    def turn(self, goal_deg: float, rate_dps: float) -> None:
        self.turned.append((goal_deg, rate_dps))
        self.held = True
        if not self.blocked:
            self.angle_deg = goal_deg

    def let_go(self) -> None:
        self.held = False


def servo(number: int = 1) -> tuple[Servo, Shaft]:
    shaft = Shaft()
    return Servo(28, number, lambda: (shaft.angle_deg, 0.0), shaft.turn, shaft.let_go), shaft


def answer(to: Servo, sent: bytes) -> bytes:
    number, instruction, parameters, good = take(bytearray(sent)) or pytest.fail("no packet")
    assert good
    error, data = to.execute(instruction, parameters)
    return status(number, error, data)


# Instruction and status packets as the RX-28 manual prints them (its examples 2 to 4 and 9 to 19).
PAIRS = [
    ("FF FF 01 04 02 2B 01 CC", "FF FF 01 03 00 20 DB"),
    ("FF FF 01 02 01 FB", "FF FF 01 02 00 FC"),
    ("FF FF 00 02 06 F7", "FF FF 00 02 00 FD"),
    ("FF FF 00 04 03 05 02 F1", "FF FF 00 02 00 FD"),
    ("FF FF 00 05 03 08 FF 01 EF", "FF FF 00 02 00 FD"),
    ("FF FF 00 04 03 0B 50 9D", "FF FF 00 02 00 FD"),
    ("FF FF 00 05 03 0E FF 01 E9", "FF FF 00 02 00 FD"),
    ("FF FF 00 04 03 10 00 E8", "FF FF 00 02 00 FD"),
    ("FF FF 00 05 03 11 04 04 DE", "FF FF 00 02 00 FD"),
    ("FF FF 00 05 03 18 01 01 DD", "FF FF 00 02 00 FD"),
    ("FF FF 00 07 03 1A 01 01 40 40 59", "FF FF 00 02 00 FD"),
    ("FF FF 00 07 03 1E 00 02 00 02 D3", "FF FF 00 02 00 FD"),
    ("FF FF 00 05 04 1E 00 00 D8", "FF FF 00 02 00 FD"),
    ("FF FF 01 05 04 1E FF 03 D5", "FF FF 01 02 00 FC"),
]


@pytest.mark.parametrize(("sent", "returned"), PAIRS)
def test_the_manuals_exchanges_come_out_byte_for_byte(sent: str, returned: str) -> None:
    one, _ = servo(packet(sent)[2])
    one.table[Register.PRESENT_TEMPERATURE] = 32
    assert answer(one, packet(sent)) == packet(returned)


def test_a_write_to_all_sets_the_id_as_the_manual_does() -> None:
    one, _ = servo(7)
    answer(one, packet("FF FF FE 04 03 03 01 F6"))
    assert one.number == 1


def test_a_registered_goal_waits_for_the_action() -> None:
    one, shaft = servo()
    answer(one, packet("FF FF 01 05 04 1E FF 03 D5"))
    assert (one.table[Register.REGISTERED], shaft.turned) == (1, [])
    answer(one, packet("FF FF FE 02 05 FA"))
    assert one.table[Register.REGISTERED] == 0
    assert shaft.turned[0][0] == pytest.approx(149.85, abs=0.01)


def test_the_manuals_speed_of_57_rpm_is_341_deg_per_s() -> None:
    one, shaft = servo(0)
    one.table[Register.PRESENT_VOLTAGE] = 160
    answer(one, packet("FF FF 00 07 03 1E 00 02 00 02 D3"))
    assert shaft.turned == [(0.0, pytest.approx(341.0, abs=1.0))]


def test_speed_zero_turns_as_fast_as_the_supply_allows() -> None:
    one, shaft = servo()
    one.execute(Instruction.WRITE, bytes([30]) + word(700) + word(0))
    assert shaft.turned[-1][1] == pytest.approx(27.0 * 12.1)


@pytest.mark.parametrize(
    ("written", "alarm"),
    [
        (bytes([30]) + word(1024), Alarm.RANGE),
        (bytes([24, 2]), Alarm.RANGE),
        (bytes([36]) + word(100), Alarm.RANGE),
        (bytes([48]) + word(100) + b"\0", Alarm.RANGE),
        (b"", Alarm.RANGE),
    ],
)
def test_what_may_not_be_written_is_answered_with_the_range_bit(written: bytes, alarm: Alarm) -> None:
    one, shaft = servo()
    before = bytes(one.table)
    assert one.execute(Instruction.WRITE, written)[0] == alarm
    assert (bytes(one.table), shaft.turned) == (before, [])


def test_a_goal_past_the_angle_limits_is_answered_with_the_angle_bit() -> None:
    one, shaft = servo()
    one.execute(Instruction.WRITE, bytes([8]) + word(600))
    assert one.execute(Instruction.WRITE, bytes([30]) + word(700))[0] == Alarm.ANGLE
    assert shaft.turned == []


def test_an_unknown_instruction_is_answered_with_its_bit() -> None:
    assert servo()[0].execute(0x77, b"")[0] == Alarm.INSTRUCTION


def test_torque_on_with_an_old_goal_jumps_to_it() -> None:
    one, shaft = servo()
    one.table[30:32] = word(800)
    one.execute(Instruction.WRITE, bytes([24, 1]))
    assert shaft.turned[0][0] == pytest.approx((800 - 512) * 300 / 1023)


def test_a_blocked_shaft_shuts_down_until_its_cause_is_gone_and_its_torque_limit_written(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [0.0]
    monkeypatch.setattr(emulated.time, "perf_counter", lambda: now[0])
    one, shaft = servo()
    shaft.blocked = True
    one.execute(Instruction.WRITE, bytes([30]) + word(800) + word(100))
    for _ in range(4):
        now[0] += 0.2
        alarm, data = one.execute(Instruction.READ, bytes([36, 8]))
    assert alarm == Alarm.OVERLOAD
    assert int.from_bytes(data[:2], "little") == 512  # the value is as good as ever
    assert (one.word(Register.TORQUE_LIMIT), one.table[Register.TORQUE_ENABLE], shaft.held) == (0, 0, False)
    one.execute(Instruction.WRITE, bytes([30]) + word(800))
    assert not shaft.held  # without a torque limit nothing turns
    shaft.blocked = False
    one.execute(Instruction.WRITE, bytes([34]) + word(600))
    alarm, _ = one.execute(Instruction.WRITE, bytes([24, 1]))
    assert (alarm, shaft.held) == (Alarm(0), True)


def test_a_hot_servo_lets_go_and_recovers_only_when_it_is_cool() -> None:
    one, shaft = servo()
    one.execute(Instruction.WRITE, bytes([30]) + word(800) + word(100))
    one.table[Register.PRESENT_TEMPERATURE] = 81
    assert one.execute(Instruction.PING, b"")[0] == Alarm.OVERHEAT
    assert not shaft.held
    one.execute(Instruction.WRITE, bytes([34]) + word(600))
    assert one.execute(Instruction.PING, b"")[0] == Alarm.OVERHEAT
    one.table[Register.PRESENT_TEMPERATURE] = 60
    one.execute(Instruction.WRITE, bytes([34]) + word(600))
    assert one.execute(Instruction.PING, b"")[0] == Alarm(0)


def test_packets_are_found_in_noise_and_halves_are_kept() -> None:
    ping = packet("FF FF 01 02 01 FB")
    buffer = bytearray(b"\x12\xff\x34" + ping + ping[:3])
    assert take(buffer) == (1, 1, b"", True)
    assert take(buffer) is None
    buffer += ping[3:5] + b"\x00"
    assert take(buffer) == (1, 1, b"", False)
    assert take(buffer) is None


def answered(ask: Callable[[], Any]) -> Any:
    """What the SDK gives once it was quick enough: a busy machine may miss its time-out."""
    for _ in range(20):
        result = ask()
        if result[1] == 0:
            return result
    raise AssertionError(result)


# --- the process, through the SDK as HARDWARE measured it ------------------------------------------------------------
def test_the_sdk_sees_what_hardware_says_it_sees() -> None:
    from dynamixel_sdk import PacketHandler, PortHandler

    bench = start()
    port, packets = PortHandler(bench.port), PacketHandler(1.0)
    assert port.setBaudRate(1_000_000)
    port.ser.timeout = 0.002
    assert answered(lambda: packets.ping(port, 1)) == (28, 0, 0)
    assert answered(lambda: packets.ping(port, 2)) == (64, 0, 0)
    position, _, alarm = answered(lambda: packets.read2ByteTxRx(port, 1, 36))
    assert alarm == 0
    seen = {}
    for kind in ("no_reply", "bad_checksum", "short", "overload"):
        time.sleep(0.05)  # what came late is behind us
        bench.bus.fault(kind)
        seen[kind] = packets.read2ByteTxRx(port, 1, 36)
    assert seen["no_reply"] == (0, -3001, 0)  # 0 is -150 deg
    assert seen["bad_checksum"] == (0, -3002, 0)
    assert seen["short"][1:] == (0, 0)  # success, with the checksum as the high byte
    assert seen["short"][0] != position
    assert seen["overload"] == (position, 0, 0x20)
    port.setBaudRate(57_600)
    assert packets.ping(port, 1)[1] == -3001  # the servos listen at another speed
    bench.bus.unplug()
    with pytest.raises(Exception, match=r"Input/output|disconnected"):
        packets.ping(port, 1)
    assert port.is_using
    assert packets.ping(port, 1)[1] == -1000
    bench.close()


def test_bytes_take_their_time_on_the_wire() -> None:
    from dynamixel_sdk import PacketHandler, PortHandler

    bench = start(baud=57_600, latency_ms=16.0)
    bench.bus.poke(1, Register.RETURN_DELAY, 250)
    port, packets = PortHandler(bench.port), PacketHandler(1.0)
    port.setBaudRate(57_600)
    took = []
    while len(took) < 5:  # a busy machine may miss the SDK's own time-out
        began = time.perf_counter()
        if packets.readTxRx(port, 1, 36, 8)[1] == 0:
            took.append(time.perf_counter() - began)
    needed = 22 * 10 / 57_600 + 5e-4 + 0.016
    assert needed < sorted(took)[2] < needed + 0.02
    port.closePort()
    bench.close()
