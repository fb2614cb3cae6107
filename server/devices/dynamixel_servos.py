"""What the owner of a bus does with its servos: set-up, one tick of reading and driving, and torque off.

For one thread only; `readings` alone are taken from another. HARDWARE's rules hold throughout: goals inside the
limits, one stroke long at most, torque limited; a stream leads by 40 ms at most; a speed is never 0, which would mean
as fast as it can.
"""

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from calib_core.sequence import Axis, Motion, Move
from server.devices import DeviceError, streaming
from server.devices.dynamixel_bus import Bus, NoReply
from server.devices.dynamixel_registers import (
    BLOCK,
    CODES,
    STEP_DEG,
    Alarm,
    Register,
    State,
    speed_code,
    state,
    to_code,
    word,
)
from server.devices.dynamixel_setup import TABLE, Setup, faults, unknown

log = logging.getLogger(__name__)
clock: Callable[[], float] = time.perf_counter

SILENT_S, MISSES = 0.4, 5  # a servo without a good reply for this long, and so many times, is gone
BUSY_S = 2.0  # it answers, but for this long the host never read it in time to know when
LET_GO_S = 0.5  # torque off is said again until it is seen, this long
KEEP = 3000  # readings kept for a reader who is late: half a minute
RESENDS = 5
FIRST_DPS = 10.0  # speed while a servo takes hold of where it stands
JUMP_STEPS = 6  # a reading may be this far from where the last and the top speed allow
JUMPS = 3  # as many wild readings in a row are the truth
SUPPLY_JUMP_V, TEMPERATURE_JUMP_DEGC = 2.5, 3.0
POWER = (Register.TORQUE_ENABLE, 12)  # torque, LED, compliance, goal, speed, torque limit
LOST = {"silent": "rig.servo_silent", "garbled": "rig.bus_noise", "unstamped": "rig.host_busy"}
FAULTS = {Alarm.OVERLOAD: "rig.overload", Alarm.OVERHEAT: "rig.overheat", Alarm.VOLTAGE: "rig.supply"}


@dataclass
class Course:
    """One motion under way: when it began, when its next goal is due, whether a lone goal has been seen to arrive."""

    motion: Motion
    began_s: float
    due_s: float
    sent: tuple[int, int] | None = None
    resends: int = 0
    done: bool = False

    def goal(self, now_s: float) -> tuple[int, int]:
        """Goal and speed registers."""
        angle, rate = streaming.goal(self.motion, now_s - self.began_s)
        return to_code(angle), speed_code(rate)

    def advance(self, now_s: float) -> None:
        """The goal has been sent; when is the next one?"""
        if isinstance(self.motion, Move):
            self.due_s = math.inf
            return
        self.due_s = max(self.due_s + streaming.PERIOD_S, now_s)
        if self.due_s > self.began_s + self.motion.start_s + self.motion.duration_s + streaming.PERIOD_S:
            self.due_s, self.done = math.inf, True


@dataclass
class Servo:
    """What the thread knows of one servo."""

    number: int
    highest_degC: float = math.inf
    powered: bool = False
    last: State | None = None
    seen_s: float = -math.inf
    heard_s: float = -math.inf  # also by replies whose time is not known
    missed: int = 0
    late: int = 0
    wild: int = 0
    course: Course | None = None
    readings: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=KEEP))


