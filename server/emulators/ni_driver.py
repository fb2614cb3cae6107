"""A stand-in for NI-DAQmx and one USB-6008: tasks, a buffer, a clock, and the driver's error codes (HARDWARE).

No gRPC here; `ni_service` puts it on the wire. Where the samples come from is a `Source`: the plant's process, or
anything else that counts and gives them.
"""

import threading
import time
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

NO_DEVICE, NO_CHANNEL = -200220, -200170
OVERRUN, TIMEOUT, UNPLUGGED, RESERVED = -200279, -200284, -201003, -50103
NO_TASK, DUPLICATE_TASK, NEVER, BAD_VALUE, NO_ATTRIBUTE = -200088, -200089, -200278, -200077, -200452
NI_WORDS = {
    NO_DEVICE: "Device identifier is invalid.",
    NO_CHANNEL: "Physical channel specified does not exist on this device.",
    OVERRUN: "The application is not able to keep up with the hardware acquisition.",
    TIMEOUT: "Some or all of the samples requested have not yet been acquired.",
    UNPLUGGED: "Device cannot be accessed.",
    RESERVED: "The specified resource is reserved.",
    NO_TASK: "Task specified is invalid or does not exist.",
    DUPLICATE_TASK: "Task name conflicts with an existing task name.",
    NEVER: "The task was stopped while it was read.",
    NO_ATTRIBUTE: "Specified property is not supported by the device.",
    BAD_VALUE: "Requested value is not a supported value for this property.",
}
DIFFERENTIAL, SINGLE_ENDED = 10106, 10083
FLOATING_V = 1.4  # an open input
SINGLE_ENDED_STEP_V = 20.0 / 2048.0
INPUTS = 8
CONNECTED = 4
HIGHEST_RATE_HZ = 10_000.0


class DaqmxError(Exception):
    """An error of the driver; `read` is how many samples a channel it had read."""

    def __init__(self, code: int, read: int | None = None) -> None:
        super().__init__(NI_WORDS.get(code, "An error of the driver."))
        self.code, self.read = code, read


class Source(Protocol):
    """A converter that runs by its own clock; four inputs are connected, in V."""

    rate_hz: float

    def start(self) -> None: ...
    def taken(self) -> int:
        """Samples taken since the start."""

    def read(self, first: int, n: int) -> F64:
        """(n, 4), once they were taken, in order."""

    def latency_s(self) -> float:
        """How long after its last sample the next transfer is in the host's hands."""


@dataclass(eq=False)
class Task:
    """One task of one client; the server keeps it until it is cleared, whatever became of the client."""

    name: str
    inputs: list[tuple[int, int]] = field(default_factory=list)  # number of the input, terminal configuration
    rate_hz: float = 0.0
    buffer: int = 10_000
    running: bool = False
    position: int = 0


