"""Rig: one loop over a table and a DAQ, the same for the twin, the emulated and the real devices.

A block of DAQ samples sets the pace. Servo readings that came meanwhile are put on the DAQ's clock and into the rows
they belong to, each once, with its own time. A shaft that is not where it was sent, a servo that does not answer and a
gyro that does not feel the table turn are found here.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core.gyro_models import GyroModel
from calib_core.sequence import Axis, Motion
from server.devices import DeviceError
from server.devices.clock import ClockRelation
from server.devices.protocols import Daq, Table, Telemetry

F64 = NDArray[np.float64]

ROW_S = 0.01
MEAN_OF = 10
SCALES = {"temperature_c": 100.0, "supply_v": 2.0}  # an LM35, 10 mV/°C, and a divider by two
STALL_DEG = 3.0
STALL_LAG_S = 0.3  # a shaft may be this far behind its command
LATE_S = 0.05  # rows that waited this long are read before a motion starts
SILENT_S = 0.5  # no answer of a servo for this long is a fault
FELT_DPS, FELT_DEG, FELT_V = 20.0, 20.0, 0.015  # turned this fast and this far, the output must have moved this much


@dataclass(frozen=True)
class Block:
    """Rows at 100 Hz, and the samples at 1 kHz that they are means of; columns as in a recording, with `time_s`."""

    columns: Mapping[str, F64]
    fast: Mapping[str, F64]


@dataclass
class _Shaft:
    """What is known of one axis: where it was, what it was told, readings that wait for their row."""

    from_deg: float = np.nan
    motion: Motion | None = None
    started_s: float = 0.0
    time_s: F64 = field(default_factory=lambda: np.empty(0))
    angle_deg: F64 = field(default_factory=lambda: np.empty(0))
    seen_s: float = -np.inf
    seen_deg: float = np.nan
    heard_s: float = -np.inf
    late: int = 0  # answers that came too late to be timed
    low_V: float = np.inf
    high_V: float = -np.inf
    felt: bool = False

    def commanded_deg(self, time_s: float) -> float:
        if self.motion is None:
            return self.from_deg
        return self.motion.angle_deg(self.from_deg, max(0.0, time_s - self.started_s))

    def take(self, time_s: F64, angle_deg: F64) -> None:
        """New readings on the DAQ's clock. One that a better clock relation puts before the last is left out."""
        later = time_s > self.seen_s
        if later.any():
            self.time_s = np.append(self.time_s, time_s[later])
            self.angle_deg = np.append(self.angle_deg, angle_deg[later])
            self.seen_s, self.seen_deg = float(self.time_s[-1]), float(self.angle_deg[-1])

    def rows(self, first_s: float, n: int) -> tuple[F64, F64]:
        """Readings as two columns (n,) for rows that start at `first_s`: at most one a row, each in its own or the
        next free one, within two; one that finds none is left out, what belongs to later rows is kept."""
        own = np.maximum(np.floor((self.time_s - first_s) / ROW_S).astype(np.int64), 0)
        row, kept = own, np.arange(len(own))
        if (np.diff(own) < 1).any():
            free, placed = 0, []
            for k, wanted in enumerate(own.tolist()):
                if (taken := max(wanted, free)) - wanted <= 2:
                    placed.append((k, taken))
                    free = taken + 1
            kept, row = np.array(placed).T
        now = row < n
        angle, time = np.full(n, np.nan), np.full(n, np.nan)
        angle[row[now]] = np.round(self.angle_deg[kept[now]], 4)
        time[row[now]] = np.round(self.time_s[kept[now]], 6)
        later = kept[~now]
        self.time_s, self.angle_deg = self.time_s[later], self.angle_deg[later]
        return angle, time


