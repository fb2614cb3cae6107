"""A whole server at a batch: one worker against two, and how soon it answers others meanwhile."""

import io
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
import uuid
from dataclasses import replace
from typing import Any

from calib_core.recording import write_parquet
from server.bench import Row
from server.bench.batch import session

HEALTH_EVERY_S = 0.05
LAST = 0.99


def run(*, quick: bool) -> list[Row]:
    whole = session(1)
    boards = []
    for n in range(8 if quick else 40):
        file = io.BytesIO()
        write_parquet(replace(whole, header={**whole.header, "board": f"LPY-{n}"}), file)
        boards.append((f"LPY-{n}.parquet", file.getvalue()))
    load = f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores" if hasattr(os, "getloadavg") else ""
    one, two = served(boards, 1), served(boards, 2)
    answers = sorted(one["answers"] + two["answers"])
    p99 = answers[int(LAST * (len(answers) - 1))]
    return [
        Row("Two workers against one", two["rate"] / one["rate"], "×", 1.7, at_least=True, ours=load),
        Row("Boards an hour, two workers", 3600.0 * two["rate"], "boards", ours=f"{len(boards)} sessions; {load}"),
        Row(
            "Health during a batch, p99", 1e3 * p99, "ms", 100.0,
            ours=f"{len(answers)} requests, median {1e3 * statistics.median(answers):.1f} ms",
        ),
    ]  # fmt: skip


def served(boards: list[tuple[str, bytes]], workers: int) -> dict[str, Any]:
    """Boards a second once the workers are warm, and seconds that each request for health took."""
    with tempfile.TemporaryDirectory() as data:
        command = [sys.executable, "-m", "server.cli", "serve", "--port", "0", "--data", data]
        environment = {**os.environ, "GYROBENCH_WORKERS": str(workers)}
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as server:
            assert server.stdout is not None
            address = server.stdout.readline().split()[1].rstrip("/") + "/api/v1"
            try:
                return {"rate": _rate(address, boards, workers), "answers": _healths(address, boards)}
            finally:
                server.terminate()


def _rate(address: str, boards: list[tuple[str, bytes]], workers: int) -> float:
    _wait(address, _send(address, boards[: 2 * workers]))
    batch = _send(address, boards)
    _wait(address, batch)
    shown = _get(f"{address}/batches/{batch}")
    began, ended = (time.strptime(shown[name][:19], "%Y-%m-%dT%H:%M:%S") for name in ("began_at", "finished_at"))
    fractions = [float(shown[name][19:-1]) for name in ("began_at", "finished_at")]
    return len(boards) / (time.mktime(ended) - time.mktime(began) + fractions[1] - fractions[0])


def _healths(address: str, boards: list[tuple[str, bytes]]) -> list[float]:
    """While the same boards come in and are done again."""
    done = threading.Event()

    def work() -> None:
        _wait(address, _send(address, boards))
        done.set()

    threading.Thread(target=work, daemon=True).start()
    taken = []
    while not done.wait(HEALTH_EVERY_S):
        start = time.perf_counter()
        _get(f"{address}/health")
        taken.append(time.perf_counter() - start)
    return taken


def _send(address: str, boards: list[tuple[str, bytes]]) -> str:
    boundary = uuid.uuid4().hex
    body = bytearray()
    for name, content in boards:
        body += f'--{boundary}\r\nContent-Disposition: form-data; name="files"; filename="{name}"\r\n\r\n'.encode()
        body += content + b"\r\n"
    body += f"--{boundary}--\r\n".encode()
    kind = {"Content-Type": f"multipart/form-data; boundary={boundary}"}
    with urllib.request.urlopen(urllib.request.Request(f"{address}/batches", bytes(body), kind)) as answer:
        return str(json.load(answer)["id"])


def _wait(address: str, batch: str) -> None:
    while _get(f"{address}/batches/{batch}")["finished_at"] is None:
        time.sleep(0.1)


def _get(address: str) -> dict[str, Any]:
    with urllib.request.urlopen(address, timeout=60) as answer:
        found: dict[str, Any] = json.load(answer)
        return found
