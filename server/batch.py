"""The server's side of batches: their process, started with the first batch and again as long as something waits."""

import logging
import multiprocessing
import threading
import time
from multiprocessing.connection import Connection

from server.store import Store

log = logging.getLogger("gyrobench")
CLOSE_S = 3.0
RESTART_S = 2.0


class BatchProcess:
    """Nothing runs until `wake`. One thread looks after the process; the store is what both sides share."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._news = threading.Event()
        self._closing = False
        self._lock = threading.Lock()
        self._pipe: Connection | None = None
        self._process: multiprocessing.process.BaseProcess | None = None
        self._thread: threading.Thread | None = None

    @property
    def pid(self) -> int | None:
        return self._process.pid if self._process is not None else None

    def resume(self) -> None:
        """Goes on with what waited when the last server ended."""
        if self._store.batches.count_waiting():
            self.wake()

    def wake(self) -> None:
        """There is something new: files that wait, or some that do not any more."""
        self._news.set()
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._loop, name="batches", daemon=True)
                self._thread.start()
            if self._pipe is not None:
                try:
                    self._pipe.send("news")
                except OSError:
                    log.debug("the batch process has just ended; the next one looks by itself")

    def stop(self) -> None:
        """Tells the process to end. Files that it was at wait for the next server."""
        self._closing = True
        self._news.set()
        with self._lock:
            if self._pipe is not None:
                self._pipe.close()
                self._pipe = None

    def close(self) -> None:
        """Ends it, by force where it takes too long."""
        self.stop()
        if self._thread is not None:
            self._thread.join(2 * CLOSE_S)

    def _loop(self) -> None:
        from server import batch_engine

        context = multiprocessing.get_context("spawn")
        while not self._closing:
            self._news.wait()
            self._news.clear()
            while not self._closing and self._store.batches.count_waiting():
                born = time.monotonic()
                ours, theirs = context.Pipe()
                # Not a daemon: those may not have workers of their own. It ends with this process by itself.
                process = context.Process(
                    target=batch_engine.main, args=(self._store.data, theirs), name="gyrobench-batch", daemon=False
                )
                process.start()
                theirs.close()
                with self._lock:
                    self._pipe, self._process = ours, process
                self._until_end(process)
                with self._lock:
                    self._pipe = None
                if not self._closing and time.monotonic() - born < RESTART_S:
                    time.sleep(RESTART_S)  # one that dies at once is not started in a tight circle

    def _until_end(self, process: "multiprocessing.process.BaseProcess") -> None:
        while process.is_alive() and not self._closing:
            process.join(1.0)
        process.join(CLOSE_S)
        if process.is_alive():
            process.kill()
            process.join()
