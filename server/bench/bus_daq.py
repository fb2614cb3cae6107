"""The DAQ half of `bench bus`: what its driver costs, how well the clocks are related, a soak of the whole bench."""

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from server.bench import Row

if TYPE_CHECKING:
    from server.devices.rig import Rig

BLOCK_S = 0.05
SOAK_S = 600.0
SETTLED_S = 60.0
SWING_S, CYCLES = 40.0, 10


def run(*, quick: bool) -> list[Row]:
    """The DAQ driver alone, through the emulated NI gRPC server."""
    from server.devices.ni_daq import NiDaq

    with _bench() as (bench, rig):
        daq = rig.daq
        assert isinstance(daq, NiDaq)
        with closing(daq):
            daq.open()
            daq.start()
            blocks = round((4.0 if quick else 20.0) / BLOCK_S)
            began, spent = time.perf_counter(), time.process_time()
            read = sum(len(daq.read(50).time_s) for _ in range(blocks))
            cpu, wall = time.process_time() - spent, time.perf_counter() - began
            lost = _position(bench) - read
        return [
            Row("DAQ driver, 2 channels at 1 kHz over gRPC", 100.0 * cpu / wall, "% of a core", 15.0),
            Row("DAQ samples lost", lost, f"of {read}", 0),
        ]


def soak(seconds: float = SOAK_S) -> list[Row]:
    """Both devices for `seconds`, both axes swinging: nothing lost, memory flat, the clocks as they truly are."""
    import psutil

    from calib_core.sequence import Move, Wave

    process = psutil.Process()
    with _bench() as (bench, rig):
        rig.open()
        rig.begin()
        rig.start([Move(axis, 0.0, 50.0) for axis in rig.axes])
        rig.read(1.0)
        blocks, swing = round(seconds / BLOCK_S), round(SWING_S / BLOCK_S)
        waves = [Wave(axis, (30.0,), (CYCLES / (SWING_S - 0.5),), SWING_S - 0.5) for axis in rig.axes]
        read, seen, gap = 1100, dict.fromkeys(rig.axes, 0), dict.fromkeys(rig.axes, 0.0)
        last: dict[str, float] = {}
        error_ms, memory = [], []
        began, spent = time.perf_counter(), time.process_time()
        for k in range(blocks):
            if k % swing == 0:
                rig.start(waves)
            columns = rig.read(BLOCK_S).columns
            read += 10 * len(columns["time_s"])
            for axis in rig.axes:
                at = columns[f"{axis}_position_time_s"]
                at = at[np.isfinite(at)]
                seen[axis] += len(at)
                steps = np.diff(at, prepend=last.get(axis, at[0])) if len(at) else np.zeros(1)
                gap[axis] = max(gap[axis], float(steps.max()))
                last[axis] = float(at[-1]) if len(at) else last.get(axis, 0.0)
            if k % 20 == 0:
                memory.append(process.memory_info().rss / 1e6)
                now = time.perf_counter()
                error_ms.append(1e3 * (float(rig.clock.to_daq(np.array([now]))[0]) - bench.plant.daq_time_s(now)))
        cpu, wall = time.process_time() - spent, time.perf_counter() - began
        lost = _position(bench) - read
        true = bench.plant.daq_spec().clock_error
        rig.safe()
    settled = round(min(SETTLED_S, seconds / 2))
    late_ms = np.array(error_ms[settled:])
    return [
        Row("soak", wall, "s"),
        Row("DAQ samples lost", lost, f"of {read}", 0),
        *(Row(f"encoder readings, axis {axis}", seen[axis] / wall, "per s", 95.0, at_least=True) for axis in rig.axes),
        *(Row(f"longest wait for a reading, axis {axis}", 1e3 * gap[axis], "ms", 100.0) for axis in rig.axes),
        Row("memory grown after the first minute", memory[-1] - memory[settled], "MB", 3.0),
        Row("both drivers", 100.0 * cpu / wall, "% of a core", 15.0),
        Row("servo times on the DAQ's clock, mean error", float(late_ms.mean()), "ms"),
        Row("servo times on the DAQ's clock, spread", float(np.ptp(late_ms)), "ms", 1.0),
        Row("DAQ clock against the computer's, found", 1e6 * rig.clock.skew, "ppm"),
        Row("the same, true", 1e6 * true, "ppm"),
    ]


@contextmanager
def _bench() -> Iterator[tuple[Any, "Rig"]]:
    from server import emulators
    from server.devices import open_rig

    bench = emulators.start(1)
    try:
        rig = open_rig(bench.url)
        with closing(rig):
            yield bench, rig
    finally:
        bench.close()


def _position(bench: Any) -> int:
    """How many samples the server has handed out to the one task there is."""
    (task,) = bench.daq.shown().values()
    return int(task["position"])