class Servos:
    """`numbers`: ids by axis. `torque_pct`: the torque limit. Sends nothing before `connect`."""

    def __init__(self, bus: Bus, numbers: Mapping[str, int], torque_pct: float) -> None:
        self.bus = bus
        self.each = {axis: Servo(number) for axis, number in numbers.items()}
        self.axes: dict[str, Axis] = {axis: unknown(axis) for axis in numbers}
        self.loose = True  # every torque has been seen to be off
        self.not_safe: DeviceError | None = None
        self._torque = max(1, min(CODES, round(torque_pct * 10.23)))

    def connect(self) -> None:
        """Port, torque off whatever the last owner left, and the set-up of both servos. Raises DeviceError."""
        self.bus.open()
        self.bus.write(Register.TORQUE_ENABLE, {servo.number: b"\0" for servo in self.each.values()})
        setups = {}
        for axis, servo in self.each.items():
            try:
                setups[axis] = Setup.of(self.bus.registers(servo.number, *TABLE))
            except NoReply as no:
                if self.bus.ping(servo.number):
                    raise DeviceError("rig.servo_quiet", axis=axis, id=servo.number) from no
                raise self._silent(axis, no) from no
        for fault in faults(setups, {axis: servo.number for axis, servo in self.each.items()}):
            raise fault
        self.bus.return_delay_s = max(found.return_delay_us for found in setups.values()) * 1e-6
        # A servo that shut itself down has the torque limit 0; writing another is half of its recovery.
        self.bus.write(Register.TORQUE_LIMIT, {servo.number: word(self._torque) for servo in self.each.values()})
        self.let_go()
        if self.not_safe is not None:
            raise self.not_safe
        now = clock()
        for axis, servo in self.each.items():
            servo.highest_degC = setups[axis].highest_degC
            servo.seen_s = servo.heard_s = now
            servo.last, servo.missed, servo.course = None, 0, None
            servo.readings.clear()
            self.bus.alarms(servo.number)  # of what was before
            self.axes[axis] = setups[axis].axis(axis)
        deadline = now + SILENT_S
        for axis in self.each:
            while self.each[axis].last is None and clock() < deadline + SILENT_S:
                self._poll(axis)

    def tick(self, stopped: Callable[[], bool]) -> None:
        """Goals that are due, then one reading of each servo, unless `stopped`. Raises what is wrong, DeviceError."""
        now = clock()
        goals = {}
        for axis, servo in self.each.items():
            course = servo.course
            if course is None:
                continue
            if not servo.powered:
                self._take_hold(axis)
            if servo.powered and course.due_s <= now:
                course.sent = course.goal(clock())
                goals[servo.number] = b"".join(map(word, course.sent))
                course.advance(now)
        if goals:
            self.bus.write(Register.GOAL_POSITION, goals)
        for axis, servo in self.each.items():
            if stopped():
                return
            self._poll(axis)
            course = servo.course
            if course is not None and course.sent is not None and isinstance(course.motion, Move):
                self._confirm(axis, course)
            if course is not None and course.done:
                servo.course = None

    def _poll(self, axis: str) -> None:
        """One reading, if a good one comes."""
        servo = self.each[axis]
        try:
            reply = self.bus.read(servo.number, *BLOCK)
        except NoReply as no:
            self._missed(axis, no)
            return
        said = state(reply.data)
        if said is None or not self._likely(axis, said, reply.time_s):
            self.bus.lost["garbled"] += 1
            self._missed(axis, NoReply("garbled"))
            return
        servo.seen_s = servo.heard_s = reply.time_s
        servo.last, servo.missed, servo.wild = said, 0, 0
        servo.readings.append((reply.time_s, said.angle_deg))
        self._watch(axis, said)

    def _likely(self, axis: str, said: State, time_s: float) -> bool:
        """Eight bits of checksum let one garbled packet in 256 pass; a shaft, its supply and its heat do not jump."""
        servo = self.each[axis]
        if servo.last is None or servo.wild >= JUMPS:
            return True
        steps = self.axes[axis].max_rate_dps * (time_s - servo.seen_s) / STEP_DEG + JUMP_STEPS
        near = (
            abs(said.code - servo.last.code) <= steps
            and abs(said.supply_V - servo.last.supply_V) <= SUPPLY_JUMP_V
            and abs(said.temperature_degC - servo.last.temperature_degC) <= TEMPERATURE_JUMP_DEGC
        )
        servo.wild += not near
        return near

    def _missed(self, axis: str, no: NoReply) -> None:
        servo = self.each[axis]
        servo.missed += 1
        now = clock()
        if no.why == "unstamped":
            servo.heard_s = now
            servo.late += 1
        if servo.missed > MISSES and (now - servo.heard_s > SILENT_S or now - servo.seen_s > BUSY_S):
            raise self._silent(axis, no)

    def _silent(self, axis: str, no: NoReply) -> DeviceError:
        return DeviceError(LOST[no.why], axis=axis, part=self.axes[axis].part, id=self.each[axis].number)

    def _watch(self, axis: str, said: State) -> None:
        """Raises what the servo complains of."""
        alarm = self.bus.alarms(self.each[axis].number)
        who = {"axis": axis, "part": self.axes[axis].part, "load_pct": abs(said.load_pct), "supply_V": said.supply_V}
        who |= {"temperature_degC": said.temperature_degC, "highest_degC": self.each[axis].highest_degC}
        if not self.each[axis].powered:
            alarm &= ~(Alarm.OVERLOAD | Alarm.OVERHEAT)  # they may stay until the torque is on again
        if said.temperature_degC > self.each[axis].highest_degC:
            alarm |= Alarm.OVERHEAT
        for bit, code in FAULTS.items():
            if alarm & bit:
                raise DeviceError(code, **who)

    def _take_hold(self, axis: str) -> None:
        """Torque on where the shaft stands: with an old goal in its register a servo would jump there."""
        servo = self.each[axis]
        if servo.last is None:
            return
        here = word(servo.last.code) + word(speed_code(FIRST_DPS))
        self.loose = False
        self.bus.write(Register.GOAL_POSITION, {servo.number: here})
        self.bus.write(Register.TORQUE_LIMIT, {servo.number: word(self._torque)})
        self.bus.write(Register.TORQUE_ENABLE, {servo.number: b"\1"})
        try:
            power = self.bus.registers(servo.number, *POWER, tries=1)
        except NoReply:
            return
        servo.powered = power[0] == 1 and power[6:] == here + word(self._torque)

    def _confirm(self, axis: str, course: Course) -> None:
        """A lone goal is written without an answer: read it back, and send it again where it was lost."""
        assert course.sent is not None
        servo = self.each[axis]
        try:
            power = self.bus.registers(servo.number, *POWER, tries=1)
        except NoReply:
            return
        if power[0] == 1 and power[6:10] == word(course.sent[0]) + word(course.sent[1]):
            course.done = True
            return
        if servo.last is not None:
            self._watch(axis, servo.last)  # a servo that shut itself down takes no goal
        if course.resends >= RESENDS:
            raise DeviceError("rig.command_lost", axis=axis, part=self.axes[axis].part)
        course.resends, course.due_s = course.resends + 1, -math.inf

    def let_go(self) -> None:
        """Torque off, first of all; then look whether it is: `loose`, or else `not_safe` says why not."""
        self.not_safe = None
        off = {servo.number: b"\0" for servo in self.each.values()}
        waiting = dict(self.each)
        for servo in self.each.values():
            servo.course = None
        try:
            until = clock() + LET_GO_S
            while clock() < until:
                self.bus.write(Register.TORQUE_ENABLE, off)
                for axis, servo in list(waiting.items()):
                    try:
                        if self.bus.registers(servo.number, *POWER, tries=1)[0] == 0:
                            servo.powered = False
                            del waiting[axis]
                    except NoReply:
                        continue
                if not waiting:
                    self.loose = True
                    return
        except DeviceError as fault:
            log.warning("torque off: %s", fault)
        self.loose = False
        self.not_safe = DeviceError("rig.not_safe", axis=", ".join(waiting))
