"""Rig addresses: `twin:?seed=1`, and for the bench `dynamixel:PORT?…` joined by `+` with `nidaq:…`."""

from pathlib import Path
from urllib.parse import parse_qsl

from calib_core.gyro_models import GyroModel
from calib_core.problem import Problem
from calib_core.twin import Plant, board_truth
from server.devices import DeviceError
from server.devices.rig import Rig
from server.devices.twin_rig import TwinDaq, TwinTable

EXAMPLE = "twin:?seed=1"
BENCH = ("emulated", "dynamixel", "nidaq")


def make_rig(url: str) -> Rig:
    """See `server.devices.open_rig`."""
    kind, colon, rest = url.strip().partition(":")
    if not colon or kind not in ("twin", *BENCH):
        raise Problem("rig.address", given=url, allowed=EXAMPLE)
    if kind == "twin":
        return _twin(url.strip(), rest)
    if kind == "dynamixel":
        port = rest.partition("+")[0].partition("?")[0]
        if not port:
            raise Problem("rig.address", given=url, allowed=EXAMPLE)
        if port.startswith("/") and not Path(port).exists():
            raise DeviceError("rig.port_absent", port=port, ports=", ".join(ports()) or "–")
    raise DeviceError("rig.no_driver", kind=kind, allowed=EXAMPLE)


def ports() -> list[str]:
    """The serial ports of this machine."""
    from serial.tools import list_ports

    return sorted(port.device for port in list_ports.comports())


def _twin(url: str, rest: str) -> Rig:
    path, _, query = rest.partition("?")
    options = dict(parse_qsl(query, keep_blank_values=True))
    known = {"seed", "covariates"}
    if path or not set(options) <= known:
        raise Problem("rig.address", given=url, allowed=EXAMPLE)
    numbers = {}
    for name, text in options.items():
        if not text.isascii() or not text.isdigit() or len(text) > 18:
            raise Problem("rig.option", name=name, given=text, allowed=EXAMPLE)
        numbers[name] = int(text)
    seed = numbers.get("seed", 1)
    table = TwinTable(Plant(seed, covariates=bool(numbers.get("covariates", 0))))

    def mount(board: str, gyro_model: GyroModel) -> None:
        with table.lock:
            table.plant.mount(board_truth(seed, board, gyro_model))

    return Rig(url, table, TwinDaq(table), simulated=True, mount=mount)
