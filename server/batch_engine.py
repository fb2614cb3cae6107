"""The process that certifies batches: takes what waits in the store, has it done, and is the one that writes results.

It starts with the first batch and ends when nothing has waited for a while. Whatever ends it, a file is either done
in the store or waits there, so the next one goes on where this one was.
"""

import asyncio
import json
import logging
import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from calib_core.problem import Problem
from server import batch_work
from server.batch_cluster import AHEAD, Cluster
from server.store import Store
from server.store_db import Row

log = logging.getLogger("gyrobench")
IDLE_S = 120.0
"""Workers that nobody needs hold some 200 MB each."""
AGAIN_S = 5.0
"""After which a cluster or a disk that failed is asked again."""
KEPT_DAYS = 30
GATHER_S = 0.1
MOST_AT_ONCE = 32
"""Results that go to disk together: one wait for the disk instead of one each."""
Found = Mapping[str, Any]
GONE: Found = {"error": {"code": "batch.file_gone", "values": {}}}


def main(data: Path, news: Connection) -> None:
    """The process: any word on ``news`` says that there may be work, its end that the server is gone or wants it so."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C is the server's; it ends this process in order
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    with Store(data) as store:
        asyncio.run(Engine(store).serve(news))


def folder_of(data: Path, batch: str) -> Path:
    return data / "batches" / batch


def file_of(data: Path, batch: str, position: int) -> Path:
    return folder_of(data, batch) / f"{position:06d}"


def forget(store: Store) -> None:
    """Removes uploads that nobody tried again for KEPT_DAYS, and what a server that was killed had half received."""
    oldest = time.time() - 86400 * KEPT_DAYS
    for folder in (store.data / "batches").glob("*"):
        if folder.stat().st_mtime < oldest and not store.batches.is_open(folder.name):
            shutil.rmtree(folder, ignore_errors=True)


class Engine:
    def __init__(self, store: Store) -> None:
        self._store = store
        self._results: asyncio.Queue[tuple[Row, Found]] = asyncio.Queue()
        self._news = asyncio.Event()
        self._over = False
        self._taken: set[int] = set()  # files on their way to a result in the store

    async def serve(self, news: Connection) -> None:
        """Until there has been nothing to do for IDLE_S, or ``news`` ends."""
        loop = asyncio.get_running_loop()
        threading.Thread(target=self._listen, args=(news, loop), name="news", daemon=True).start()
        writing = asyncio.create_task(self._write())
        self._store.batches.wait_again()
        await asyncio.to_thread(forget, self._store)
        try:
            while not self._over:
                waiting = self._store.batches.count_waiting()
                if not waiting:
                    return
                try:
                    async with Cluster.open(files=waiting) as cluster:
                        self._store.batches.tell(None)
                        await self._feed(cluster)
                        return
                except Problem as problem:
                    log.error("no batch goes on: %s", problem)
                    self._store.batches.tell({"code": problem.code, "values": problem.values})
                    await self._wait(AGAIN_S)
        finally:
            writing.cancel()

    async def _feed(self, cluster: Cluster) -> None:
        """Hands out files, as many as there are places, until there has been nothing to do for IDLE_S.

        Raises Problem where the cluster is lost; what was on its way waits again.
        """
        active: set[asyncio.Task[None]] = set()
        try:
            while not self._over:
                self._news.clear()
                cluster.grow(self._store.batches.count_waiting())
                for row in self._waiting(cluster.places + AHEAD - len(active)):
                    active.add(asyncio.create_task(self._certify(cluster, row)))
                if active:
                    news = asyncio.create_task(self._news.wait())
                    done, _ = await asyncio.wait({*active, news}, return_when=asyncio.FIRST_COMPLETED)
                    news.cancel()
                    for task in done & active:
                        task.result()
                    active -= done
                elif not await self._wait(IDLE_S) and not self._store.batches.count_waiting():
                    return
        finally:
            for task in active:
                task.cancel()
            await asyncio.gather(*active, return_exceptions=True)

    def _waiting(self, room: int) -> list[Row]:
        """The next files, at most ``room``, which are ours from now on."""
        if room <= 0:
            return []
        waiting = self._store.batches.waiting(len(self._taken) + room)
        rows = [row for row in waiting if row["id"] not in self._taken][:room]
        for batch in {row["batch"] for row in rows}:
            self._store.batches.begin(batch)
        self._taken |= {row["id"] for row in rows}
        return rows

    async def _certify(self, cluster: Cluster, row: Row) -> None:
        file = file_of(self._store.data, row["batch"], row["position"])
        try:
            source = str(file) if cluster.is_local else await asyncio.to_thread(file.read_bytes)
            settings = [row[name] and json.loads(row[name]) for name in ("gyro_model", "spec")]
            found: Found = await cluster.run(batch_work.certify_here, source, row["name"], *settings)
            if found.get("error", {}).get("code") == "file":
                found = GONE  # a path on this computer is nobody's business
        except OSError:
            found = GONE
        except BaseException as error:
            if not isinstance(error, Problem) or error.code != "batch.worker_died":
                self._taken.discard(row["id"])
                raise
            found = {"error": {"code": error.code, "values": error.values}}
        await self._results.put((row, found))

    # --- writing ---------------------------------------------------------------------------------------------------
    async def _write(self) -> None:
        while True:
            ready = [await self._results.get()]
            await asyncio.sleep(GATHER_S)
            while not self._results.empty() and len(ready) < MOST_AT_ONCE:
                ready.append(self._results.get_nowait())
            while True:
                try:
                    await asyncio.to_thread(self._keep, ready)
                    self._taken -= {row["id"] for row, _ in ready}
                    break
                except Problem as problem:  # a full disk, a store that another program holds
                    log.error("results wait: %s", problem)
                    with suppress(Problem):
                        self._store.batches.tell({"code": problem.code, "values": problem.values})
                    await asyncio.sleep(AGAIN_S)

    def _keep(self, ready: list[tuple[Row, Found]]) -> None:
        """All of these in one transaction. What was cancelled meanwhile is dropped."""
        done = []
        with self._store.connection.write(durable=True):
            for row, found in ready:
                if not self._store.batches.is_waiting(row["id"]):
                    continue
                if "error" in found:
                    self._store.batches.end(row["id"], "failed", verdict="error", error=found["error"])
                    continue
                issued = batch_work.keep(self._store, found, row["name"])
                self._store.batches.end(
                    row["id"], "done", board=issued["board"], certificate=issued["number"], verdict=issued["verdict"],
                    axes=issued["axes"], warnings=issued["warnings"], error=None, cpu_s=found["cpu_s"],
                )  # fmt: skip
                done.append(row)
        for row in done:  # its samples are in the store
            file_of(self._store.data, row["batch"], row["position"]).unlink(missing_ok=True)

    # --- news ------------------------------------------------------------------------------------------------------
    async def _wait(self, seconds: float) -> bool:
        """Whether there was news within so many seconds."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._news.wait(), seconds)
        return self._news.is_set()

    def _listen(self, news: Connection, loop: asyncio.AbstractEventLoop) -> None:
        with suppress(EOFError, OSError, RuntimeError):
            while True:
                news.recv()
                loop.call_soon_threadsafe(self._news.set)
        self._over = True
        with suppress(RuntimeError):
            loop.call_soon_threadsafe(self._news.set)


def _end_with_parent() -> None:
    """A server that is killed cannot say so."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
