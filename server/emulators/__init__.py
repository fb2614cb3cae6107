"""Stand-ins that speak the bytes: a servo bus behind a pseudo-terminal and a DAQ behind gRPC, one plant behind both.

`start` brings the three processes up; their `url` is a rig of real drivers on them. They end with whoever started them.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from server.devices import DeviceError
from server.emulators.process import Child, Remote

if TYPE_CHECKING:
    from calib_core.gyro_models import GyroModel


@dataclass
class Bench:
    """The emulated bench. `plant`, `bus` and `daq` are control channels: faults, miswirings, registers."""

    url: str
    plant: Any
    bus: Any
    daq: Any
    children: list[Child] = field(repr=False)

    def mount(self, board: str, gyro_model: GyroModel) -> None:
        self.plant.mount(board, gyro_model)

    def close(self) -> None:
        for child in reversed(self.children):
            child.close()


def start(seed: int = 1, *, baud: int = 1_000_000, latency_ms: float = 1.0, channels: int = 2) -> Bench:
    """Three processes; raises DeviceError where one does not come up, or this system has no pseudo-terminals."""
    if sys.platform == "win32":
        raise DeviceError("emulator.no_terminals")
    children: list[Child] = []
    try:
        plant = Child("plant", seed=seed)
        children.append(plant)
        bus = Child("servo_bus", plant=plant.said, baud=baud, latency_s=latency_ms * 1e-3, seed=seed)
        children.append(bus)
        daq = Child("ni_device", **plant.said)
        children.append(daq)
        inputs = ",".join(f"ai{i}" for i in range(channels))
        url = f"dynamixel:{bus.said['port']}?ids=1,2&baud={baud}&latency={latency_ms:g}"
        url += f"+nidaq:grpc://{daq.said['grpc']}/Dev1?channels={inputs}"
        return Bench(url, Remote(plant.said), Remote(bus.said["control"]), Remote(daq.said["control"]), children)
    except BaseException:
        for child in reversed(children):
            child.close()
        raise
