"""The fault campaign: HARDWARE's ways for a servo bus to fail, each many times, and what the driver makes of them.

While both axes swing, faults of one kind are injected at random moments. A reading counts as wrong where it is not
where the shaft truly was at its time stamp. A fault that ends a run must leave the torque off, and the next run must
work. Everything is drawn from the seed, the bus's own clock apart.
"""

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib_core.sequence import Move, Wave
from server.devices import DeviceError
from server.devices.dynamixel_registers import STEP_DEG, Register
from server.devices.dynamixel_table import DynamixelTable

SWING_DEG, SWING_HZ = 60.0, 0.25
PEAK_DPS = 2.0 * np.pi * SWING_HZ * SWING_DEG
# A stamp is off by at most half of what a transaction may take too long; a tenth of a degree is the lag's jitter.
ALLOWED_DEG = STEP_DEG / 2.0 + PEAK_DPS * 0.003 + 0.1
PASSING = ("no_reply", "bad_checksum", "truncated", "short", "late", "held", "wrong_id", "noise", "babble")
ENDING = {
    "overload": "rig.overload",
    "heat": "rig.overheat",
    "silent": "rig.servo_silent",
    "port_gone": "rig.port_gone",
}
UNREADABLE = ("rig.bus_noise", "rig.servo_silent", "rig.host_busy")
KINDS = (*PASSING, *ENDING)
PATIENCE_S = 10.0
OPENINGS = 5


@dataclass
class Outcome:
    """Of one kind of fault: how many there were, readings taken and wrong ones, runs that hung, torque left on.

    `ended`: faults that a run should survive and did not (on a machine too busy to read between two of them).
    """

    kind: str
    injected: int = 0
    readings: int = 0
    wrong: int = 0
    worst_deg: float = 0.0
    hung: int = 0
    torque_on: int = 0
    ended: int = 0
    surprises: list[str] = field(default_factory=list)

    @property
    def clean(self) -> bool:
        return not (self.wrong or self.hung or self.torque_on or self.surprises)


class Campaign:
    """Faults on a bench's `bus` and `plant` (control channels) under a table's driver."""

    def __init__(self, table: DynamixelTable, bus: Any, plant: Any, seed: int = 1) -> None:
        self.table, self.bus, self.plant = table, bus, plant
        self._rng = random.Random(seed)
        self._swinging_until = 0.0

    def run(self, kind: str, count: int) -> Outcome:
        """`count` faults of this kind."""
        outcome = Outcome(kind)
        self._begin()
        inject = self._pass if kind in PASSING else self._end
        while outcome.injected < count:
            inject(outcome)
        self._take(outcome)
        self.table.safe()
        self.bus.mend()
        return outcome

    def _open(self) -> None:
        """A busy machine may need more than one try."""
        for left in reversed(range(OPENINGS)):
            try:
                self.table.open()
                return
            except DeviceError:
                if not left:
                    raise

    def _begin(self) -> None:
        self._open()
        self.table.start([Move(axis, 0.0, 100.0) for axis in self.table.axes])
        self._until(lambda: all(abs(self.plant.shaft(axis)[0]) < 0.5 for axis in self.table.axes))
        self.table.read()
        self._swing()

    def _swing(self) -> None:
        self.table.start([Wave(axis, (SWING_DEG,), (SWING_HZ,), 600.0) for axis in self.table.axes])

    def _until(self, there: Callable[[], bool]) -> bool:
        until = time.perf_counter() + PATIENCE_S
        while not there():
            if time.perf_counter() > until:
                return False
            time.sleep(0.002)
        return True

    def _loose(self, servos: Sequence[int]) -> bool:
        """Whether the torque of these goes off."""
        return self._until(lambda: not any(self.bus.peek(n, Register.TORQUE_ENABLE)[0] for n in servos))

    def _take(self, outcome: Outcome) -> DeviceError | None:
        """New readings, held against the truth; the fault, if one ended them."""
        try:
            taken = self.table.read()
        except DeviceError as fault:
            return fault
        for axis, readings in taken.items():
            if len(readings.time_s):
                error = np.abs(readings.angle_deg - self.plant.angles(axis, readings.time_s))
                outcome.readings += len(error)
                outcome.wrong += int((error > ALLOWED_DEG).sum())
                outcome.worst_deg = max(outcome.worst_deg, float(error.max()))
        return None

    def _pass(self, outcome: Outcome) -> None:
        """One fault that a run survives: the readings go on after it, and all of them are true."""
        servo = self._rng.choice((1, 2))
        match outcome.kind:
            case "babble":
                self.bus.babble(self._rng.randint(1, 300))
            case "late":
                self.bus.fault("late", servo, seconds=self._rng.uniform(0.005, 0.08))
            case "held":
                self.bus.fault("late", servo, seconds=0.0)
            case kind:
                self.bus.fault(kind, servo)
        outcome.injected += 1
        before = self.table.bus.good
        ended: list[DeviceError] = []

        def over() -> bool:
            fault = self._take(outcome)
            ended.extend([fault] if fault else [])
            return bool(ended) or (self.bus.pending() == 0 and self.table.bus.good > before + 1)

        outcome.hung += not self._until(over)
        fault = ended[0] if ended else None
        if fault is not None:
            outcome.ended += 1
            outcome.torque_on += not self._loose((1, 2))
            if fault.code not in UNREADABLE:
                outcome.surprises.append(str(fault))
            self.bus.mend()
            self._begin()
        elif self.table.bus.good % 20_000 < 4:
            self._swing()

    def _end(self, outcome: Outcome) -> None:
        """One fault that ends a run: with its own reason, the torque off, and the next run works."""
        servo = self._rng.choice((1, 2))
        time.sleep(self._rng.uniform(0.0, 0.03))
        match outcome.kind:
            case "overload":  # a servo goes on saying it: one such reply may be lost on a busy machine
                self.bus.fault("overload", servo, 5)
            case "port_gone":
                self.bus.unplug()
            case "silent":
                self.bus.silence(servo)
            case "heat":
                self.bus.poke(servo, Register.PRESENT_TEMPERATURE, 85)
        outcome.injected += 1
        ended: list[DeviceError] = []

        def over() -> bool:
            fault = self._take(outcome)
            ended.extend([fault] if fault else [])
            return bool(ended)

        outcome.hung += not self._until(over)
        if ended and ended[0].code in UNREADABLE:
            outcome.ended += outcome.kind != "silent"
        elif ended and ended[0].code != ENDING[outcome.kind]:
            outcome.surprises.append(str(ended[0]))
        self.bus.mend()
        if outcome.kind == "port_gone":
            self.bus.plug()
        alive = [n for n in (1, 2) if outcome.kind != "silent" or n != servo]
        outcome.torque_on += not self._loose(alive)
        if outcome.kind == "silent":
            self.bus.rejoin(servo)
        if outcome.kind == "heat":
            self.bus.poke(servo, Register.PRESENT_TEMPERATURE, 34)
        try:
            self._open()
            self.table.read()
            self._swing()
        except DeviceError as fault:
            outcome.surprises.append(f"afterwards: {fault}")
            self._begin()
        if not self._until(lambda: all(said.torque_on for said in self.table.telemetry().values())):
            outcome.surprises.append("afterwards: no torque")
