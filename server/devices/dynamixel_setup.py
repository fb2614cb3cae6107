"""What a servo's control table says about how it is set up, and what of that this instrument cannot work with."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from calib_core.sequence import Axis
from server.devices import DeviceError
from server.devices.dynamixel_registers import (
    CODES,
    MODELS,
    SPEED_DPS,
    STEP_DEG,
    Alarm,
    Model,
    Register,
    to_deg,
    word,
)

TABLE = (Register.MODEL, 50)
GUARD = Alarm.OVERLOAD | Alarm.OVERHEAT
EXPECTED = {"x": "RX-28", "z": "RX-64"}
FACTORY_TOP_V = 18.5  # the supply of the e-manual's top speeds, where the real one is not known yet
QUICK_DELAY_US = 100
CURES: Mapping[str, Mapping[int, bytes]] = {  # what `doctor --mend` writes
    "rig.servo_wheel": {Register.CW_LIMIT: word(0) + word(CODES)},
    "rig.servo_quiet": {Register.STATUS_RETURN: bytes([2])},
    "rig.servo_unguarded": {Register.SHUTDOWN: bytes([GUARD])},
    "rig.servo_delay": {Register.RETURN_DELAY: bytes([0])},
}


@dataclass(frozen=True)
class Setup:
    """One servo's control table (50,) bytes in words."""

    model: Model | None
    number: int
    return_delay_us: int
    min_deg: float
    max_deg: float
    wheel: bool
    highest_degC: int
    shutdown: Alarm
    torque_limit: int
    supply_V: float
    temperature_degC: float

    @classmethod
    def of(cls, table: bytes) -> "Setup":
        def at(address: int) -> int:
            return int.from_bytes(table[address : address + 2], "little")

        low, high = at(Register.CW_LIMIT), at(Register.CCW_LIMIT)
        return cls(
            model=MODELS.get(at(Register.MODEL)),
            number=at(Register.MODEL),
            return_delay_us=2 * table[Register.RETURN_DELAY],
            min_deg=to_deg(low),
            max_deg=to_deg(min(high, CODES)),
            wheel=low == high == 0,
            highest_degC=table[Register.HIGHEST_TEMPERATURE],
            shutdown=Alarm(table[Register.SHUTDOWN] & 0x7F),
            torque_limit=at(Register.TORQUE_LIMIT),
            supply_V=table[Register.PRESENT_VOLTAGE] / 10.0,
            temperature_degC=float(table[Register.PRESENT_TEMPERATURE]),
        )

    def axis(self, name: str) -> Axis:
        """What it can do now: angles by its own limits, speed by its supply."""
        assert self.model is not None
        top = min(self.model.dps_per_volt * self.supply_V, CODES * SPEED_DPS)
        return Axis(name, self.min_deg, self.max_deg, top, STEP_DEG, self.model.part, self.supply_V)


def unknown(name: str) -> Axis:
    """An axis nobody has asked yet: the fastest it could be, to be checked again when its supply is known."""
    model = next(model for model in MODELS.values() if model.part == EXPECTED[name])
    top = model.dps_per_volt * FACTORY_TOP_V
    return Axis(name, to_deg(0), to_deg(CODES), top, STEP_DEG, model.part, math.nan)


def faults(setups: Mapping[str, Setup], ids: Mapping[str, int]) -> Iterator[DeviceError]:
    """Everything in these servos' set-up that keeps the rig from working."""
    models = {axis: found.model for axis, found in setups.items()}
    for axis, found in setups.items():
        who: dict[str, object] = {"axis": axis, "id": ids[axis]}
        if found.model is None:
            parts = ", ".join(model.part for model in MODELS.values())
            yield DeviceError("rig.servo_model", **who, model=found.number, allowed=parts)
            continue
        who["part"] = found.model.part
        if found.wheel:
            yield DeviceError("rig.servo_wheel", **who)
        if found.shutdown & GUARD != GUARD:
            yield DeviceError("rig.servo_unguarded", **who)
    parts_found = {axis: model.part for axis, model in models.items() if model is not None}
    if {parts_found.get("x"), parts_found.get("z")} == set(EXPECTED.values()) and parts_found != EXPECTED:
        yield DeviceError("rig.servos_exchanged", ids=f"{ids['z']},{ids['x']}")


def warnings(setups: Mapping[str, Setup], ids: Mapping[str, int]) -> Iterator[DeviceError]:
    """What only makes it slower than it could be."""
    for axis, found in setups.items():
        if found.return_delay_us > QUICK_DELAY_US:
            yield DeviceError("rig.servo_delay", axis=axis, id=ids[axis], delay_us=found.return_delay_us)
