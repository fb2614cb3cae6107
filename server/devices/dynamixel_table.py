"""The real table: two Dynamixel servos on one bus, owned by one thread.

The thread reads both servos a hundred times a second and streams goals fifty times a second. Callers leave what they
want under a lock and never touch the bus. Torque goes off first at every start, on every fault, and once more when a
port that went away comes back.
"""

import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

import numpy as np

from calib_core.sequence import Axis, Motion, Move
from server.devices import DeviceError
from server.devices.dynamixel_bus import Bus
from server.devices.dynamixel_registers import CENTRE, State
from server.devices.dynamixel_servos import Course, Servos
from server.devices.protocols import Readings, Telemetry

log = logging.getLogger(__name__)
clock: Callable[[], float] = time.perf_counter

PERIOD_S = 0.009  # a row is 0.01 s: a reading that a busy host spoils is made up for
IDLE_S = 0.2  # between polls while nobody reads
WANTED_S = 2.0  # after the last read
HEARTBEAT_S = 10.0  # nobody has read for this long, and the torque is on: whoever moved the table is gone
NAP_S = 0.002  # a stop waits at most this long for the thread to look up, plus one transaction
RETRY_S = 0.2  # a port that went away is looked for this often
OPEN_S, SAFE_S = 8.0, 1.0
URGENT = -10
SWITCH_S = 1e-4  # a thread that computes gives the interpreter up this soon: a reply has 3 ms to be stamped


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
        self._servos = Servos(self.bus, ids, torque_pct)
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closing = False
        self._opens = self._opened = self._halts = self._halted = 0
        self._new: dict[str, Course] = {}
        self._fault: DeviceError | None = None
        self._read_s = -math.inf

    @property
    def axes(self) -> Mapping[str, Axis]:
        return self._servos.axes

    @property
    def ids(self) -> dict[str, int]:
        return {axis: servo.number for axis, servo in self._servos.each.items()}

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
        courses = {motion.axis: Course(motion, now, now + motion.start_s) for motion in motions}
        for motion in motions:
            for angle in _ends(motion):
                self._servos.axes[motion.axis].check(angle, motion.peak_rate_dps)
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
            for axis, servo in self._servos.each.items():
                new = [
                    servo.readings.popleft() for _ in range(len(servo.readings))
                ]  # the thread may add some meanwhile
                pairs = np.array(new).reshape(-1, 2)
                taken[axis] = Readings(pairs[:, 0], pairs[:, 1], servo.heard_s, servo.late)
                servo.late = 0
            return taken

    def telemetry(self) -> dict[str, Telemetry]:
        """What the servos last said of themselves. Raises the fault that ended it."""
        if self._fault is not None:
            raise self._fault
        said = {}
        for axis, servo in self._servos.each.items():
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
            if self._servos.not_safe is not None:
                raise self._servos.not_safe

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
                    self._changed.wait_for(self._called, None if self._servos.loose else RETRY_S)
                    opens, self._new = self._opens, {}
                if not self._closing:
                    self._try(opens)
        finally:
            if not self._servos.loose:
                self._servos.let_go()
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
                self._servos.connect()
                with self._changed:
                    self._fault, self._opened = None, opens
                    self._changed.notify_all()
                self._drive()
            elif not self._servos.loose:  # a fault ended a run with the torque on: as soon as the port is back, off
                self.bus.open()
                self._servos.let_go()
        except DeviceError as fault:
            self._fail(fault, opens)
        except Exception as error:
            log.exception("the servo bus's thread")
            self._fail(DeviceError("internal", kind=type(error).__name__, detail=str(error)), opens)
        if self._halted < self._halts:
            self._halt()

    def _fail(self, fault: DeviceError, opens: int) -> None:
        if not self._servos.loose and fault.code != "rig.port_gone":
            self._servos.let_go()
        self.bus.close()
        with self._changed:
            if self._fault is None or opens > self._opened:
                self._fault = fault
            self._opened = opens
            self._changed.notify_all()

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
                self._servos.each[axis].course = course
            self._servos.tick(lambda: self._halted < self._halts)
            if unread_s > HEARTBEAT_S and not self._servos.loose:
                log.warning("nobody reads: torque off")
                self._servos.let_go()
            watched = unread_s < WANTED_S or any(servo.course is not None for servo in self._servos.each.values())
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

    def _halt(self) -> None:
        """What `safe` asks for."""
        halts = self._halts
        try:
            if not self._servos.loose or self.bus.is_open:
                if not self.bus.is_open:
                    self.bus.open()
                self._servos.let_go()
        except DeviceError as fault:
            log.warning("torque off: %s", fault)
            self._servos.not_safe = DeviceError("rig.not_safe", axis=", ".join(self._servos.each))
        finally:
            with self._changed:
                self._halted = halts
                self._changed.notify_all()


def _ends(motion: Motion) -> tuple[float, float]:
    """The extreme angles of a motion."""
    return (motion.to_deg, motion.to_deg) if isinstance(motion, Move) else (motion.peak_deg, -motion.peak_deg)
