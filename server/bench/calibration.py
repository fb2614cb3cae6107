"""A whole six-state run, from the command to its documents, as a process of its own; and its analysis alone."""

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
# A process counts the memory of whoever forked it as its own, so a small one stands between; it prints what was used.
BETWEEN = """
import resource, subprocess, sys, time
start = time.perf_counter()
subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, check=True)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(time.perf_counter() - start, used.ru_utime + used.ru_stime, used.ru_maxrss)
"""


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
        command = [sys.executable, "-c", BETWEEN, sys.executable, "-c", SCRIPT, *words]
        wall_s, cpu_s, peak = map(float, subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout.split())
    return wall_s, cpu_s, peak * (1e-6 if sys.platform == "darwin" else 1024e-6)  # bytes there, kB elsewhere