class Rig:
    """A table and a DAQ that are used together. Nothing is sent to either before `open`."""

    def __init__(
        self,
        url: str,
        table: Table,
        daq: Daq,
        *,
        simulated: bool = False,
        mount: Callable[[str, GyroModel], None] | None = None,
        ended: Callable[[], None] | None = None,
        heat: Callable[[bool], None] | None = None,
        later: Callable[[float], None] | None = None,
        one_way_s: float = 0.0,
    ) -> None:
        """`one_way_s`: how much earlier than they were the clocks alone make the encoders' readings seem, if known."""
        self.url, self.table, self.daq, self.simulated = url, table, daq, simulated
        self.connected = False
        self.rehearsed: str | None = None  # the board that the table was last turned slowly with
        self._faults: dict[str, DeviceError] = {}
        self._mount, self._ended, self._heat, self._later = mount, ended, heat, later
        self._one_way_s = one_way_s
        self._begun, self._starting = False, Lock()
        self._forget()

    def _forget(self) -> None:
        self.clock = ClockRelation()
        self._shafts = {axis: _Shaft() for axis in self.table.axes}
        self._volts: dict[str, float] = {}
        self._now_s = 0.0

    @property
    def axes(self) -> Mapping[str, Axis]:
        return self.table.axes

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of its rows, in order."""
        encoders = (f"{axis}_position_{what}" for axis in self.axes for what in ("deg", "time_s"))
        return ("time_s", *self.daq.channels, *encoders)

    @property
    def header(self) -> dict[str, str]:
        """What a recording's header says about how its rows were made."""
        gyros = [name for name in self.daq.channels if name.endswith("_gyro_v")]
        delays = {f"{name[0]}_gyro_delay_s": f"{i * self.daq.channel_delay_s:g}" for i, name in enumerate(gyros) if i}
        return {"rig": self.url, "gyro_average_s": f"{ROW_S:g}", **delays}

    def late(self, axis: str) -> int:
        """Answers of this axis' servo since `begin` that came too late to be timed."""
        return self._shafts[axis].late

    @property
    def clock_facts(self) -> dict[str, str]:
        """What was found of the two clocks since `begin`, for the recording's header."""
        return {"clock_offset_s": f"{self.clock.offset_s:.6f}", "clock_skew_ppm": f"{1e6 * self.clock.skew:.2f}"}

    def open(self) -> None:
        """Connect every part, also of a rig that is open already; raises the first part's `DeviceError`."""
        self._faults = {}
        self.connected = True
        for part, device in (("servo", self.table), ("daq", self.daq)):
            with suppress(DeviceError), self._asking(part):
                device.open()
        for fault in self._faults.values():
            raise fault

    @contextmanager
    def _asking(self, part: str) -> Iterator[None]:
        """Remembers that a part did not answer; a fault of one servo names its axis, and being stopped is none."""
        try:
            yield
        except DeviceError as fault:
            if fault.code == "rig.stopped":
                raise
            self._faults[f"servo {fault.values['axis']}" if "axis" in fault.values else part] = fault
            self.connected = False
            raise

    def status(self) -> list[dict[str, Any]]:
        """What is known of each part, without asking it: "part", "ok" (None: not known), "code" and "values"."""
        telemetry: Mapping[str, Telemetry] = {}
        if self.connected:
            with suppress(DeviceError), self._asking("servo"):
                telemetry = self.table.telemetry()
        known: list[dict[str, Any]] = []
        for part in (*(f"servo {axis}" for axis in self.axes), "daq", "gyro"):
            fault = self._faults.get(part) or self._faults.get(part.split()[0])
            axis = part[-1]
            if fault is not None:
                said: tuple[bool | None, str, dict[str, Any]] = False, fault.code, fault.values
            elif not self.connected or (part == "gyro" and not self._volts):
                said = None, "part.unknown", {}
            elif part == "gyro":
                said = True, "part.gyro", {f"{a}_V": round(v, 4) for a, v in self._volts.items()}
            elif part == "daq":
                said = True, "part.daq", {"part": self.daq.part, "rate_hz": self.daq.rate_hz}
            else:
                servo, can = telemetry[axis], self.axes[axis]
                values = {"supply_V": servo.supply_V, "temperature_degC": servo.temperature_degC}
                said = True, "part.servo", {"part": can.part, "highest_dps": can.max_rate_dps, **values}
            known.append({"part": part, "ok": said[0], "code": said[1], "values": said[2]})
        return known

    def mount(self, board: str, gyro_model: GyroModel) -> None:
        """Say which board is on the table. A simulated rig puts that board's gyro there; a real one has it already."""
        if self._mount is not None:
            self._mount(board, gyro_model)

    def heat(self, on: bool) -> None:
        """Heat the board, or leave it to cool. On a rig without a heater that is for whoever stands there."""
        if self._heat is not None:
            self._heat(on)

    def after(self, seconds: float) -> None:
        """Let a simulated rig be on for at least so long, so that what it measures next comes after; others are."""
        if self._later is not None:
            self._later(seconds)

    def begin(self) -> None:
        """Start sampling at time zero, and see that every part answers before anything moves."""
        if self._faults or not self.connected:
            self.open()
        self._forget()
        self._begun = True
        with self._asking("servo"):
            self.table.read()  # what was read before is of no recording
        self.daq.start()
        self.read(0.1)
        while self._now_s < SILENT_S and any(np.isnan(shaft.seen_deg) for shaft in self._shafts.values()):
            self.read(0.1)
        for axis, shaft in self._shafts.items():
            if np.isnan(shaft.seen_deg):
                raise self._fault(f"servo {axis}", "rig.servo_silent", axis=axis, part=self.axes[axis].part)
            shaft.from_deg = shaft.seen_deg

    def start(self, motions: Sequence[Motion]) -> None:
        """Begin these motions together, now. Raises `DeviceError`, also where the rig was made safe since `begin`."""
        with self._asking("servo"), self._starting:
            if not self._begun:
                raise DeviceError("rig.stopped")
            if not motions:
                return
            began_s = float(self.clock.to_daq(np.array([self.table.start(motions)]))[0])
        for motion in motions:
            shaft = self._shafts[motion.axis]
            shaft.from_deg = shaft.commanded_deg(began_s)
            shaft.motion, shaft.started_s = motion, began_s
            shaft.low_V, shaft.high_V = np.inf, -np.inf

    def waiting(self) -> Iterator[Block]:
        """Rows that came while nobody read: to be had before the next motion starts, or its segment would be late."""
        with self._asking("daq"):
            rows = self.daq.waiting() // MEAN_OF
        if rows * ROW_S >= LATE_S:
            yield self.read(rows * ROW_S)

    def read(self, seconds: float) -> Block:
        """The next rows, `seconds` long (a multiple of 0.01 s); waits for them as long as they take.

        Raises `DeviceError` where samples or readings do not come, a shaft is not where it was sent, or the gyro does
        not feel it turn.
        """
        n = round(seconds / ROW_S)
        with self._asking("daq"):
            samples = self.daq.read(n * MEAN_OF)
        with self._asking("servo"):
            readings = self.table.read()
        self._now_s = float(samples.time_s[-1])
        self.clock.add(self._now_s, samples.host_time_s)
        time_s = samples.time_s.reshape(n, MEAN_OF).mean(axis=1)
        volts = samples.volts.reshape(n, MEAN_OF, -1).mean(axis=1)
        columns = {"time_s": np.round(time_s, 6)}
        fast = {"time_s": np.round(samples.time_s, 6)}
        for i, name in enumerate(self.daq.channels):
            scale = SCALES.get(name, 1.0)
            columns[name] = np.round(scale * volts[:, i], 6)
            fast[name] = np.round(scale * samples.volts[:, i], 6)
        for axis, shaft in self._shafts.items():
            read = readings[axis]
            shaft.take(self.clock.to_daq(read.time_s) + self._one_way_s, read.angle_deg)
            shaft.late += read.late
            shaft.heard_s = max(shaft.seen_s, float(self.clock.to_daq(np.array([read.heard_s]))[0]))
            angle, at = shaft.rows(float(time_s[0]) - ROW_S / 2, n)
            columns[f"{axis}_position_deg"], columns[f"{axis}_position_time_s"] = angle, at
            self._watch(axis, shaft, columns.get(f"{axis}_gyro_v"))
        return Block(columns, fast)

    def _watch(self, axis: str, shaft: _Shaft, volts: F64 | None) -> None:
        """Raise the fault of this axis, if there is one."""
        who = {"axis": axis, "part": self.axes[axis].part}
        if self._now_s - max(shaft.heard_s, 0.0) > SILENT_S:
            raise self._fault(f"servo {axis}", "rig.servo_silent", **who)
        allowed = [shaft.commanded_deg(shaft.seen_s - lag) for lag in (0.0, STALL_LAG_S / 2, STALL_LAG_S)]
        seen = shaft.motion is not None and shaft.seen_s > shaft.started_s
        if seen and not min(allowed) - STALL_DEG <= shaft.seen_deg <= max(allowed) + STALL_DEG:
            raise self._fault(f"servo {axis}", "rig.stalled", **who, at_deg=shaft.seen_deg, sent_deg=allowed[0])
        if volts is None:
            return
        low, high = float(volts.min()), float(volts.max())
        self._volts[axis] = float(volts.mean())
        shaft.low_V, shaft.high_V = min(low, shaft.low_V), max(high, shaft.high_V)
        turning = shaft.motion is not None and shaft.motion.peak_rate_dps >= FELT_DPS
        if turning and not shaft.felt and abs(shaft.seen_deg - shaft.from_deg) >= FELT_DEG:
            if shaft.high_V - shaft.low_V < FELT_V:
                raise self._fault("gyro", "rig.gyro_still", axis=axis, seen_mV=1e3 * (shaft.high_V - shaft.low_V))
            shaft.felt = True

    def _fault(self, where: str, code: str, **values: object) -> DeviceError:
        fault = self._faults[where] = DeviceError(code, **values)
        return fault

    def safe(self) -> None:
        """Stop both devices, whatever state they are in; raises the first `DeviceError` after both were told."""
        failed: list[DeviceError] = []
        with self._starting:
            self._begun = False
        for shaft in self._shafts.values():
            shaft.motion = None
        self.heat(False)
        for device in (self.table, self.daq):
            try:
                device.safe()
            except DeviceError as fault:
                failed.append(fault)
        if failed:
            raise failed[0]

    def close(self) -> None:
        """Leave both devices safe and let go of them."""
        self.connected = False
        try:
            self.table.close()
        finally:
            self.daq.close()
            if self._ended is not None:
                self._ended()
