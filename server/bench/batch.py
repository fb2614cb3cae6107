"""What one board of a batch costs a warm worker, and whether many cost more each than few.

The sessions are whole ones of the twin: six states, 268 000 rows. CPU is the worker's own, by its process clock.
"""

import io
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from calib_core.recording import Recording, write_csv, write_parquet
from calib_core.sequence import make_plan
from server import batch_work
from server.bench import Row
from server.devices import open_rig
from server.engine import record

FORMS: dict[str, tuple[Callable[[Recording, Any], None], float]] = {
    "Parquet": (write_parquet, 1.0),
    "CSV": (write_csv, 1.6),
}


def run(*, quick: bool) -> list[Row]:
    rounds = 2 if quick else 5
    load = f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores" if hasattr(os, "getloadavg") else ""
    whole = session(1)
    rows = []
    for form, (write, limit) in FORMS.items():
        source = written(whole, write)
        certified(source, "warm")
        costs = [certified(source, f"{form}-{n}") for n in range(rounds)]
        ours = f"{len(whole)} rows, {len(source) / 1e6:.1f} MB; {load}"
        rows.append(Row(f"One session from {form} to its PDF, CPU", min(costs), "s", limit, ours=ours))
        rows.append(Row(f"Boards an hour and core, from {form}", 3600.0 / min(costs), "boards"))
    rows.append(Row("Memory of that process, at most", peak_MB(), "MB", 500.0))
    rows += [growth(whole, 40 if quick else 500), linear(whole, quick)]
    return rows


def session(seed: int) -> Recording:
    rig = open_rig(f"twin:?seed={seed}")
    return record(make_plan(seed=seed), rig, board=f"LPY-{seed}")


def written(recording: Recording, write: Callable[[Recording, Any], None]) -> bytes:
    file = io.BytesIO()
    write(recording, file)
    return file.getvalue()


def certified(source: bytes, name: str) -> float:
    """CPU seconds from bytes to documents, as a worker spends them; the number makes each PDF another."""
    start = time.process_time()
    found = batch_work.certify(source, name, None, None)
    issued = {**found["content"], "number": f"GB-{name}", "issued_at": "2026-11-22T06:55:13.000Z", "board": name}
    batch_work.documents(issued, "en")
    return time.process_time() - start


def growth(whole: Recording, boards: int) -> Row:
    """How much more memory the process holds after many boards than after a few; short ones, so that many are."""
    source = written(whole.take(whole.where(lambda name: not name.startswith("position"))), write_parquet)
    few = 10
    at_first = 0.0
    for n in range(boards):
        certified(source, f"n-{n}")
        if n == few:
            at_first = resident_MB()
    ours = f"{boards} boards; {at_first:.0f} MB after {few}"
    return Row("Memory grown since the first boards", resident_MB() - at_first, "MB", 30.0, ours=ours)


def linear(whole: Recording, quick: bool) -> Row:
    """CPU a row at 10^6 rows over that at one session's: how far from a straight line."""
    times = 2 if quick else 4
    more = repeated(whole, times)
    one, many = written(whole, write_parquet), written(more, write_parquet)
    cost = min(certified(one, f"one-{n}") for n in range(2)) / len(whole)
    longer = min(certified(many, f"many-{n}") for n in range(2)) / len(more)
    ours = f"{len(more)} rows, {longer * 1e6:.2f} µs a row"
    return Row("CPU a row, long recording over one session", longer / cost, "×", 1.3, ours=ours)


def repeated(whole: Recording, times: int) -> Recording:
    """The session, several times one after another."""
    step_s = whole.duration_s + 1.0
    shifted = [np.round(whole.time_s + k * step_s, 6) for k in range(times)]
    columns = {
        name: np.concatenate([values + k * step_s if name.endswith("_time_s") else values for k in range(times)])
        for name, values in whole.columns.items()
    }
    codes = np.tile(whole.segment_codes, times)
    return Recording(np.concatenate(shifted), columns, codes, whole.segment_names, whole.header)


def resident_MB() -> float:
    import psutil

    return float(psutil.Process().memory_info().rss / 1e6)


def peak_MB() -> float:
    try:
        import resource
    except ImportError:  # Windows keeps it elsewhere
        import psutil

        return float(psutil.Process().memory_info().peak_wset / 1e6)  # type: ignore[attr-defined]
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
