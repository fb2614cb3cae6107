"""The emulated DAQ as a process: NI's gRPC service in front of the plant's voltages, and a channel for faults."""

import numpy as np
from numpy.typing import NDArray

from server.emulators import process
from server.emulators.ni_driver import Device
from server.emulators.ni_service import serve
from server.emulators.plant import PlantClient

F64 = NDArray[np.float64]


class PlantSource:
    """The plant's converter behind a USB cable: a transfer takes its time, and one in a hundred is late."""

    def __init__(self, plant: PlantClient) -> None:
        self._plant = plant
        self._spec = plant.daq_spec()
        self._rng = np.random.default_rng(1)
        self.rate_hz: float = self._spec.rate_hz

    def start(self) -> None:
        self._plant.daq_start()

    def taken(self) -> int:
        taken: int = self._plant.daq_taken()
        return taken

    def read(self, first: int, n: int) -> F64:
        volts: F64 = self._plant.daq_read(first, n)
        return volts

    def latency_s(self) -> float:
        spec = self._spec
        late = float(self._rng.exponential(spec.transfer_scatter_s))
        return float(spec.transfer_s + late + (spec.hiccup_s if self._rng.random() < 0.01 else 0.0))


def main() -> None:
    device = Device(PlantSource(PlantClient(process.told())))
    _server, port = serve(device)
    process.live({"grpc": f"127.0.0.1:{port}", "control": process.serve(device)})


if __name__ == "__main__":
    main()
