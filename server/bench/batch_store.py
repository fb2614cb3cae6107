"""What the one writer and the store take of a batch: commits, size, lists of 10^5 certificates."""

import tempfile
import time
from pathlib import Path
from typing import Any

from server import batch_work
from server.bench import Row
from server.bench.batch import session, written
from server.store import Store
from server.store_db import FILE, dumps

TOGETHER = 32


def run(*, quick: bool) -> list[Row]:
    from calib_core.recording import write_parquet

    found = batch_work.certify(written(session(1), write_parquet), "LPY-1", None, None)
    with tempfile.TemporaryDirectory() as folder:
        rows = writing(Path(folder), found, 64 if quick else 256)
    with tempfile.TemporaryDirectory() as folder:
        rows += lists(Path(folder), found["content"], 10_000 if quick else 100_000)
    return rows


def writing(data: Path, found: dict[str, Any], boards: int) -> list[Row]:
    """As the batch process writes: several boards a transaction, each transaction on disk before the next."""
    with Store(data) as store:
        empty = (data / FILE).stat().st_size
        start = time.perf_counter()
        for first in range(0, boards, TOGETHER):
            with store.connection.write(durable=True):
                for n in range(first, min(first + TOGETHER, boards)):
                    batch_work.keep(store, other(found, n), f"{n}.parquet")
        taken = time.perf_counter() - start
        store.connection.db.execute("pragma wal_checkpoint(truncate)")
        size = (data / FILE).stat().st_size - empty
    return [
        Row("Boards written a second, samples and certificate", boards / taken, "/s", ours=f"{TOGETHER} a transaction"),
        Row(
            "Database, a board", size / boards / 1e6, "MB", ours=f"{len(found['packed']['data']) / 1e6:.2f} MB samples"
        ),
    ]


def other(found: dict[str, Any], n: int) -> dict[str, Any]:
    """The same board under another name: the store sees another recording."""
    board = f"LPY-{n:05d}"
    digest = f"sha256:{n:064x}"
    packed = {**found["packed"], "digest": digest, "header": {**found["packed"]["header"], "board": board}}
    recording = {**found["content"]["recording"], "digest": digest}
    return {**found, "packed": packed, "content": {**found["content"], "board": board, "recording": recording}}


def lists(data: Path, content: dict[str, Any], certificates: int) -> list[Row]:
    """Pages and searches as the API asks for them, the slowest of several places."""
    text = dumps(content)[:5000]  # as long as the whole on the pages that a list reads; the rest lies elsewhere
    with Store(data) as store:
        with store.connection.write() as db:
            db.conn.executemany(
                "insert into certificates (number, key, board, recording, verdict, issued_at, operator, content) "
                "values (?, ?, ?, ?, 'issued', '2026-11-22T06:55:13.000Z', 'Ada', ?)",
                ((f"GB-2026-{n:05d}", str(n), f"LPY-{n:05d}", f"r{n}", text) for n in range(1, certificates + 1)),
            )
        find = store.certificates.find
        middle = certificates // 2
        board = f"LPY-{middle:05d}"
        page = slowest_ms(lambda: find(), lambda: find(cursor=str(middle)), lambda: find(limit=200, cursor="300"))
        search = slowest_ms(lambda: find(q=board), lambda: find(q="nobody"))
        return [
            Row(f"Page of {certificates} certificates, anywhere", page, "ms", 50.0),
            Row("Certificates of one board", slowest_ms(lambda: find(board=board)), "ms", 50.0),
            Row("Search in any part of number, board, operator", search, "ms", 100.0),
        ]


def slowest_ms(*asks: Any) -> float:
    worst = 0.0
    for ask in asks:
        best = float("inf")
        for _ in range(5):
            start = time.perf_counter()
            ask()
            best = min(best, time.perf_counter() - start)
        worst = max(worst, best)
    return 1e3 * worst
