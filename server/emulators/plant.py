"""The plant as a process: the twin's table and gyro in real time, one physics for the servo bus and the DAQ.

The bus emulator sends goals and asks where the shafts are; the DAQ emulator asks for voltages. True time is the
machine's own steady clock since the plant began.
"""

import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core.gyro_models import GyroModel
from calib_core.twin import Plant, board_truth
from server.emulators import process

F64 = NDArray[np.float64]

FLOATING_V = 1.4  # what an open USB-6008 input reads (HARDWARE)
REMEMBER_S = 60.0  # the DAQ may ask for voltages this far back
BLOCK = 2000


class Handler:
    """What the plant answers. One caller at a time."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._plant = Plant(seed, covariates=True)
        self._began_s = time.perf_counter()
        self._lock = threading.Lock()
        self._unplugged, self._miswired = False, ""

    def _now(self) -> float:
        # Never before what was already sampled: the past does not change.
        return max(time.perf_counter() - self._began_s, self._plant.now_s)

    # --- servos ------------------------------------------------------------------------------------------------
    def parts(self) -> dict[str, str]:
        return {axis: servo.spec.part for axis, servo in self._plant.servos.items()}

    def shaft(self, axis: str) -> tuple[float, float]:
        """Angle (deg) and rate (deg/s) of a shaft, now."""
        with self._lock:
            angle, rate = self._plant.servos[axis].motion(np.array([self._now()]))
        return float(angle[0]), float(rate[0])

    def angles(self, axis: str, host_time_s: F64) -> F64:
        """Where a shaft truly was at times (n,) of this machine's clock: what readings have to agree with."""
        with self._lock:
            return self._plant.servos[axis].motion(host_time_s - self._began_s)[0]

    def command(self, goals: Mapping[str, tuple[float, float]]) -> None:
        """Axes' goals (deg) and speeds (deg/s), now and together."""
        with self._lock:
            now = self._now()
            for axis, (goal_deg, rate_dps) in goals.items():
                servo = self._plant.servos[axis]
                servo.command([(now, goal_deg, rate_dps)])
                servo.forget(now - REMEMBER_S)

    def let_go(self, axis: str) -> None:
        with self._lock:
            self._plant.servos[axis].stop(self._now())

    def jam(self, axis: str, jammed: bool = True) -> None:
        """Block a shaft, or free it."""
        with self._lock:
            servo = self._plant.servos[axis]
            if jammed:
                servo.stop(self._now(), jam=True)
            servo.jammed = jammed

    def supply(self, volts: float) -> None:
        """Another supply of the servos: their top speed follows."""
        with self._lock:
            for servo in self._plant.servos.values():
                servo.spec = replace(servo.spec, supply_V=volts)

    # --- gyro and DAQ ------------------------------------------------------------------------------------------
    def mount(self, board: str, gyro_model: GyroModel) -> None:
        """Put this board's gyro on the table, the same as the twin with this seed has."""
        with self._lock:
            self._plant.mount(board_truth(self._seed, board, gyro_model))

    def unplug_gyro(self, unplugged: bool = True) -> None:
        self._unplugged = unplugged

    def miswire(self, how: str = "") -> None:
        """`swap`: x on z's channel; `reverse`: sensor upside down; `rail`: output stuck; nothing: as it should be."""
        if how not in ("", "swap", "reverse", "rail"):
            raise ValueError(how)
        self._miswired = how

    def truth(self) -> dict[str, tuple[float, float]]:
        """Bias (V) and scale factor (V per deg/s) of the gyro on the table, by axis."""
        return {axis: (model.bias, model.scale_factor) for axis, model in self._plant.models.items()}

    def daq_spec(self) -> Any:
        return self._plant.daq.spec

    def daq_time_s(self, host_time_s: float) -> float:
        """What the DAQ's own clock showed at a time of this machine's: the truth that a driver has to find."""
        daq = self._plant.daq
        return (host_time_s - self._began_s - daq.start_s) / (1.0 + daq.spec.clock_error)

    def daq_start(self) -> None:
        """Sample 0 is taken now."""
        with self._lock:
            self._plant.daq.start(self._now())

    def daq_stop(self) -> None:
        """Nothing runs between reads."""

    def daq_taken(self) -> int:
        """How many samples were taken since the start."""
        daq = self._plant.daq
        since = (time.perf_counter() - self._began_s - daq.start_s) / (1.0 + daq.spec.clock_error)
        return max(0, int(since * daq.spec.rate_hz) + 1)

    def daq_read(self, first: int, n: int) -> F64:
        """Volts (n, 4) of samples `first`…: x gyro, z gyro, LM35, half the supply. Only what was taken, in order."""
        if first + n > self.daq_taken():
            raise ValueError("these samples lie in the future")
        with self._lock:
            self._plant.daq.taken = first
            blocks = [self._plant.advance(min(BLOCK, n - done)).volts for done in range(0, n, BLOCK)]
            volts = np.concatenate(blocks) if blocks else np.empty((0, 4))
            return self._wired(volts)

    def _wired(self, volts: F64) -> F64:
        gyro = volts[:, :2]
        if self._unplugged:
            noise = np.random.default_rng(len(volts)).normal(0.0, 1e-3, gyro.shape)
            gyro = self._plant.daq.convert(FLOATING_V + noise)
        elif self._miswired == "swap":
            gyro = gyro[:, ::-1]
        elif self._miswired == "reverse":
            gyro = 2.5 - gyro
        elif self._miswired == "rail":
            gyro = self._plant.daq.convert(np.full_like(gyro, 9.0))
        return np.column_stack([gyro, volts[:, 2:]])


class PlantClient(process.Remote):
    """The plant, from another process: every public method of `Handler`. `said` is what `process.serve` gave."""


if __name__ == "__main__":
    given = process.told()
    process.live(process.serve(Handler(int(given["seed"]))))
