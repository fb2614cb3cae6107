"""A real server in its own process, for tests that need one."""

import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import IO, Any

import httpx
from shared import ROOT

READY_S = 30.0


class Server:
    """`gyrobench serve` on a free port; `address` once it has printed it."""

    def __init__(self, data: Path, *options: str, stderr: IO[str] | None = None) -> None:
        self.data = data
        command = [sys.executable, "-m", "server.cli", "serve", "--port", "0", "--data", str(data), *options]
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            cwd=ROOT,
            encoding="utf-8",
            start_new_session=True,
        )
        assert self.process.stdout is not None
        self.printed = [self.process.stdout.readline()]
        found = re.search(r"http://\S+:\d+", self.printed[0])
        assert found, f"no address in {self.printed[0]!r}"
        self.address = found.group()
        # What it prints later must not fill the pipe.
        threading.Thread(target=self.printed.extend, args=[self.process.stdout], daemon=True).start()
        self.client = httpx.Client(base_url=f"{self.address}/api/v1", timeout=60.0)

    def worker_ready(self) -> "Server":
        """Waits until the worker has opened its rig: `POST rig/check` answers then, or says that it cannot."""
        answer = self.client.post("/rig/check")
        assert answer.status_code == 200, answer.text
        return self

    def run(self, **body: Any) -> dict[str, Any]:
        """Starts a run; fails the test where it is refused."""
        answer = self.client.post("/runs", json={"board": "LPY-1", "readings": 3, "speed": "max", **body})
        assert answer.status_code == 201, answer.text
        started: dict[str, Any] = answer.json()
        return started

    def ended(self, run: str) -> dict[str, Any]:
        """The run at its end, awaited at its live socket."""
        from websockets.sync.client import connect

        with connect(f"{self.address.replace('http', 'ws')}/api/v1/runs/{run}/live", max_size=None) as socket:
            for _ in socket:
                pass
        shown: dict[str, Any] = self.client.get(f"/runs/{run}").json()
        return shown

    def close(self) -> None:
        self.client.close()
        self.process.terminate()
        self.process.wait(10)
