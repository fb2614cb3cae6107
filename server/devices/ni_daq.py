"""`nidaq:`, the real converter: differential, ±2.5 V, hardware-timed at 1 kHz, through NI's own library.

Differential, because a USB-6008 then steps by 1.22 mV, and by 9.77 mV single-ended. Reads are of an exact shape: the
library fills a larger array in the wrong places. A read waits in the driver, which sleeps; nothing here polls.
"""

import re
import threading
import time
from contextlib import suppress
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from calib_core.problem import Problem
from server.devices import DeviceError
from server.devices.ni_faults import fault
from server.devices.ni_session import Session, unreachable
from server.devices.protocols import Samples

F64 = NDArray[np.float64]

EXAMPLE = "nidaq:Dev1?channels=ai0,ai1"
COLUMNS = ("x_gyro_v", "z_gyro_v", "temperature_c", "supply_v")
RATE_HZ = 1000.0
LIMIT_V = 2.5
BUFFER_S = 10.0
LATE_S = 1.0  # samples that are this late do not come any more
PIECE = 50  # a read waits 0.05 s at a time, so that `safe` finds its turn
PROBE = 20
TURN_S = 0.15


class NiDaq:
    """Channels of one NI device. `server` is "host:port" of NI gRPC Device Server, or nothing for this computer."""

    rate_hz = RATE_HZ

    def __init__(
        self,
        device: str,
        inputs: tuple[str, ...],
        server: str = "",
        channel_delay_s: float = 1e-4,
        late_s: float = LATE_S,
    ) -> None:
        self.device, self.inputs, self.server = device, inputs, server
        self.channels: tuple[str, ...] = COLUMNS[: len(inputs)]
        self.channel_delay_s = channel_delay_s
        self.part = f"NI {device}"
        self._late_s = late_s
        self._session: Session | None = None
        self._reader: Any = None
        self._lock = threading.Lock()
        self._halt = threading.Event()
        self._running = False
        self._taken = 0

    @classmethod
    def from_url(cls, text: str) -> "NiDaq":
        """The DAQ that `[grpc://host:port/]Dev1?channels=ai0,ai1[,ai2[,ai3]][&channel_delay_us=100]` names.

        Raises Problem `daq.address`, `daq.option` or `daq.channels`.
        """
        place, _, query = text.partition("?")
        found = re.fullmatch(r"(?:grpc://((?:[\w.-]+|\[[0-9a-fA-F:.]+\]):(\d{1,5}))/)?([\w-]{1,64})", place, re.ASCII)
        if not found or (found[2] and not 0 < int(found[2]) < 65536):
            raise Problem("daq.address", given=f"nidaq:{text}", allowed=EXAMPLE)
        options = {"channels": "ai0,ai1", "channel_delay_us": "100"}
        given = parse_qsl(query, keep_blank_values=True)
        for name, value in given:
            if name not in options or [other for other, _ in given].count(name) > 1:
                raise Problem("daq.option", name=name, allowed=", ".join(options))
            options[name] = value
        inputs = tuple(options["channels"].split(","))
        named = all(re.fullmatch(r"ai\d{1,3}", channel, re.ASCII) for channel in inputs)
        if not named or len(set(inputs)) != len(inputs) or not 2 <= len(inputs) <= len(COLUMNS):
            raise Problem("daq.channels", given=options["channels"], allowed=EXAMPLE)
        delay = options["channel_delay_us"]
        if not re.fullmatch(r"\d{1,3}(\.\d{1,3})?", delay, re.ASCII):
            raise Problem("daq.delay", given=delay)
        return cls(found[3], inputs, found[1] or "", 1e-6 * float(delay))

    def load(self) -> None:
        """Import NI's library: a second during which this process' other threads keep no time, so before they run."""
        import nidaqmx.stream_readers

        if self.server:
            import nidaqmx._grpc_interpreter  # noqa: F401

    # --- the protocol ------------------------------------------------------------------------------------------
    def open(self) -> None:
        """Make the task and read a few samples: a device that is known may yet be unplugged. Raises `DeviceError`."""
        from nidaqmx.errors import Error

        with self._lock:
            self._leave()
            try:
                self._session = Session(self.device, self.server)
                self._configure(self._session.task)
                self._session.task.start()
                self._piece(PROBE)
                self._session.task.stop()
                self._reader.verify_array_shape = False  # it asks the driver each time; once was enough
            except Error as error:
                raise self._broken(error) from None

    def start(self) -> None:
        """Begin sampling; the DAQ's clock is 0 at the first sample. Raises `DeviceError`."""
        from nidaqmx.errors import Error

        with self._lock:
            self._stop()
            self._halt.clear()
            try:
                self._opened().task.start()
            except Error as error:
                raise self._broken(error) from None
            self._running, self._taken = True, 0

    def waiting(self) -> int:
        """Samples that are there already, not yet read. Raises `DeviceError`."""
        from nidaqmx.errors import Error

        with self._lock:
            try:
                return int(self._opened().task.in_stream.avail_samp_per_chan)
            except Error as error:
                raise self._broken(error) from None

    def read(self, n: int) -> Samples:
        """The next n samples, none of them lost; waits for them. Raises `DeviceError`, also once `safe` was called."""
        from nidaqmx.errors import Error

        volts = np.empty((n, len(self.inputs)))
        for done in range(0, n, PIECE):
            with self._lock:
                self._opened()
                if self._halt.is_set() or not self._running:
                    raise DeviceError("rig.stopped")
                try:
                    piece = self._piece(min(PIECE, n - done))
                except Error as error:
                    raise self._broken(error) from None
                host_time_s = time.perf_counter()
                if self._halt.is_set():
                    self._stop()
            volts[done : done + PIECE] = piece.T
        time_s = (self._taken + np.arange(n)) / RATE_HZ
        self._taken += n
        return Samples(time_s, volts, host_time_s)

    def safe(self) -> None:
        """Stop sampling. A read that waits for samples sees it at its next piece."""
        self._halt.set()
        if self._lock.acquire(timeout=TURN_S):
            try:
                if self._halt.is_set():  # not what somebody has started since
                    self._stop()
            finally:
                self._lock.release()

    def close(self) -> None:
        self._halt.set()
        with self._lock:
            self._leave()

    # --- behind the lock ---------------------------------------------------------------------------------------
    def _configure(self, task: Any) -> None:
        from nidaqmx.constants import AcquisitionType, TerminalConfiguration, WaitMode
        from nidaqmx.errors import Error
        from nidaqmx.stream_readers import AnalogMultiChannelReader

        for channel in self.inputs:
            task.ai_channels.add_ai_voltage_chan(
                f"{self.device}/{channel}",
                terminal_config=TerminalConfiguration.DIFF,
                min_val=-LIMIT_V,
                max_val=LIMIT_V,
            )
        task.timing.cfg_samp_clk_timing(
            RATE_HZ, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=round(BUFFER_S * RATE_HZ)
        )
        with suppress(Error):  # not every device can be told how to wait
            task.in_stream.wait_mode = WaitMode.SLEEP
            task.in_stream.sleep_time = 0.001
        with suppress(Error):
            self.part = f"NI {task.devices[0].product_type}"
        self._reader = AnalogMultiChannelReader(task.in_stream)

    def _piece(self, n: int) -> F64:
        piece = np.empty((len(self.inputs), n))
        got = self._reader.read_many_sample(piece, n, timeout=n / RATE_HZ + self._late_s)
        if got != n:  # it would be filled in the wrong places
            raise DeviceError("daq.late", **self.where())
        return piece

    def _opened(self) -> Session:
        if self._session is None:
            raise DeviceError("daq.not_open", part=self.part)
        return self._session

    def _stop(self) -> None:
        if self._running and self._session is not None:
            from nidaqmx.errors import Error

            with suppress(Error):
                self._session.task.stop()
        self._running = False

    def _leave(self, *, answering: bool = True) -> None:
        session, self._session, self._running = self._session, None, False
        if session is not None:
            session.close(answering=answering)

    def _broken(self, error: Exception) -> DeviceError:
        """After an error of the driver or the server nothing of this task is used again: `open` makes a new one."""
        self._leave(answering=not unreachable(error))
        return fault(error, **self.where())

    def where(self) -> dict[str, Any]:
        """What its sentences say of it."""
        return {
            "part": self.part,
            "device": self.device,
            "channels": ", ".join(self.inputs),
            "server": self.server,
            "place": {
                "code": "daq.place_server" if self.server else "daq.place_here",
                "values": {"server": self.server},
            },
        }
