"""The real table: two Dynamixel servos on one bus, owned by one thread.

The thread reads both servos a hundred times a second and streams goals fifty times a second. Callers leave what they
want under a lock and never touch the bus. HARDWARE's rules hold throughout: goals inside the limits, one stroke long
at most, torque limited; a stream leads by 40 ms at most; a speed is never 0, which would mean as fast as it can;
torque goes off first at every start, on every fault, and once more when a port that went away comes back.
"""

import logging
import math
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from calib_core.sequence import Axis, Motion, Move
from server.devices import DeviceError, streaming
from server.devices.dynamixel_bus import Bus, NoReply
from server.devices.dynamixel_registers import (
    BLOCK,
    CENTRE,
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
from server.devices.protocols import Readings, Telemetry

log = logging.getLogger(__name__)
clock: Callable[[], float] = time.perf_counter

PERIOD_S = 0.009  # a row is 0.01 s: a reading that a busy host spoils is made up for
IDLE_S = 0.2  # between polls while nobody reads
WANTED_S = 2.0  # after the last read
HEARTBEAT_S = 10.0  # nobody has read for this long, and the torque is on: whoever moved the table is gone
NAP_S = 0.002  # a stop waits at most this long for the thread to look up, plus one transaction
SILENT_S, MISSES = 0.4, 5  # a servo without a good reply for this long, and so many times, is gone
BUSY_S = 2.0  # it answers, but for this long the host never read it in time to know when
RETRY_S = 0.2  # a port that went away is looked for this often
OPEN_S, SAFE_S = 8.0, 1.0
LET_GO_S = 0.5  # torque off is said again until it is seen, this long
KEEP = 3000  # readings kept for a reader who is late: half a minute
RESENDS = 5
URGENT = -10
SWITCH_S = 1e-4  # a thread that computes gives the interpreter up this soon: a reply has 3 ms to be stamped
FIRST_DPS = 10.0  # speed while a servo takes hold of where it stands
JUMP_STEPS = 6  # a reading may be this far from where the last and the top speed allow
JUMPS = 3  # as many wild readings in a row are the truth
SUPPLY_JUMP_V, TEMPERATURE_JUMP_DEGC = 2.5, 3.0
POWER = (Register.TORQUE_ENABLE, 12)  # torque, LED, compliance, goal, speed, torque limit
LOST = {"silent": "rig.servo_silent", "garbled": "rig.bus_noise", "unstamped": "rig.host_busy"}
FAULTS = {Alarm.OVERLOAD: "rig.overload", Alarm.OVERHEAT: "rig.overheat", Alarm.VOLTAGE: "rig.supply"}


@dataclass
class _Course:
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
class _Servo:
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
    course: _Course | None = None
    readings: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=KEEP))


