"""The machines that certify: Dask's worker processes on this computer, or those of GYROBENCH_CLUSTER=tcp://host:port.

Dask runs a task once and gives up where its worker dies; what else was on that worker is as suspect as the task that
did it. So each of them is run again with nothing beside it: the innocent cost time only, and the one that kills its
worker twice is reported.
"""

import asyncio
import logging
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Any, TypeVar

from calib_core.problem import Problem
from server import __version__, batch_work

T = TypeVar("T")
ADDRESS = "GYROBENCH_CLUSTER"
WORKERS = "GYROBENCH_WORKERS"
WORKER_BYTES = 600_000_000
"""What a worker may need for an ordinary session, twice over; there are as many as cores and memory allow."""
CONNECT_S = 15.0
NOBODY_S = 60.0
"""A cluster without any worker for so long is no cluster."""
AHEAD = 2
"""Files a worker has: one at work, one waiting there so that it need not wait for us."""


class Cluster:
    """Use as ``async with Cluster.open()``; many tasks may `run` at once."""

    def __init__(self, client: Any, local: Any = None, most: int = 0) -> None:
        self._client = client
        self._local, self._most = local, most
        self._running = 0
        self._suspects = 0
        self._changed = asyncio.Condition()

    @classmethod
    @asynccontextmanager
    async def open(cls, workers: int | None = None, *, files: int = 1) -> AsyncIterator["Cluster"]:
        """Connects, or starts ``workers`` processes (None: as many as fit), and no more than there are ``files``.

        Raises Problem batch.cluster_gone, or batch.cluster_other where the workers are of another version.
        """
        import dask
        import distributed

        made: Any = distributed  # untyped in parts

        for name in ("distributed", "distributed.nanny", "distributed.scheduler", "distributed.worker"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # a file's end is told to its owner, not to a log
        address = os.environ.get(ADDRESS, "")
        with dask.config.set(
            {
                "distributed.scheduler.allowed-failures": 0,
                "distributed.admin.large-graph-warning-threshold": "1GB",  # files travel with their tasks
                "distributed.comm.timeouts.connect": CONNECT_S,
                # A worker that dies again while it is being started again would be given up for ever.
                "distributed.deploy.lost-worker-timeout": "365 days",
                "distributed.scheduler.http.routes": [],
                "distributed.worker.http.routes": [],
            }
        ):
            if address:
                try:
                    client = await made.Client(address, asynchronous=True, timeout=CONNECT_S)
                except (OSError, ValueError, TimeoutError) as error:
                    raise Problem("batch.cluster_gone", address=address, reason=str(error)[:200]) from None
                async with client:
                    cluster = cls(client)
                    await cluster._check(address)
                    yield cluster
            else:
                most = workers or usual_workers()
                async with (
                    made.LocalCluster(
                        n_workers=min(most, files),
                        threads_per_worker=1,
                        host="127.0.0.1",
                        dashboard_address="127.0.0.1:0",
                        scheduler_kwargs={"dashboard": False},
                        preload=["server.batch_work"],
                        security=True,  # a key for this once: other users of this computer could run tasks as us
                        asynchronous=True,
                        silence_logs=logging.CRITICAL,
                    ) as local,
                    made.Client(local, asynchronous=True) as client,
                ):
                    yield cls(client, local, most)

    async def _check(self, address: str) -> None:
        try:
            versions = await asyncio.wait_for(self._client.run(batch_work.version, on_error="return"), 4 * CONNECT_S)
        except (OSError, TimeoutError) as error:
            raise Problem("batch.cluster_gone", address=address, reason=str(error)[:200]) from None
        for worker, version in versions.items():
            if version != __version__:
                raise Problem("batch.cluster_other", worker=worker, version=str(version)[:80], ours=__version__)

    @property
    def is_local(self) -> bool:
        """Whether workers see this computer's files."""
        return self._local is not None

    def grow(self, files: int) -> None:
        """More processes, where ``files`` have come since it was opened and there may be more."""
        if self._local is not None and len(self._local.worker_spec) < min(self._most, files):
            self._local.scale(min(self._most, files))

    @property
    def places(self) -> int:
        """Files that may be on their way at once."""
        return AHEAD * max(1, self._threads)

    @property
    def _threads(self) -> int:
        return int(self._client.scheduler_info().get("total_threads", 0))

    async def run(self, work: Callable[..., T], *arguments: object) -> T:
        """What ``work`` gives, on some worker, as soon as there is a place.

        Raises Problem batch.worker_died where it ended its worker twice, and batch.cluster_gone.
        """
        from distributed import KilledWorker

        try:
            async with self._place():
                return await self._submit(work, *arguments)
        except KilledWorker:
            pass
        async with self._alone():
            try:
                return await self._submit(work, *arguments)
            except KilledWorker:
                raise Problem("batch.worker_died") from None

    async def _submit(self, work: Callable[..., T], *arguments: object) -> T:
        from distributed import CancelledError

        future = self._client.submit(work, *arguments, pure=False)
        result = asyncio.ensure_future(future)
        try:
            while not (await asyncio.wait({result}, timeout=NOBODY_S))[0]:
                if not self._threads:
                    raise OSError("no worker")
            found: T = result.result()
            return found
        except (CancelledError, OSError) as error:
            raise Problem("batch.cluster_gone", address=self._client.scheduler.address, reason=str(error)) from None
        finally:
            result.cancel()
            with suppress(Exception):
                future.release()

    @asynccontextmanager
    async def _place(self) -> AsyncIterator[None]:
        async with self._changed:
            await self._changed.wait_for(lambda: not self._suspects and self._running < self.places)
            self._running += 1
        try:
            yield
        finally:
            async with self._changed:
                self._running -= 1
                self._changed.notify_all()

    @asynccontextmanager
    async def _alone(self) -> AsyncIterator[None]:
        async with self._changed:
            self._suspects += 1
            try:
                await self._changed.wait_for(lambda: not self._running)
                self._running += 1
            except BaseException:
                self._suspects -= 1
                raise
        try:
            yield
        finally:
            async with self._changed:
                self._running -= 1
                self._suspects -= 1
                self._changed.notify_all()


def usual_workers() -> int:
    """GYROBENCH_WORKERS, else one a core, as long as there is memory for each."""
    import psutil

    with suppress(ValueError):
        return max(1, int(os.environ.get(WORKERS, "")))
    cores = len(psutil.Process().cpu_affinity()) if hasattr(psutil.Process, "cpu_affinity") else os.cpu_count() or 1
    return max(1, min(cores, int(psutil.virtual_memory().total // WORKER_BYTES)))
