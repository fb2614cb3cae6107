"""The emulated NI gRPC server inside the test's process, with a converter that needs no clock."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from server.devices import DeviceError
from server.devices.ni_daq import NiDaq
from server.emulators.ni_driver import Device
from server.emulators.ni_service import serve


class Prompt:
    """Samples are there when they are asked for. Channel c of sample k is k µV + c V: every volt tells its place."""

    rate_hz = 1000.0

    def __init__(self) -> None:
        self.read_to, self.ahead = 0, 100

    def start(self) -> None:
        self.read_to = 0

    def taken(self) -> int:
        return self.read_to + self.ahead

    def read(self, first: int, n: int) -> np.ndarray:
        self.read_to = max(self.read_to, first + n)
        return 1e-6 * np.arange(first, first + n)[:, None] + np.arange(4.0)

    def latency_s(self) -> float:
        return 0.0


class Bench:
    """A device behind a gRPC server, and what drives it."""

    def __init__(self) -> None:
        self.source = Prompt()
        self.device = Device(self.source)
        self.server, self.port = serve(self.device)

    def daq(self, place: str = "Dev1?channels=ai0,ai1", *, late_s: float = 0.0) -> NiDaq:
        daq = NiDaq.from_url(f"grpc://127.0.0.1:{self.port}/{place}")
        daq._late_s = late_s
        return daq

    def running(self, place: str = "Dev1?channels=ai0,ai1") -> NiDaq:
        daq = self.daq(place)
        daq.open()
        daq.start()
        return daq


@contextmanager
def bench() -> Iterator[Bench]:
    made = Bench()
    try:
        yield made
    finally:
        made.device.hang(False)
        made.server.stop(0)


def refused(work: Callable[[], object]) -> DeviceError:
    """The DeviceError that this raises."""
    try:
        work()
    except DeviceError as error:
        return error
    raise AssertionError("nothing was refused")
