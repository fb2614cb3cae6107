"""The server's side of the worker: starts it, hands it commands, notices its death and starts the next."""

import itertools
import logging
import math
import multiprocessing
import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as TookTooLong
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any, Literal

from calib_core.problem import Problem
from server import worker
from server.live import ENDED, LiveRun, decode
from server.settings import Settings
from server.store import Store
from server.store_runs import INTERRUPTED

log = logging.getLogger("gyrobench")
KEPT_RUNS = 4  # live runs that a page may still want after their end
CONFIRMED_S = 2.0  # a stop takes milliseconds; a worker that has not confirmed it by then hangs
REPLY_S = 15.0
RESTART_S = 1.0


class Supervisor:
    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store
        self._send_lock = threading.Lock()
        self._claim = threading.Lock()
        self._pipe: Connection | None = None
        self._process: multiprocessing.process.BaseProcess | None = None
        self._replies: dict[int, Future[None]] = {}
        self._numbers = itertools.count(1)
        self._closing = threading.Event()
        self._ready = threading.Event()
        self._idle = threading.Event()
        self._idle.set()
        self._thread = threading.Thread(target=self._loop, name="supervisor", daemon=True)
        self._started = False
        self.url, self.speed = settings.rig, settings.speed
        self.rig: dict[str, Any] | None = None  # what the worker last said of its rig
        self.checking = False
        self.run: str | None = None
        self.live: dict[str, LiveRun] = {}

    @property
    def status(self) -> Literal["ready", "starting", "dead"]:
        if self._ready.is_set():
            return "ready"
        return "dead" if self._closing.is_set() else "starting"

    @property
    def pid(self) -> int | None:
        return self._process.pid if self._process else None

    def start(self) -> None:
        self._thread.start()
        self._started = True

    def close(self) -> None:
        """Ends the worker; it makes the motors safe first."""
        self._closing.set()
        self._send("quit")
        if self._started:
            self._thread.join(5.0)

    # --- commands ----------------------------------------------------------------------------------------------
    def begin(self, run: str, speed: float, head: Mapping[str, Any]) -> None:
        """Hands a stored, queued run to the worker. The caller is inside `free`."""
        live = LiveRun(run, {"message": None, "certificate": None})
        live.feed({**head, "speed": speed if math.isfinite(speed) else "max"})
        self.live = {**dict(list(self.live.items())[-KEPT_RUNS + 1 :]), run: live}
        self._idle.clear()
        self.run = run
        if not self._send("run", run, speed):
            self._interrupt(run)

    @contextmanager
    def free(self) -> Iterator[None]:
        """Held while a run is made or the rig changed, so that two requests cannot both find the rig free.

        Raises Problem while a run is on, or where no worker is there to take one.
        """
        with self._claim:
            run = self.run
            # A run whose end is stored is over; that its worker says so too takes a moment more.
            if run is not None and not (self._stored_end(run) and self._idle.wait(CONFIRMED_S)):
                raise Problem("run.busy", run=run)
            if self.checking:
                raise Problem("rig.checking")
            if not self._ready.wait(REPLY_S):
                raise Problem("worker.not_ready")
            yield

    def _stored_end(self, run: str) -> bool:
        return self._store.runs.get(run)["status"] in ENDED

    def open_rig(self, url: str, speed: float) -> None:
        """Changes the rig; raises Problem where the address names none, or where a part of it does not answer."""
        with self.free():
            try:
                self._ask("open", url)
            finally:
                if self.url == url:  # as the worker said before it replied
                    self.speed = speed

    def check_rig(self) -> None:
        with self.free():
            self._ask("check")

    def start_check(self, gyro_model: dict[str, Any]) -> None:
        """Begins the check of the rig's physics; what it finds comes with the rig's status."""
        with self.free():
            self.checking = True
            if not self._send("start_check", gyro_model):
                self.checking = False
                raise Problem("worker.not_ready")

    def stop(self) -> None:
        """Stops whatever moves and waits until the worker says that the motors are safe.

        Raises Problem where it does not say so; it is ended then, and the next one makes them safe before all else.
        """
        if not self._ready.is_set():
            return  # a worker that is starting moves nothing, and makes the motors safe first
        process = self._process
        try:
            self._ask("stop", seconds=CONFIRMED_S)
        except Problem as problem:
            if problem.code == "worker.no_answer" and process is not None:
                log.error("the worker does not answer the stop; ending it")
                process.kill()
            raise Problem("rig.stop_not_confirmed") from problem

    def stop_run(self, run: str) -> None:
        """Stops this run and waits a moment for its end to be stored. Raises Problem where it is not on."""
        if self.run != run or self._stored_end(run):
            raise Problem("run.not_running", run=run)
        self.stop()
        self._idle.wait(CONFIRMED_S)

    def _ask(self, command: str, *arguments: object, seconds: float = REPLY_S) -> None:
        """Sends a command and waits for its reply; raises the Problem that it answers with."""
        number, reply = next(self._numbers), Future[None]()
        self._replies[number] = reply
        try:
            if not self._send(command, number, *arguments):
                raise Problem("worker.not_ready")
            reply.result(seconds)
        except TookTooLong:
            raise Problem("worker.no_answer", seconds=seconds) from None
        finally:
            self._replies.pop(number, None)

    def _send(self, command: str, *arguments: object) -> bool:
        with self._send_lock:
            if self._pipe is None:
                return False
            try:
                self._pipe.send((command, *arguments))
            except OSError:
                return False
            return True

    # --- the worker's life -------------------------------------------------------------------------------------
    def _loop(self) -> None:
        context = multiprocessing.get_context("spawn")
        while not self._closing.is_set():
            born = time.monotonic()
            ours, theirs = context.Pipe()
            arguments = (theirs, str(self._store.data), self.url)
            process = context.Process(target=worker.main, args=arguments, name="gyrobench-worker", daemon=True)
            try:
                process.start()
                theirs.close()
                with self._send_lock:
                    self._pipe, self._process = ours, process
                self._listen(ours)
                self._gone(process)
            except OSError:
                log.exception("the worker could not be started")
            if not self._closing.is_set() and time.monotonic() - born < RESTART_S:
                self._closing.wait(RESTART_S)  # a worker that dies at once is not started in a tight circle

    def _listen(self, pipe: Connection) -> None:
        """Takes what the worker says until there is none."""
        while True:
            try:
                said = pipe.recv()
            except (EOFError, OSError):
                return
            try:
                self._received(*said)
            except Exception:
                log.exception("what the worker said could not be taken")

    def _gone(self, process: "multiprocessing.process.BaseProcess") -> None:
        self._ready.clear()
        with self._send_lock:
            pipe, self._pipe = self._pipe, None
        if pipe is not None:
            pipe.close()
        process.join(2.0)
        if process.is_alive():
            process.kill()
            process.join()
        self.rig, self.checking = None, False
        for reply in list(self._replies.values()):
            if not reply.done():
                reply.set_exception(Problem("worker.not_ready"))
        if self.run is not None:
            self._interrupt(self.run)

    def _interrupt(self, run: str) -> None:
        try:
            self._store.runs.finish(run, "interrupted", message=INTERRUPTED)
        except Problem:
            log.exception("run %s cannot be marked as interrupted; the next start does it", run)
        self._ended(run, {"status": "interrupted", "message": INTERRUPTED})

    def _ended(self, run: str, last: Mapping[str, Any]) -> None:
        if self.run == run:
            self.run = None
            self._idle.set()
        if run in self.live:
            self.live[run].feed(last)

    def _received(self, kind: str, *content: Any) -> None:
        match kind, content:
            case "frame", (str(run), bytes(data)):
                if run in self.live:
                    self.live[run].feed(*decode(data))
            case "rig", (dict(status),):
                self.rig, self.url, self.checking = status, status["url"], status["checking"]
                self._ready.set()
            case "reply", (int(number), refusal):
                reply = self._replies.get(number)
                if reply is not None and not reply.done():
                    if refusal is None:
                        reply.set_result(None)
                    else:
                        reply.set_exception(refusal)
            case "ended", (str(run), dict(last)):
                self._ended(run, last)
            case _:
                log.error("the worker said %s, which nobody understands", kind)