class Device:
    """The driver with one device. Faults on demand: see the methods from `fail` on."""

    def __init__(self, source: Source, name: str = "Dev1", product: str = "USB-6008") -> None:
        self.source, self.name, self.product = source, name, product
        self.tasks: dict[str, Task] = {}
        self._owner: Task | None = None
        self._numbers = 0
        self._changed = threading.Condition()
        self._failures: dict[str, list[int]] = {}
        self._unplugged = False
        self._stalled_at: int | None = None
        self._hung = threading.Event()
        self._hung.set()
        self._noise = np.random.default_rng(1)

    # --- what the driver does ----------------------------------------------------------------------------------
    def create(self, name: str) -> Task:
        self._meet("CreateTask")
        if name in self.tasks:
            raise DaqmxError(DUPLICATE_TASK)
        self._numbers += 1
        task = Task(name or f"_unnamedTask<{self._numbers:X}>")
        self.tasks[task.name] = task
        return task

    def task(self, name: str) -> Task:
        if name not in self.tasks:
            raise DaqmxError(NO_TASK)
        return self.tasks[name]

    def add_voltage_channel(self, task: Task, physical: str, terminals: int, low_V: float, high_V: float) -> None:
        self._meet("CreateAIVoltageChan")
        device, _, channel = physical.partition("/")
        if device != self.name:
            raise DaqmxError(NO_DEVICE)
        number = channel.removeprefix("ai")
        last = CONNECTED if terminals == DIFFERENTIAL else INPUTS
        if not channel.startswith("ai") or not number.isdigit() or int(number) >= last:
            raise DaqmxError(NO_CHANNEL)
        if (terminals, low_V, high_V) not in ((DIFFERENTIAL, -2.5, 2.5), (SINGLE_ENDED, -10.0, 10.0)):
            raise DaqmxError(BAD_VALUE)
        task.inputs.append((int(number), terminals))

    def time_by_clock(self, task: Task, rate_hz: float, samples: int) -> None:
        self._meet("CfgSampClkTiming")
        if rate_hz != self.source.rate_hz or rate_hz * len(task.inputs) > HIGHEST_RATE_HZ:
            raise DaqmxError(BAD_VALUE)
        task.rate_hz, task.buffer = rate_hz, max(samples, 1000)

    def start(self, task: Task) -> None:
        with self._changed:
            self._meet("StartTask")
            if self._owner not in (None, task):
                raise DaqmxError(RESERVED)
            if not task.running:
                self._owner, task.running, task.position = task, True, 0
                self.source.start()

    def stop(self, task: Task) -> None:
        self._meet("StopTask", present=False)
        with self._changed:
            task.running = False
            if self._owner is task:
                self._owner = None
            self._changed.notify_all()

    def clear(self, task: Task) -> None:
        self.stop(task)
        self.tasks.pop(task.name, None)

    def available(self, task: Task) -> int:
        self._meet("GetReadAttributeUInt32")
        return self._there(task) - task.position

    def read(self, task: Task, n: int, timeout_s: float) -> tuple[F64, int]:
        """The next n samples (channels, n) and how many of them came in time; the rest is 0."""
        if not task.running:
            self.start(task)
        until = time.perf_counter() + timeout_s
        with self._changed:
            while True:
                self._meet("ReadAnalogF64")
                if not task.running:
                    raise DaqmxError(NEVER, 0)
                lacking = task.position + n - self._there(task)
                left = until - time.perf_counter()
                if lacking <= 0 or left <= 0:
                    break
                self._changed.wait(min(lacking / task.rate_hz, left))
            got = n - max(lacking, 0)
            first, task.position = task.position, task.position + got
        time.sleep(self.source.latency_s())
        volts = np.zeros((len(task.inputs), n))
        taken = self.source.read(first, got)
        for row, (number, terminals) in zip(volts, task.inputs, strict=True):
            row[:got] = self._converted(taken, number, terminals)
        return volts, got

    def _there(self, task: Task) -> int:
        """How many samples this task has taken; raises the overrun where unread ones were overwritten."""
        taken = self.source.taken()
        if self._stalled_at is not None:
            taken = min(taken, self._stalled_at)
        if taken - task.position > task.buffer:
            raise DaqmxError(OVERRUN, 0)
        return taken

    def _converted(self, taken: F64, number: int, terminals: int) -> F64:
        if terminals == DIFFERENTIAL:
            return taken[:, number]
        volts = taken[:, number] if number < CONNECTED else FLOATING_V + 1e-3 * self._noise.standard_normal(len(taken))
        return np.rint(volts / SINGLE_ENDED_STEP_V) * SINGLE_ENDED_STEP_V

    def _meet(self, function: str, *, present: bool = True) -> None:
        """Whatever was asked to go wrong with this function goes wrong now."""
        self._hung.wait()
        if self._failures.get(function):
            raise DaqmxError(self._failures[function].pop(0), 0)
        if present and self._unplugged and function in ("StartTask", "ReadAnalogF64", "GetReadAttributeUInt32"):
            raise DaqmxError(UNPLUGGED, 0)

    # --- what can go wrong, on demand --------------------------------------------------------------------------
    def fail(self, function: str, code: int, times: int = 1) -> None:
        """The next calls of this RPC (its name as on the wire) fail with this code."""
        with self._changed:
            self._failures.setdefault(function, []).extend([code] * times)
            self._changed.notify_all()

    def unplug(self, unplugged: bool = True) -> None:
        """Pull the USB cable, or put it back; a task that was running is not running any more."""
        with self._changed:
            self._unplugged = unplugged
            self._changed.notify_all()

    def stall(self, stalled: bool = True) -> None:
        """The sample clock stops, or goes on: reads end in the driver's time-out with a part of what was asked."""
        with self._changed:
            self._stalled_at = self.source.taken() if stalled else None
            self._changed.notify_all()

    def hang(self, hung: bool = True) -> None:
        """No call is answered, as behind a switch that died; or all are again."""
        (self._hung.clear if hung else self._hung.set)()

    def forget(self) -> None:
        """All tasks are gone, as after the server was started again or another client took the device."""
        with self._changed:
            for task in self.tasks.values():
                task.running = False
            self.tasks.clear()
            self._owner = None
            self._changed.notify_all()

    def shown(self) -> dict[str, dict[str, object]]:
        """What the server holds, for tests: name -> running, position, inputs."""
        return {
            name: {"running": task.running, "position": task.position, "inputs": task.inputs}
            for name, task in self.tasks.items()
        }
