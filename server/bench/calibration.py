"""A whole six-state run, from the command to its documents, as a process of its own; and its analysis alone."""

import os
import subprocess
import sys
import tempfile
import time

from calib_core import session
from calib_core.sequence import make_plan
from server.bench import Row
from server.devices import open_rig
from server.engine import record

SCRIPT = "import sys; from server.cli import main; sys.exit(main())"


def run(*, quick: bool) -> list[Row]:
    wall_s, cpu_s, peak_MB = calibrate()
    recording = record(make_plan("standard", seed=1), open_rig("twin:?seed=1"), board="bench")
    least = float("inf")
    for _ in range(2 if quick else 4):
        start = time.process_time()
        session.analyse(recording)
        least = min(least, time.process_time() - start)
    return [
        Row(
            "Six states to the certificate, wall", wall_s, "s", 20.0, ours=f"calibrate, 22 readings, {cpu_s:.1f} s CPU"
        ),
        Row("Six states to the certificate, memory", peak_MB, "MB", 400.0, ours="largest resident size"),
        Row(f"Session of {len(recording)} rows analysed, CPU", least, "s", 0.6, ours="session.analyse"),
    ]


def calibrate() -> tuple[float, float, float]:
    """Wall and CPU seconds and the peak resident size (MB) of `gyrobench calibrate` at full speed."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["calibrate", "--board", "bench", "--rig", "twin:?seed=1", "--data", folder, "--out", folder, "--json"]
        start = time.perf_counter()
        process = subprocess.Popen([sys.executable, "-c", SCRIPT, *words], stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(process.pid, 0)
        wall_s = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"calibrate left with {process.returncode}")
    unit = 1024 if sys.platform != "darwin" else 1  # ru_maxrss is kB on Linux, bytes on macOS
    return wall_s, used.ru_utime + used.ru_stime, used.ru_maxrss * unit / 1e6
