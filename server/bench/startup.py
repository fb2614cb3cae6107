"""What the server's own process spends until it answers, against importing fastapi and numpy alone."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from server.bench import Row

IMPORTS = "import fastapi, numpy"
BUILDS = """
import pathlib, server.app, server.settings
server.app.create_app(server.settings.Settings(pathlib.Path({data!r})))
"""
REPORT = "\nimport time; print(time.process_time())"


def run(*, quick: bool) -> list[Row]:
    rounds = 3 if quick else 9
    with tempfile.TemporaryDirectory() as directory:
        scripts = (IMPORTS + REPORT, BUILDS.format(data=directory) + REPORT)
        theirs, ours, served = [], [], []
        for _ in range(rounds):  # in turns, so that a busy moment meets all of them
            theirs.append(_cpu(scripts[0]))
            ours.append(_cpu(scripts[1]))
            served.append(_serving(Path(directory)))
    least = min(theirs)
    alone = f"importing fastapi and numpy {least * 1e3:.0f} ms"
    return [
        Row("Server start-up, app built", min(ours) / least, "×", 1.4, ours=f"{min(ours) * 1e3:.0f} ms", theirs=alone),
        Row(
            "Server start-up, `serve` answering", min(served) / least, "×", 1.4,
            ours=f"{min(served) * 1e3:.0f} ms, worker not counted", theirs=alone,
        ),
    ]  # fmt: skip


def _cpu(script: str) -> float:
    """CPU seconds of a fresh interpreter, its own start included."""
    return float(subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout)


def _serving(data: Path) -> float:
    """CPU seconds of ``gyrobench serve`` by the time it prints its address; its worker is another process."""
    command = [sys.executable, "-m", "server.cli", "serve", "--port", "0", "--data", str(data)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        if not server.stdout.readline():
            raise RuntimeError(f"{' '.join(command)} ended before it answered")
        stat = Path(f"/proc/{server.pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        server.terminate()
    return (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK")
