"""`twin:`, the simulated rig: a table and a DAQ in front of one `Plant`.

Reading n samples is what makes time pass, so nothing waits and a test sleeps nowhere. One lock guards the plant,
because an emergency stop comes from another thread than the one that reads.
"""

from collections.abc import Mapping, Sequence
from threading import Lock

import numpy as np

from calib_core.sequence import Axis, Motion
from calib_core.twin import Plant
from calib_core.twin_servo import STEP_DEG
from server.devices import DeviceError, streaming
from server.devices.protocols import Readings, Samples, Telemetry


class TwinTable:
    """Two simulated servos. `silent` axes do not answer, as with a pulled cable."""

    def __init__(self, plant: Plant) -> None:
        self.plant, self.lock = plant, Lock()
        self.silent: set[str] = set()
        self.axes: Mapping[str, Axis] = {
            axis: Axis(axis, -150.0, 150.0, servo.spec.top_rate_dps, STEP_DEG, servo.spec.part, servo.spec.supply_V)
            for axis, servo in plant.servos.items()
        }

    def open(self) -> None:
        for axis in self.silent:
            raise DeviceError("rig.servo_silent", axis=axis, part=self.axes[axis].part)

    def start(self, motions: Sequence[Motion]) -> float:
        with self.lock:
            now_s = self.plant.now_s
            for motion in motions:
                servo = self.plant.servos[motion.axis]
                servo.command((now_s + t, *streaming.goal(motion, t)) for t in streaming.times(motion))
            return self.plant.host_time_s

    def read(self) -> dict[str, Readings]:
        with self.lock:
            read = {axis: Readings(*arrays) for axis, arrays in self.plant.encoders().items()}
        return read | {axis: Readings(np.empty(0), np.empty(0)) for axis in self.silent}

    def heat(self, on: bool) -> None:
        """The board's heater; the simulated bench has one."""
        with self.lock:
            self.plant.heat(on)

    def later(self, seconds: float) -> None:
        """The plant has been on for at least so long."""
        with self.lock:
            self.plant.wait(seconds)

    def telemetry(self) -> dict[str, Telemetry]:
        return {
            axis: Telemetry(servo.spec.supply_V, 34.0, 0.0, servo.torque_on)
            for axis, servo in self.plant.servos.items()
        }

    def safe(self) -> None:
        with self.lock:
            for servo in self.plant.servos.values():
                servo.stop(self.plant.now_s)

    def close(self) -> None:
        self.safe()


class TwinDaq:
    """The simulated converter. `unplugged`: it gives no more samples, as with a pulled cable."""

    part = "NI USB-6008"

    def __init__(self, table: TwinTable) -> None:
        plant = self.plant = table.plant
        self._lock = table.lock
        self.unplugged = False
        self.rate_hz = plant.daq.spec.rate_hz
        self.channel_delay_s = plant.daq.spec.channel_delay_s
        more = ("temperature_c", "supply_v") if plant.covariates else ()
        self.channels: tuple[str, ...] = ("x_gyro_v", "z_gyro_v", *more)

    def open(self) -> None:
        if self.unplugged:
            raise DeviceError("rig.daq_silent", part=self.part)

    def start(self) -> None:
        with self._lock:
            self.plant.daq.start(self.plant.now_s + 1.0 / self.rate_hz)

    def waiting(self) -> int:
        return 0

    def read(self, n: int) -> Samples:
        if self.unplugged:
            raise DeviceError("rig.daq_silent", part=self.part)
        with self._lock:
            return self.plant.advance(n)

    def safe(self) -> None:
        """Nothing runs between reads."""

    def close(self) -> None:
        """Nothing is held open."""
