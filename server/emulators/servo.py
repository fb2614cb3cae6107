"""One emulated servo: control table, instructions and alarms, with the plant's shaft behind it.

Written from the e-manual, not from the driver: what the driver takes for granted is what has to be found here.
"""

import time
from collections.abc import Callable
from enum import IntEnum

from server.devices.dynamixel_registers import (
    CENTRE,
    CODES,
    MODELS,
    SPEED_DPS,
    STEP_DEG,
    Alarm,
    Register,
    to_deg,
    word,
)

SIZE = 50
EEPROM_END = 24
OVERLOAD_S = 0.5  # a blocked shaft is let go of after this long
STUCK_DEG = 1.5
WORD = (0, CODES)
RANGES = {  # address: (bytes, lowest, highest) of what may be written (manual, "Control Table Data Range")
    3: (1, 0, 253), 4: (1, 0, 254), 5: (1, 0, 254), 6: (2, *WORD), 8: (2, *WORD), 11: (1, 0, 150), 12: (1, 50, 250),
    13: (1, 50, 250), 14: (2, *WORD), 16: (1, 0, 2), 17: (1, 0, 127), 18: (1, 0, 127), 19: (1, 0, 1), 24: (1, 0, 1),
    25: (1, 0, 1), 26: (1, 0, 254), 27: (1, 0, 254), 28: (1, 1, 254), 29: (1, 1, 254), 30: (2, *WORD), 32: (2, 0, 2047),
    34: (2, *WORD), 44: (1, 0, 1), 47: (1, 1, 1), 48: (2, *WORD),
}  # fmt: skip
WRITABLE = {address + i for address, (width, _, _) in RANGES.items() for i in range(width)}


class Instruction(IntEnum):
    PING = 1
    READ = 2
    WRITE = 3
    REG_WRITE = 4
    ACTION = 5
    RESET = 6
    SYNC_WRITE = 0x83


Shaft = Callable[[], tuple[float, float]]  # angle (deg) and rate (deg/s), now
Turn = Callable[[float, float], None]  # goal (deg), rate (deg/s)


def factory(model: int) -> bytearray:
    """The control table as it leaves the factory."""
    table = bytearray(SIZE)
    table[0:4] = bytes([model, 0, 24, 1])
    table[4:10] = bytes([34, 250, 0, 0]) + word(CODES)
    table[11:19] = bytes([80, 60, 240 if model == 64 else 160]) + word(CODES) + bytes([2, 36, 36])
    table[26:30] = bytes([0, 0, 32, 32])
    table[34:36] = word(CODES)
    table[42:44] = bytes([121, 34])
    table[48:50] = word(32)
    return table


