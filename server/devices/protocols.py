"""What a table and a DAQ have to do. The twin, the emulated and the real devices all are these two.

Constructors send nothing. `safe` works from any state, twice in a row, and from another thread than `read`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib_core.sequence import Axis, Motion
from calib_core.twin import Samples

__all__ = ["Daq", "Readings", "Samples", "Table", "Telemetry"]

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Readings:
    """Encoder readings of one axis: times (m,) by the host's clock at the middle of each transaction, angles (m,).

    `heard_s`: when it last answered at all, also too late for the reading's time to be known; `late`: how many such
    answers there were.
    """

    time_s: F64
    angle_deg: F64
    heard_s: float = -np.inf
    late: int = 0


@dataclass(frozen=True)
class Telemetry:
    """What a servo says of itself."""

    supply_V: float
    temperature_degC: float
    load_pct: float
    torque_on: bool


class Table(Protocol):
    """The two servos. A real one has one owner thread for its bus: it polls both and streams goals at 50 Hz."""

    @property
    def axes(self) -> Mapping[str, Axis]:
        """What each servo can do; after `open` the top speed follows from the supply it measured."""

    def open(self) -> None:
        """Connect; torque off first, whatever the last owner left. Raises `DeviceError`."""

    def start(self, motions: Sequence[Motion]) -> float:
        """Begin these motions together, now; torque on. They replace those going on. Returns at once, with the host's
        time at which they began."""

    def read(self) -> Mapping[str, Readings]:
        """Every good reading since the last call; a failed one is left out, never replaced."""

    def telemetry(self) -> Mapping[str, Telemetry]: ...

    def safe(self) -> None:
        """Stop and let go: torque off on every axis."""

    def close(self) -> None: ...


class Daq(Protocol):
    """Hardware-timed samples of all channels."""

    channels: tuple[str, ...]  # columns of a recording: x_gyro_v, z_gyro_v, then temperature_c, supply_v
    rate_hz: float
    channel_delay_s: float  # from one channel's conversion to the next one's
    part: str

    def open(self) -> None:
        """Connect. Raises `DeviceError`."""

    def start(self) -> None:
        """Begin sampling; its clock is 0 at the first sample."""

    def waiting(self) -> int:
        """How many samples are there already, not yet read."""

    def read(self, n: int) -> Samples:
        """The next n samples; waits until they are there. Raises `DeviceError` when they do not come."""

    def safe(self) -> None:
        """Stop sampling."""

    def close(self) -> None: ...
