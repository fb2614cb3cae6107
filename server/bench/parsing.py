"""Recordings in and out: parsing against csv.reader, the store's blobs against numpy's compressed files.

All figures are CPU seconds of the whole process, so a second thread would be counted and win nothing.
"""

import csv
import io
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from calib_core.packing import pack_recording, unpack_recording
from calib_core.recording import F64, Recording, read, write_csv
from server.bench import Row

ROWS = 200_000
STEP_DEG, CODE_V = 300.0 / 1023.0, 5.0 / 4096.0


def run(*, quick: bool) -> list[Row]:
    recording = session(ROWS)
    file = io.BytesIO()
    write_csv(recording, file)
    data = file.getvalue()
    text = data.decode()
    rounds = 3 if quick else 9
    theirs, ours = least_cpu(
        lambda: deque(csv.reader(io.StringIO(text, newline="")), maxlen=0), lambda: read(data), rounds=rounds
    )
    columns = {"time_s": recording.time_s, **recording.columns}
    npz, pack = least_cpu(lambda: npz_bytes(columns), lambda: pack_recording(recording), rounds=rounds)
    blob = pack_recording(recording)
    [unpack] = least_cpu(lambda: unpack_recording(blob), rounds=rounds)
    raw_MB = ROWS * len(columns) * 8 / 1e6
    return [
        Row(
            "Recording parsed and checked, CPU", ours / theirs, "×", 0.5,
            ours=f"{ours / ROWS * 1e6:.3f} µs/row",
            theirs=f"csv.reader without conversion {theirs / ROWS * 1e6:.3f} µs/row",
        ),
        Row(
            f"Samples of {ROWS} × {len(columns)}, packed", len(blob) / 1e6, "MB", 1.2,
            ours="pack_recording", theirs=f"np.savez_compressed {len(npz_bytes(columns)) / 1e6:.2f} MB",
        ),
        Row(
            "Samples packed, CPU", npz / pack, "× faster", 5.0, at_least=True,
            ours=f"{raw_MB / pack:.0f} MB/s", theirs=f"np.savez_compressed {raw_MB / npz:.0f} MB/s",
        ),
        Row("Samples unpacked, CPU", raw_MB / unpack, "MB/s"),
    ]  # fmt: skip


def least_cpu(*works: Callable[[], object], rounds: int) -> list[float]:
    """CPU seconds of each work, the least of ``rounds`` taken in turns."""
    best = [float("inf")] * len(works)
    for _ in range(rounds):
        for k, work in enumerate(works):
            start = time.process_time()
            work()
            best[k] = min(best[k], time.process_time() - start)
    return best


def npz_bytes(columns: dict[str, F64]) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **columns)
    return file.getvalue()


def session(rows: int) -> Recording:
    """100 Hz rows as the bench gives them: sine and strokes, encoder steps, means of ten converter codes, noise."""
    rng = np.random.default_rng(1)
    time_s = np.round(np.arange(rows) / 100.0, 6)
    stroke = np.floor(time_s / 4.0).astype(int)
    speed = np.array([20, -20, 60, -60, 100, -100, 10, -10])[stroke % 8] * (time_s % 4.0 < 1.8)
    rate = {"x": np.where(time_s < 100.0, 47.37 * np.cos(2 * np.pi * 0.2513 * time_s), speed), "z": np.zeros(rows)}
    columns: dict[str, F64] = {}
    for axis, rate_dps in rate.items():
        angle = np.cumsum(rate_dps) / 100.0
        columns[f"{axis}_position_deg"] = np.round(np.round(angle / STEP_DEG) * STEP_DEG, 4)
    for axis, rate_dps in rate.items():
        samples = 1.25 + 0.0059 * rate_dps[:, None] + 0.0012 * np.sqrt(10) * rng.standard_normal((rows, 10))
        columns[f"{axis}_gyro_v"] = np.round((np.round(samples / CODE_V) * CODE_V).mean(axis=1), 6)
    columns["temperature_c"] = np.round(25 + time_s / 1000 + 0.05 * rng.standard_normal(rows), 2)
    names = tuple(f"rate_x/repeat/{'+-'[k % 2]}{20 * (k % 5 + 1)}/{k // 10 + 1}" for k in range(stroke[-1] + 1))
    return Recording(time_s, columns, stroke.astype(np.int32), names, {"format": "gyro-recording 1"})