class DynamixelTable:
    """`ids` by axis. `torque_pct`: the torque limit. `latency`: the adapter's latency timer, ms (None: ask the system).

    Raises nothing and sends nothing before `open`.
    """

    def __init__(
        self,
        port: str,
        ids: Mapping[str, int],
        *,
        baud: int = 1_000_000,
        latency: float | None = None,
        torque_pct: float = 60.0,
    ) -> None:
        self.bus = Bus(port, baud, latency)
        self._torque = max(1, min(CODES, round(torque_pct * 10.23)))
        self._servos = {axis: _Servo(number) for axis, number in ids.items()}
        self._axes: dict[str, Axis] = {axis: unknown(axis) for axis in ids}
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closing = False
        self._opens = self._opened = self._halts = self._halted = 0
        self._new: dict[str, _Course] = {}
        self._fault: DeviceError | None = None
        self._not_safe: DeviceError | None = None
        self._loose = True
        self._read_s = -math.inf

    @property
    def axes(self) -> Mapping[str, Axis]:
        return self._axes

    @property
    def ids(self) -> dict[str, int]:
        return {axis: servo.number for axis, servo in self._servos.items()}

    # --- for callers, from any thread --------------------------------------------------------------------------
    def open(self) -> None:
        """Connect, or look again: torque off, then the servos' set-up. Raises DeviceError."""
        with self._changed:
            if self._thread is None or not self._thread.is_alive():
                self._closing = False
                self._thread = threading.Thread(target=self._own, name="servo bus", daemon=True)
                self._thread.start()
            self._opens += 1
            mine = self._opens
            self._changed.notify_all()
            if not self._changed.wait_for(lambda: self._opened >= mine, OPEN_S):
                raise DeviceError("rig.servo_silent", part=self.bus.port)
            if self._fault is not None:
                raise self._fault

    def start(self, motions: Sequence[Motion]) -> float:
        """Begin these motions together, now; each is checked against its axis first. Raises Problem."""
        now = clock()
        courses = {motion.axis: _Course(motion, now, now + motion.start_s) for motion in motions}
        for motion in motions:
            for angle in _ends(motion):
                self._axes[motion.axis].check(angle, motion.peak_rate_dps)
        with self._changed:
            if self._fault is not None:
                raise self._fault
            self._new |= courses
            self._read_s = now
            self._changed.notify_all()
            return now

    def read(self) -> dict[str, Readings]:
        """Every good reading since the last call. Raises the fault that ended them."""
        with self._changed:
            now = clock()
            idle, self._read_s = now - self._read_s > WANTED_S, now
            if idle:
                self._changed.notify_all()
            if self._fault is not None:
                raise self._fault
            taken = {}
            for axis, servo in self._servos.items():
                pairs = np.array(servo.readings).reshape(-1, 2)
                servo.readings.clear()
                taken[axis] = Readings(pairs[:, 0], pairs[:, 1], servo.heard_s, servo.late)
                servo.late = 0
            return taken

    def telemetry(self) -> dict[str, Telemetry]:
        """What the servos last said of themselves. Raises the fault that ended it."""
        if self._fault is not None:
            raise self._fault
        said = {}
        for axis, servo in self._servos.items():
            last = servo.last or State(CENTRE, 0.0, 0.0, math.nan, math.nan)
            said[axis] = Telemetry(last.supply_V, last.temperature_degC, last.load_pct, servo.powered)
        return said

    def safe(self) -> None:
        """Torque off on every axis, and seen to be off. Raises DeviceError where it cannot be seen."""
        with self._changed:
            self._new.clear()
            if self._thread is None or not self._thread.is_alive():
                return
            self._halts += 1
            mine = self._halts
            self._changed.notify_all()
            if not self._changed.wait_for(lambda: self._halted >= mine, SAFE_S):
                raise DeviceError("rig.not_safe")
            if self._not_safe is not None:
                raise self._not_safe

    def close(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify_all()
            thread = self._thread
        if thread is not None:
            thread.join(OPEN_S)

    # --- the owner thread --------------------------------------------------------------------------------------
    def _own(self) -> None:
        if sys.platform == "linux":
            with suppress(PermissionError):  # a reading that waits for the host cannot be stamped
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), URGENT)
        usual = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        try:
            while not self._closing:
                with self._changed:
                    self._changed.wait_for(self._called, None if self._loose else RETRY_S)
                    opens, self._new = self._opens, {}
                if not self._closing:
                    self._try(opens)
        finally:
            if not self._loose:
                self._let_go()
            self.bus.close()
            sys.setswitchinterval(usual)
            with self._changed:
                self._opened, self._halted = self._opens, self._halts
                self._changed.notify_all()

    def _called(self) -> bool:
        return self._closing or self._opened < self._opens or self._halted < self._halts

    def _urgent(self) -> bool:
        return self._called() or bool(self._new) or clock() - self._read_s < IDLE_S

    def _try(self, opens: int) -> None:
        """Connect and drive until something ends it; what ended it is this table's fault until the next `open`."""
        try:
            if opens > self._opened:
                self._connect()
                with self._changed:
                    self._fault, self._opened = None, opens
                    self._changed.notify_all()
                self._drive()
            elif not self._loose:  # a fault ended a run with the torque on: as soon as the port is back, off
                self.bus.open()
                self._let_go()
        except DeviceError as fault:
            self._fail(fault, opens)
        except Exception as error:
            log.exception("the servo bus's thread")
            self._fail(DeviceError("internal", kind=type(error).__name__, detail=str(error)), opens)
        if self._halted < self._halts:
            self._halt()

    def _fail(self, fault: DeviceError, opens: int) -> None:
        if not self._loose and fault.code != "rig.port_gone":
            self._let_go()
        self.bus.close()
        with self._changed:
            if self._fault is None or opens > self._opened:
                self._fault = fault
            self._opened = opens
            self._changed.notify_all()

    def _connect(self) -> None:
        """Port, torque off whatever the last owner left, and the set-up of both servos. Raises DeviceError."""
        self.bus.open()
        self.bus.write(Register.TORQUE_ENABLE, {servo.number: b"\0" for servo in self._servos.values()})
        setups = {}
        for axis, servo in self._servos.items():
            try:
                setups[axis] = Setup.of(self.bus.registers(servo.number, *TABLE))
            except NoReply as no:
                if self.bus.ping(servo.number):
                    raise DeviceError("rig.servo_quiet", axis=axis, id=servo.number) from no
                raise self._silent(axis, no) from no
        for fault in faults(setups, self.ids):
            raise fault
        self.bus.return_delay_s = max(found.return_delay_us for found in setups.values()) * 1e-6
        # A servo that shut itself down has the torque limit 0; writing another is half of its recovery.
        self.bus.write(Register.TORQUE_LIMIT, {servo.number: word(self._torque) for servo in self._servos.values()})
        self._let_go()
        if self._not_safe is not None:
            raise self._not_safe
        now = clock()
        for axis, servo in self._servos.items():
            servo.highest_degC = setups[axis].highest_degC
            servo.seen_s = servo.heard_s = now
            servo.last, servo.missed, servo.course = None, 0, None
            servo.readings.clear()
            self.bus.alarms(servo.number)  # of what was before
            self._axes[axis] = setups[axis].axis(axis)
        deadline = now + SILENT_S
        for axis in self._servos:
            while self._servos[axis].last is None and clock() < deadline + SILENT_S:
                self._poll(axis)

    def _drive(self) -> None:
        """Ticks until closed or asked to open again. Raises DeviceError."""
        due = clock()
        while True:
            with self._changed:
                if self._closing or self._opened < self._opens:
                    return
                halts, new, self._new = self._halts, self._new, {}
                unread_s = clock() - self._read_s
            if halts > self._halted:
                self._halt()
                continue
            for axis, course in new.items():
                self._servos[axis].course = course
            self._tick(clock())
            if unread_s > HEARTBEAT_S and not self._loose:
                log.warning("nobody reads: torque off")
                self._let_go()
            watched = unread_s < WANTED_S or any(servo.course is not None for servo in self._servos.values())
            period, now = PERIOD_S if watched else IDLE_S, clock()
            due = min(max(due + period, now), now + period)
            self._nap(due)

    def _nap(self, until: float) -> None:
        """Wait for the next tick or a caller. Short sleeps, because a condition's wait is coarse on Windows."""
        while (left := until - clock()) > 0.0 and not (self._called() or self._new):
            if left > 2.0 * PERIOD_S:
                with self._changed:
                    self._changed.wait_for(self._urgent, left)
                return
            time.sleep(min(left, NAP_S))

    def _tick(self, now: float) -> None:
        goals = {}
        for axis, servo in self._servos.items():
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
        for axis, servo in self._servos.items():
            if self._halted < self._halts:
                return
            self._poll(axis)
            course = servo.course
            if course is not None and course.sent is not None and isinstance(course.motion, Move):
                self._confirm(axis, course)
            if course is not None and course.done:
                servo.course = None

    def _poll(self, axis: str) -> None:
        """One reading, if a good one comes."""
        servo = self._servos[axis]
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
        with self._changed:
            servo.readings.append((reply.time_s, said.angle_deg))
        self._watch(axis, said)

    def _likely(self, axis: str, said: State, time_s: float) -> bool:
        """Eight bits of checksum let one garbled packet in 256 pass; a shaft, its supply and its heat do not jump."""
        servo = self._servos[axis]
        if servo.last is None or servo.wild >= JUMPS:
            return True
        steps = self._axes[axis].max_rate_dps * (time_s - servo.seen_s) / STEP_DEG + JUMP_STEPS
        near = (
            abs(said.code - servo.last.code) <= steps
            and abs(said.supply_V - servo.last.supply_V) <= SUPPLY_JUMP_V
            and abs(said.temperature_degC - servo.last.temperature_degC) <= TEMPERATURE_JUMP_DEGC
        )
        servo.wild += not near
        return near

    def _missed(self, axis: str, no: NoReply) -> None:
        servo = self._servos[axis]
        servo.missed += 1
        now = clock()
        if no.why == "unstamped":
            servo.heard_s = now
            servo.late += 1
        if servo.missed > MISSES and (now - servo.heard_s > SILENT_S or now - servo.seen_s > BUSY_S):
            raise self._silent(axis, no)

    def _silent(self, axis: str, no: NoReply) -> DeviceError:
        return DeviceError(LOST[no.why], axis=axis, part=self._axes[axis].part, id=self._servos[axis].number)

    def _watch(self, axis: str, said: State) -> None:
        """Raises what the servo complains of."""
        alarm = self.bus.alarms(self._servos[axis].number)
        who = {"axis": axis, "part": self._axes[axis].part, "load_pct": abs(said.load_pct), "supply_V": said.supply_V}
        who |= {"temperature_degC": said.temperature_degC, "highest_degC": self._servos[axis].highest_degC}
        if not self._servos[axis].powered:
            alarm &= ~(Alarm.OVERLOAD | Alarm.OVERHEAT)  # they may stay until the torque is on again
        if said.temperature_degC > self._servos[axis].highest_degC:
            alarm |= Alarm.OVERHEAT
        for bit, code in FAULTS.items():
            if alarm & bit:
                raise DeviceError(code, **who)

    # --- torque ------------------------------------------------------------------------------------------------
    def _take_hold(self, axis: str) -> None:
        """Torque on where the shaft stands: with an old goal in its register a servo would jump there."""
        servo = self._servos[axis]
        if servo.last is None:
            return
        here = word(servo.last.code) + word(speed_code(FIRST_DPS))
        self._loose = False
        self.bus.write(Register.GOAL_POSITION, {servo.number: here})
        self.bus.write(Register.TORQUE_LIMIT, {servo.number: word(self._torque)})
        self.bus.write(Register.TORQUE_ENABLE, {servo.number: b"\1"})
        try:
            power = self.bus.registers(servo.number, *POWER, tries=1)
        except NoReply:
            return
        servo.powered = power[0] == 1 and power[6:] == here + word(self._torque)

    def _confirm(self, axis: str, course: _Course) -> None:
        """A lone goal is written without an answer: read it back, and send it again where it was lost."""
        assert course.sent is not None
        servo = self._servos[axis]
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
            raise DeviceError("rig.command_lost", axis=axis, part=self._axes[axis].part)
        course.resends, course.due_s = course.resends + 1, -math.inf

    def _halt(self) -> None:
        """What `safe` asks for."""
        halts = self._halts
        try:
            if not self._loose or self.bus.is_open:
                if not self.bus.is_open:
                    self.bus.open()
                self._let_go()
        except DeviceError as fault:
            log.warning("torque off: %s", fault)
            self._not_safe = DeviceError("rig.not_safe", axis=", ".join(self._servos))
        finally:
            with self._changed:
                self._halted = halts
                self._changed.notify_all()

    def _let_go(self) -> None:
        """Torque off, first of all; then look whether it is."""
        self._not_safe = None
        off = {servo.number: b"\0" for servo in self._servos.values()}
        waiting = dict(self._servos)
        for servo in self._servos.values():
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
                    self._loose = True
                    return
        except DeviceError as fault:
            log.warning("torque off: %s", fault)
        self._loose = False
        self._not_safe = DeviceError("rig.not_safe", axis=", ".join(waiting))


def _ends(motion: Motion) -> tuple[float, float]:
    """The extreme angles of a motion."""
    return (motion.to_deg, motion.to_deg) if isinstance(motion, Move) else (motion.peak_deg, -motion.peak_deg)
