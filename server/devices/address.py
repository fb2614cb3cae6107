"""Rig addresses: `twin:`, `emulated:`, and the bench's `dynamixel:PORT?…` joined by `+` with `nidaq:…` (CONTRACT 2)."""

import math
from collections.abc import Iterable
from urllib.parse import parse_qsl

from calib_core.formula import from_text
from calib_core.gyro_models import GyroModel
from calib_core.problem import Problem
from calib_core.twin import LATCH_S, Plant, board_truth
from calib_core.twin_effects import parse, with_effects
from server.devices.dynamixel_table import DynamixelTable
from server.devices.ni_daq import NiDaq
from server.devices.rig import Rig
from server.devices.twin_rig import TwinDaq, TwinTable
from server.examples import by_board

TWIN = "twin:?seed=1"
BENCH = "dynamixel:PORT?ids=1,2&baud=1000000+nidaq:Dev1?channels=ai0,ai1"
HIGHEST_ID = 252


def make_rig(url: str) -> Rig:
    """See `server.devices.open_rig`."""
    url = url.strip()
    kind, colon, rest = url.partition(":")
    if kind == "twin" and colon:
        return _twin(url, rest)
    if kind == "emulated" and colon:
        return _emulated(url, rest)
    if kind == "dynamixel" and colon:
        return _bench(url, rest)
    raise Problem("rig.address", given=url, allowed=TWIN, bench=BENCH)


def ports() -> list[str]:
    """The serial ports of this machine."""
    from serial.tools import list_ports

    return sorted(port.device for port in list_ports.comports())


def table_of(url: str) -> DynamixelTable:
    """The table that a `dynamixel:` address names, with or without its DAQ; nothing is sent."""
    port, _, query = url.removeprefix("dynamixel:").partition("+nidaq:")[0].partition("?")
    if not port:
        raise Problem("rig.address", given=url, allowed=TWIN, bench=BENCH)
    options = {"ids": "1,2", "baud": "1000000", "latency": "", "torque": "60"} | _options(
        query, ("ids", "baud", "latency", "torque")
    )
    ids = options["ids"].split(",")
    numbers = [_number("ids", text, HIGHEST_ID) for text in ids]
    if len(numbers) != 2 or numbers[0] == numbers[1]:
        raise Problem("rig.ids", given=options["ids"])
    latency = float(_number("latency", options["latency"], 255)) if options["latency"] else None
    torque = _number("torque", options["torque"], 100)
    baud = _number("baud", options["baud"], 4_000_000)
    return DynamixelTable(
        port, dict(zip("xz", numbers, strict=True)), baud=baud, latency=latency, torque_pct=float(max(1, torque))
    )


def _bench(url: str, rest: str) -> Rig:
    _, joined, daq = rest.partition("+nidaq:")
    table = table_of(url)
    if not joined:
        raise Problem("rig.no_daq", given=url, bench=BENCH)
    converter = NiDaq.from_url(daq)
    converter.load()
    return Rig(url, table, converter)


def _emulated(url: str, rest: str) -> Rig:
    """The real drivers on stand-ins of their own, which end with the rig."""
    from server import emulators

    given = {name: _number(name, text) for name, text in _query(url, rest, ("seed", "covariates", "baud")).items()}
    bench = emulators.start(
        given.get("seed", 1), baud=given.get("baud", 1_000_000), channels=4 if given.get("covariates") else 2
    )
    real = make_rig(bench.url)
    return Rig(url, real.table, real.daq, mount=bench.mount, ended=bench.close)


def _twin(url: str, rest: str) -> Rig:
    options = _query(url, rest, ("seed", "covariates", "effects", "own", "warming"))
    own = from_text(options.pop("own", "[]"))
    effects = parse(options.pop("effects", ""), {effect.name: effect for effect in own})
    warming = _float("warming", options.pop("warming", "0"), 60.0)
    given = {name: _number(name, text) for name, text in options.items()}
    seed = given.get("seed", 1)
    plant = Plant(seed, with_effects(board_truth(seed), effects), covariates=bool(given.get("covariates", 0)))
    plant.warming_degC_per_s = warming / 60.0
    table = TwinTable(plant)

    def mount(board: str, gyro_model: GyroModel) -> None:
        with table.lock:
            example = by_board(board)
            plant.mount(example.truth() if example else with_effects(board_truth(seed, board, gyro_model), effects))

    one_way_s = plant.daq.spec.transfer_s + LATCH_S
    return Rig(
        url, table, TwinDaq(table), simulated=True, mount=mount, heat=table.heat, later=table.later, one_way_s=one_way_s
    )


def _query(url: str, rest: str, known: Iterable[str]) -> dict[str, str]:
    path, _, query = rest.partition("?")
    if path:
        raise Problem("rig.address", given=url, allowed=TWIN, bench=BENCH)
    return _options(query, known)


def _options(query: str, known: Iterable[str]) -> dict[str, str]:
    given = parse_qsl(query, keep_blank_values=True)
    for i, (name, _) in enumerate(given):
        if name not in known or name in dict(given[:i]):
            raise Problem("rig.unknown_option", name=name, allowed=", ".join(known))
    return dict(given)


def _number(name: str, text: str, highest: int = 10**18 - 1) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 18 or int(text) > highest:
        raise Problem("rig.option", name=name, given=text, allowed=TWIN, highest=highest)
    return int(text)


def _float(name: str, text: str, most: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not -most <= value <= most:
        raise Problem("rig.option", name=name, given=text, allowed=TWIN, highest=most)
    return value
