"""The server's process for work that takes more than a moment."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from recordings import csv_bytes, csv_lines
from shared import ROOT

from calib_core.problem import Problem
from server.compute import import_recording
from server.store import Store

SERVER = """
import asyncio, os, signal
from server.compute import Compute

async def main():
    print(await Compute().run(os.getpid), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)

if __name__ == "__main__":
    asyncio.run(main())
"""


def test_it_ends_with_a_server_that_was_killed(tmp_path: Path) -> None:
    script = tmp_path / "killed.py"
    script.write_text(SERVER, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    # Both hold this pipe, so its end is the end of the last of them.
    done = subprocess.run([sys.executable, str(script)], stdout=subprocess.PIPE, timeout=60, env=environment)
    assert done.returncode == -signal.SIGKILL
    assert int(done.stdout) > 0


def test_a_recording_of_a_board_that_cannot_be_is_refused_whole(tmp_path: Path) -> None:
    file = tmp_path / "upload"
    file.write_bytes(b"# board: LPY 1;drop\n" + csv_bytes(csv_lines()))
    with pytest.raises(Problem) as refused:
        import_recording(tmp_path, file, "run.csv", None, None)
    assert refused.value.code == "board.characters"
    assert import_recording(tmp_path, file, "run.csv", None, "LPY-1")
    with Store(tmp_path) as store:
        assert [row["board"] for row in store.recordings.find()[0]] == ["LPY-1"]
        assert [row["id"] for row in store.boards.find()[0]] == ["LPY-1"]
