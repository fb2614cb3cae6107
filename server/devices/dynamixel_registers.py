"""The control table of the RX-28 and RX-64, and what its values mean (HARDWARE, ROBOTIS e-manual)."""

from dataclasses import dataclass
from enum import IntEnum, IntFlag

STEP_DEG = 300.0 / 1023.0  # goal and present position: 10 bits over 300°
CENTRE = 512  # the code at 0°
CODES = 1023
SPEED_DPS = 0.666  # one step of moving speed, 0.111 rpm; 0 would mean as fast as it can
BAUDS = {1: 1_000_000, 3: 500_000, 4: 400_000, 7: 250_000, 9: 200_000, 16: 115_200, 34: 57_600, 103: 19_200, 207: 9_600}


class Register(IntEnum):
    MODEL = 0
    FIRMWARE = 2
    ID = 3
    BAUD = 4
    RETURN_DELAY = 5
    CW_LIMIT = 6
    CCW_LIMIT = 8
    HIGHEST_TEMPERATURE = 11
    LOWEST_VOLTAGE = 12
    HIGHEST_VOLTAGE = 13
    MAX_TORQUE = 14
    STATUS_RETURN = 16
    ALARM_LED = 17
    SHUTDOWN = 18
    TORQUE_ENABLE = 24
    LED = 25
    GOAL_POSITION = 30
    MOVING_SPEED = 32
    TORQUE_LIMIT = 34
    PRESENT_POSITION = 36
    PRESENT_SPEED = 38
    PRESENT_LOAD = 40
    PRESENT_VOLTAGE = 42
    PRESENT_TEMPERATURE = 43
    REGISTERED = 44
    MOVING = 46
    LOCK = 47
    PUNCH = 48


class Alarm(IntFlag):
    """The error byte of a status packet; register 18 says which of them let go of the shaft."""

    VOLTAGE = 0x01
    ANGLE = 0x02
    OVERHEAT = 0x04
    RANGE = 0x08
    CHECKSUM = 0x10
    OVERLOAD = 0x20
    INSTRUCTION = 0x40


@dataclass(frozen=True)
class Model:
    """One kind of servo. Its top speed follows from the supply: `dps_per_volt` (HARDWARE, computed)."""

    number: int
    part: str
    dps_per_volt: float


MODELS = {model.number: model for model in (Model(28, "RX-28", 27.0), Model(64, "RX-64", 21.0))}


@dataclass(frozen=True)
class State:
    """What one block read of registers 36 to 43 says. Signed speed and load: positive turns towards larger angles."""

    code: int
    speed_dps: float
    load_pct: float
    supply_V: float
    temperature_degC: float

    @property
    def angle_deg(self) -> float:
        return to_deg(self.code)


BLOCK = (Register.PRESENT_POSITION, 8)


def state(block: bytes) -> State | None:
    """The eight bytes of `BLOCK`; None where no servo of this kind can have said them."""
    position, speed, load = (block[i] | block[i + 1] << 8 for i in (0, 2, 4))
    if position > CODES or speed > 2047 or load > 2047:
        return None
    return State(position, SPEED_DPS * _signed(speed), _signed(load) / 10.23, block[6] / 10.0, float(block[7]))


def _signed(value: int) -> int:
    """Ten bits of size; the eleventh says clockwise."""
    return -(value & 1023) if value & 1024 else value


def to_deg(code: int) -> float:
    return (code - CENTRE) * STEP_DEG


def to_code(angle_deg: float) -> int:
    """The nearest code. The caller has checked the angle: an angle past the codes is a programming error."""
    code = round(angle_deg / STEP_DEG) + CENTRE
    if not 0 <= code <= CODES:
        raise ValueError(f"no code for {angle_deg} deg")
    return code


def speed_code(rate_dps: float) -> int:
    """The moving-speed register for a rate: at least 1, because 0 means as fast as it can."""
    return max(1, min(CODES, round(rate_dps / SPEED_DPS)))


def word(value: int) -> bytes:
    return value.to_bytes(2, "little")