class Servo:
    """Control table and alarms; the shaft is `shaft()`, turned by `turn` and released by `let_go`."""

    def __init__(self, model: int, number: int, shaft: Shaft, turn: Turn, let_go: Callable[[], None]) -> None:
        self.table = factory(model)
        self.table[Register.ID] = number
        self.alarm = Alarm(0)
        self._shaft, self._turn, self._let_go = shaft, turn, let_go
        self._waiting: tuple[int, bytes] | None = None
        self._stuck_since: float | None = None
        self._top_dps = MODELS[model].dps_per_volt
        self._look()
        self.table[30:32] = self.table[36:38]

    @property
    def number(self) -> int:
        return self.table[Register.ID]

    def word(self, address: int) -> int:
        return int.from_bytes(self.table[address : address + 2], "little")

    # --- instructions ------------------------------------------------------------------------------------------
    def execute(self, instruction: int, parameters: bytes) -> tuple[Alarm, bytes]:
        """The error bits and data of the reply."""
        self._look()
        error, data = Alarm(0), b""
        match instruction:
            case Instruction.PING:
                pass
            case Instruction.READ if len(parameters) == 2 and parameters[1] and sum(parameters) <= SIZE:
                data = bytes(self.table[parameters[0] : sum(parameters)])
            case Instruction.WRITE if parameters:
                error = self.write(parameters[0], parameters[1:])
            case Instruction.REG_WRITE if parameters:
                self._waiting = parameters[0], parameters[1:]
                self.table[Register.REGISTERED] = 1
            case Instruction.ACTION if self._waiting is not None:
                error = self.write(*self._waiting)
                self._waiting = None
                self.table[Register.REGISTERED] = 0
            case Instruction.RESET:
                self.table[:EEPROM_END] = factory(self.table[Register.MODEL])[:EEPROM_END]
            case Instruction.READ | Instruction.WRITE | Instruction.REG_WRITE:
                error = Alarm.RANGE
            case _:
                error = Alarm.INSTRUCTION
        return error | self.alarm, data

    def write(self, address: int, values: bytes) -> Alarm:
        """Registers from `address` on, as one instruction does it; nothing where a value may not be."""
        changed = range(address, address + len(values))
        locked = self.table[Register.LOCK] and address < EEPROM_END
        if not values or locked or not WRITABLE.issuperset(changed):
            return Alarm.RANGE
        after = bytearray(self.table)
        after[address : changed.stop] = values
        for at, (width, low, high) in RANGES.items():
            if at in changed and not low <= int.from_bytes(after[at : at + width], "little") <= high:
                return Alarm.RANGE
        goal = int.from_bytes(after[30:32], "little")
        if 30 in changed and not int.from_bytes(after[6:8], "little") <= goal <= int.from_bytes(after[8:10], "little"):
            return Alarm.ANGLE
        was_on = self.table[Register.TORQUE_ENABLE]
        self.table[:] = after
        if Register.TORQUE_LIMIT in changed and self.word(Register.TORQUE_LIMIT):
            self._recover()
        if 30 in changed and self.word(Register.TORQUE_LIMIT):
            self.table[Register.TORQUE_ENABLE] = 1  # a goal switches the torque on by itself
        on = self.table[Register.TORQUE_ENABLE]
        if on and self.word(Register.TORQUE_LIMIT) and (not was_on or 30 in changed or 32 in changed):
            speed = self.word(Register.MOVING_SPEED) & CODES
            top = self._top_dps * self.table[Register.PRESENT_VOLTAGE] / 10.0
            self._turn(to_deg(goal), min(top, speed * SPEED_DPS) if speed else top)
        elif was_on and not on:
            self._let_go()
        return Alarm(0)

    # --- what goes on by itself --------------------------------------------------------------------------------
    def _look(self) -> None:
        """Present position, speed and load, and the alarms that follow from them."""
        angle, rate = self._shaft()
        code = min(CODES, max(0, round(angle / STEP_DEG) + CENTRE))
        behind = to_deg(self.word(Register.GOAL_POSITION)) - angle if self.table[Register.TORQUE_ENABLE] else 0.0
        blocked = abs(rate) < 1.0 and abs(behind) > STUCK_DEG
        load = self.word(Register.TORQUE_LIMIT) if blocked else min(1023, round(abs(rate) * 0.6 + 20 * (behind != 0.0)))
        self.table[36:38] = word(code)
        self.table[38:40] = word(_signed(round(rate / SPEED_DPS)))
        self.table[40:42] = word(load | (1024 if behind < 0 else 0))
        self.table[Register.MOVING] = abs(rate) >= 1.0
        self._watch(blocked)

    def _watch(self, blocked: bool) -> None:
        now = time.perf_counter()
        if not blocked:
            self._stuck_since = None
        elif self._stuck_since is None:
            self._stuck_since = now
        elif now - self._stuck_since > OVERLOAD_S:
            self._trip(Alarm.OVERLOAD)
        table = self.table
        if table[Register.PRESENT_TEMPERATURE] > table[Register.HIGHEST_TEMPERATURE]:
            self._trip(Alarm.OVERHEAT)
        volts = table[Register.PRESENT_VOLTAGE]
        good = table[Register.LOWEST_VOLTAGE] <= volts <= table[Register.HIGHEST_VOLTAGE]
        self.alarm = self.alarm & ~Alarm.VOLTAGE if good else self.alarm | Alarm.VOLTAGE

    def _trip(self, alarm: Alarm) -> None:
        """Shutdown: torque limit 0 and torque off, until both are written again and the cause is gone."""
        self.alarm |= alarm
        if self.table[Register.SHUTDOWN] & alarm:
            self.table[34:36] = word(0)
            if self.table[Register.TORQUE_ENABLE]:
                self.table[Register.TORQUE_ENABLE] = 0
                self._let_go()

    def _recover(self) -> None:
        self._stuck_since = None
        self.alarm &= ~Alarm.OVERLOAD
        if self.table[Register.PRESENT_TEMPERATURE] <= self.table[Register.HIGHEST_TEMPERATURE]:
            self.alarm &= ~Alarm.OVERHEAT


def _signed(value: int) -> int:
    return min(1023, abs(value)) | (1024 if value < 0 else 0)
