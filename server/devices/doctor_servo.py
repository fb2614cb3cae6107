"""What `gyrobench doctor` looks at in a servo bus: its port, its speed, each servo's set-up. Nothing moves.

A servo that does not answer where it should is looked for under other ids and at other speeds, so that the cure can
say where it is. `mend` writes what cures a wrong set-up into the servo's own memory.
"""

import time
from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from typing import Any

from calib_core.problem import Problem
from server.devices import DeviceError
from server.devices.address import ports, table_of
from server.devices.check import Check
from server.devices.dynamixel_bus import Bus, NoReply, latency_ms
from server.devices.dynamixel_registers import BLOCK, MODELS, Register
from server.devices.dynamixel_setup import CURES, TABLE, Setup, faults, warnings

USUAL_BAUDS = (1_000_000, 57_600, 115_200)
USUAL_IDS = range(1, 11)
RATE_S = 0.5
LEAST_HZ = 80.0
QUICK_MS = 2.0
FTDI = 0x0403


def adapters() -> list[str]:
    """The ports that may be a servo adapter: those on USB, FTDI's first."""
    from serial.tools import list_ports

    found = [port for port in list_ports.comports() if port.vid is not None]
    return [port.device for port in sorted(found, key=lambda port: (port.vid != FTDI, port.device))]


def checks(url: str, *, mend: bool = False) -> Iterator[Check]:
    """Checks of the bus that a `dynamixel:` address names; what keeps the rest from being asked ends them."""
    try:
        table = table_of(url)
    except Problem as problem:
        yield Check("port", False, problem.code, dict(problem.values))
        return
    bus, ids = table.bus, table.ids
    try:
        with closing(bus):
            bus.open()
            yield Check("port", True, "check.port", {"port": bus.port, "baud": bus.baud})
            yield _latency(bus.port)
            yield from _servos(bus, ids, mend)
    except DeviceError as fault:
        yield Check("port", False, fault.code, dict(fault.values))


def find() -> Iterator[Check]:
    """Adapters, and the servos behind them: for whoever does not know the rig's address yet."""
    found = adapters()
    if not found:
        others = ports()
        yield Check("port", False, "check.no_adapter", {"ports": others or ["–"]}, "cure.no_adapter")
    for port in found:
        try:
            baud, ids = _search(port, Bus(port, USUAL_BAUDS[0]).baud, USUAL_IDS)
        except DeviceError as fault:
            yield Check("port", False, fault.code, dict(fault.values))
            continue
        if not ids:
            yield Check("port", False, "check.no_servo", {"port": port}, "cure.no_servo")
            continue
        names = [f"{number} ({part})" for number, part in ids.items()]
        order = sorted(ids, key=lambda number: ids[number] != "RX-28")
        rig = f"dynamixel:{port}?ids={','.join(map(str, order))}&baud={baud}+nidaq:Dev1?channels=ai0,ai1"
        yield Check("port", True, "check.found", {"port": port, "servos": names, "baud": baud, "rig": rig})


def _latency(port: str) -> Check:
    timer = latency_ms(port)
    values = {"port": port, "timer_ms": timer, "device": port.rpartition("/")[2]}
    if timer is None:
        return Check("latency timer", None, "check.latency_unknown", values, "cure.latency")
    if timer > QUICK_MS:
        return Check("latency timer", False, "check.latency_slow", values, "cure.latency")
    return Check("latency timer", True, "check.latency", values)


def _servos(bus: Bus, ids: Mapping[str, int], mend: bool) -> Iterator[Check]:
    setups: dict[str, Setup] = {}
    for axis, number in ids.items():
        try:
            setups[axis] = Setup.of(bus.registers(number, *TABLE))
        except NoReply:
            yield _lost(bus, axis, number)
    wrong = [*faults(setups, ids), *warnings(setups, ids)]
    if mend and wrong:
        _mend(bus, ids, wrong)
        setups = {axis: Setup.of(bus.registers(ids[axis], *TABLE)) for axis in setups}
        wrong = [*faults(setups, ids), *warnings(setups, ids)]
    for fault in wrong:
        where = f"servo {fault.values['axis']}" if "axis" in fault.values else "servos"
        slow = fault.code == "rig.servo_delay"  # it works, only slower than it could
        yield Check(where, None if slow else False, fault.code, dict(fault.values))
    bad = {fault.values.get("axis") for fault in wrong if fault.code != "rig.servo_delay"}
    for axis, found in setups.items():
        if axis not in bad and found.model is not None:
            can = found.axis(axis)
            values = {"axis": axis, "id": ids[axis], "part": can.part, "supply_V": found.supply_V}
            values |= {"lowest": can.min_deg, "highest": can.max_deg, "highest_dps": can.max_rate_dps}
            values |= {"temperature_degC": found.temperature_degC}
            yield Check(f"servo {axis}", True, "check.servo_set_up", values)
    if len(setups) == len(ids):
        yield _rate(bus, ids)


def _mend(bus: Bus, ids: Mapping[str, int], wrong: list[DeviceError]) -> None:
    """Write every cure there is; a servo takes them with its torque off only."""
    for fault in wrong:
        if fault.code in CURES:
            number = ids[str(fault.values["axis"])]
            bus.write(Register.TORQUE_ENABLE, {number: b"\0"})
            for address, values in CURES[fault.code].items():
                bus.write(address, {number: values})
                time.sleep(0.05)  # its memory takes a moment


def _rate(bus: Bus, ids: Mapping[str, int]) -> Check:
    """How often both can be read: what the rig's hundred readings a second need."""
    began, rounds = time.perf_counter(), 0
    while time.perf_counter() - began < RATE_S:
        with suppress(NoReply):
            for number in ids.values():
                bus.registers(number, *BLOCK, tries=1)
            rounds += 1
    values = {"per_s": rounds / RATE_S, "least": LEAST_HZ, "part": bus.port}
    if rounds / RATE_S < LEAST_HZ:
        return Check("servos", False, "check.bus_slow", values, "cure.servo_slow")
    return Check("servos", True, "check.bus_rate", values)


def _lost(bus: Bus, axis: str, number: int) -> Check:
    """A servo that does not answer: is it set to be silent, or somewhere else?"""
    if bus.ping(number):
        return Check(f"servo {axis}", False, "rig.servo_quiet", {"axis": axis, "id": number})
    bus.close()
    baud, ids = _search(bus.port, bus.baud, (number, *USUAL_IDS))
    bus.open()
    values: dict[str, Any] = {"axis": axis, "id": number, "baud": bus.baud, "there": baud}
    values["servos"] = [f"{other} ({part})" for other, part in ids.items()]
    if not ids:
        return Check(f"servo {axis}", False, "check.servo_absent", values, "cure.servo_absent")
    if baud != bus.baud:
        return Check(f"servo {axis}", False, "check.servo_other_baud", values, "cure.servo_other_baud")
    return Check(f"servo {axis}", False, "check.servo_other_id", values, "cure.servo_other_id")


def _search(port: str, first: int, numbers: Any) -> tuple[int, dict[int, str]]:
    """The speed at which servos answer at this port, and which: {id: part}. Raises DeviceError for the port."""
    for baud in dict.fromkeys((first, *USUAL_BAUDS)):
        with closing(Bus(port, baud)) as bus:
            bus.open()
            found = {}
            for number in dict.fromkeys(numbers):
                if bus.ping(number):
                    with suppress(NoReply):
                        model = int.from_bytes(bus.registers(number, Register.MODEL, 7)[:2], "little")
                        found[number] = MODELS[model].part if model in MODELS else f"model {model}"
            if found:
                return baud, found
    return first, {}
