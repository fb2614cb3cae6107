"""What the server's own process spends until it answers, against importing fastapi and numpy alone."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from server.bench import Row

IMPORTS = "import fastapi, numpy"
REPORT = "\nimport time; print(time.process_time())"


def run(*, quick: bool) -> list[Row]:
    rounds = 3 if quick else 9
    with tempfile.TemporaryDirectory() as directory:
        # Both from compiled modules, as every start but the first is, wherever this one may write them.
        compiled = {"PYTHONPYCACHEPREFIX": str(Path(directory, "compiled"))}
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"} | compiled
        theirs, served = [], []
        for _ in range(rounds + 1):  # in turns, so that a busy moment meets both; the first compiles
            theirs.append(_cpu(IMPORTS + REPORT, environment))
            served.append(_serving(Path(directory), environment))
    least = min(theirs)
    alone = f"importing fastapi and numpy {least * 1e3:.0f} ms"
    return [
        Row(
            "Server start-up, until `serve` answers", min(served) / least, "×", 1.4,
            ours=f"{min(served) * 1e3:.0f} ms, worker not counted", theirs=alone,
        ),
    ]  # fmt: skip


def _cpu(script: str, environment: dict[str, str] | None = None) -> float:
    """CPU seconds of a fresh interpreter, its own start included."""
    command = [sys.executable, "-c", script]
    return float(subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout)


def _serving(data: Path, environment: dict[str, str]) -> float:
    """CPU seconds of ``gyrobench serve`` by the time it prints its address; its worker is another process."""
    command = [sys.executable, "-m", "server.cli", "serve", "--port", "0", "--data", str(data)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as server:
        assert server.stdout is not None
        if not server.stdout.readline():
            raise RuntimeError(f"{' '.join(command)} ended before it answered")
        stat = Path(f"/proc/{server.pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        server.terminate()
        server.stdout.read()
    return (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK")
