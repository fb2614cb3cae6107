"""The emulated servo bus without a DAQ, for tests of the table's driver."""

from dataclasses import dataclass
from typing import Any

from server.devices.dynamixel_table import DynamixelTable
from server.emulators.process import Child, Remote


@dataclass
class Servos:
    port: str
    bus: Any
    plant: Any
    children: list[Child]

    def table(self, **options: Any) -> DynamixelTable:
        return DynamixelTable(self.port, {"x": 1, "z": 2}, **{"latency": 1.0, **options})

    def close(self) -> None:
        for child in reversed(self.children):
            child.close()


def start(seed: int = 1, baud: int = 1_000_000, latency_ms: float = 1.0) -> Servos:
    plant = Child("plant", seed=seed)
    bus = Child("servo_bus", plant=plant.said, baud=baud, latency_s=latency_ms * 1e-3, seed=seed)
    return Servos(bus.said["port"], Remote(bus.said["control"]), Remote(plant.said), [plant, bus])
