"""The one process that owns the rig: what is measured goes to the store first, then to whoever watches.

Commands come in through a pipe, read by a thread that does nothing else, so that a stop reaches the motors while the
main thread is busy. The process ends when the pipe does, and leaves the motors safe.
"""

import logging
import os
import queue
import signal
import threading
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from calib_core.problem import Problem

if TYPE_CHECKING:
    from server.devices.rig import Rig
    from server.live import LiveRun

log = logging.getLogger("gyrobench.worker")
IDLE_S = 2.0  # between looks at a rig with nothing to do
LEAST_GAP_S = 0.045  # the engine's blocks are 50 ms apart: each makes a frame, twenty a second


def main(pipe: Connection, data: str, url: str) -> None:
    """The process. Heavy imports are inside, because the server imports this module too."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the small matrices here are slower with two threads
    # Ctrl+C reaches every process of the terminal; ours ends when the server says so, in order.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Worker(pipe, data, url).serve()


def _warm_up() -> None:
    """Half a second of imports that the end of the first state need not wait for."""
    import filterpy.kalman  # noqa: F401

    from server import conduct  # noqa: F401


class Worker:
    def __init__(self, pipe: Connection, data: str, url: str) -> None:
        from server.store import Store

        self._pipe = pipe
        self._store = Store(data)
        self._url = url
        self._rig: Rig | None = None
        self._refused: Problem | None = None  # why there is none
        self._checks: list[dict[str, Any]] = []
        self._checking = False
        self._commands: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
        self._abort = threading.Event()
        self._orphaned = False  # the server is gone without a word
        self._telling = threading.Lock()

    def serve(self) -> None:
        """Makes the motors safe, says what answers, then does what it is told until it is told to quit."""
        threading.Thread(target=self._listen, name="listener", daemon=True).start()
        with suppress(Problem):
            self._open(self._url)
        self._tell("rig", self._status())
        threading.Thread(target=_warm_up, name="warm-up", daemon=True).start()
        try:
            shown = None
            while True:
                try:
                    command = self._commands.get(timeout=IDLE_S)
                except queue.Empty:
                    # Whoever looks at the rig's page sees a cable that comes off, and how warm the servos are.
                    if (status := self._status()) != shown:
                        self._tell("rig", shown := status)
                    continue
                match command:
                    case ("quit",):
                        return
                    case ("run", str(run), float(speed)):
                        self._run(run, speed)
                    case ("start_check", dict(model)):
                        self._check_start(model)
                    case ("open", int(number), str(url)):
                        self._answer(number, url)
                    case ("check", int(number)):
                        self._answer(number, self._url)
        finally:
            self._close()
            self._store.close()

    # --- the listening thread ----------------------------------------------------------------------------------
    def _listen(self) -> None:
        while True:
            try:
                command = self._pipe.recv()
            except (EOFError, OSError):
                self._orphaned = True
                command = ("quit",)
            match command:
                case ("stop", int(number)):
                    self._tell("reply", number, self._stop())
                    continue
                case ("quit",):
                    self._stop()
                case ("run" | "start_check", *_):
                    self._abort.clear()  # here, in the order of the pipe: a stop sent after this run must find it
            self._commands.put(command)
            if command == ("quit",):
                return

    def _stop(self) -> Problem | None:
        """Ends what runs and makes the motors safe at once, whatever the working thread is doing."""
        self._abort.set()
        rig = self._rig
        try:
            if rig is not None:
                rig.safe()
        except Exception:
            log.exception("the rig could not be made safe")
            return Problem("rig.stop_not_confirmed")
        return None

    # --- the working thread ------------------------------------------------------------------------------------
    def _open(self, url: str) -> None:
        """Connects the rig at an address, motors safe first.

        Raises Problem: for an address that names no rig, and the old one stays; for a part that does not answer, and
        the new one shows which.
        """
        from server.devices import open_rig

        try:
            rig = open_rig(url)
        except Problem as problem:
            self._refused = problem
            raise
        self._close()
        self._rig, self._url, self._checks = rig, url, []
        rig.open()
        rig.safe()

    def _opened(self) -> "Rig":
        if self._rig is None:
            self._open(self._url)
        assert self._rig is not None
        return self._rig

    def _close(self) -> None:
        rig, self._rig = self._rig, None
        if rig is not None:
            with suppress(Problem):
                rig.close()

    def _status(self) -> dict[str, Any]:
        rig, checks = self._rig, {"checks": list(self._checks), "checking": self._checking}
        if rig is None:
            why = self._refused
            parts = [{"part": "rig", "ok": False, "code": why.code, "values": why.values}] if why else []
            return {"url": self._url, "connected": False, "parts": parts, "axes": {}, **checks}
        axes = {name: {**vars(axis)} for name, axis in rig.axes.items()}
        return {"url": self._url, "connected": rig.connected, "parts": rig.status(), "axes": axes, **checks}

    def _check_start(self, model: dict[str, Any]) -> None:
        """Checks the rig's physics and tells each check as it comes; the table moves."""
        from calib_core.gyro_models import GyroModel
        from server.devices import start_checks
        from server.devices.check import Check

        def found(check: Check) -> None:
            self._checks.append({"part": check.name, **{k: v for k, v in vars(check).items() if k != "name"}})
            self._tell("rig", self._status())

        self._checks, self._checking = [], True
        self._tell("rig", self._status())
        try:
            for check in start_checks.run(self._opened(), GyroModel.from_json(model), abort=self._abort):
                found(check)
        except Problem as problem:
            found(Check("rig", False, problem.code, dict(problem.values)))
        except Exception as error:
            log.exception("the start-up check")
            found(Check("rig", False, "server.fault", {"kind": type(error).__name__}))
        finally:
            self._checking = False
            self._tell("rig", self._status())

    def _run(self, run: str, speed: float) -> None:
        from server.conduct import conduct
        from server.live import LiveRun

        live = LiveRun(run, {"status": "running"})
        news, done = threading.Event(), threading.Event()
        live.watch(news.set)
        sender = threading.Thread(target=self._send_frames, args=(live, news, done), name="frames")
        sender.start()
        try:
            last = conduct(
                self._store, run, self._opened, speed=speed, abort=self._abort, live=live, lost=lambda: self._orphaned
            )
        finally:
            done.set()
            news.set()
            sender.join()
        self._tell("rig", self._status())
        self._tell("ended", run, last)

    def _send_frames(self, live: "LiveRun", news: threading.Event, done: threading.Event) -> None:
        """Sends what is new, some twenty times a second; a server that is slow to read does not delay the run."""
        cursor: int | None = None
        while True:
            news.wait()
            news.clear()
            last = done.is_set()
            new = live.since(cursor)
            if new is not None:
                message, cursor = new
                self._tell("frame", live.run, message)
            if last:
                return
            done.wait(LEAST_GAP_S)

    def _answer(self, number: int, url: str) -> None:
        try:
            self._open(url)
            refusal = None
        except Problem as problem:
            refusal = problem
        self._tell("rig", self._status())
        self._tell("reply", number, refusal)

    def _tell(self, kind: str, *content: object) -> None:
        with self._telling, suppress(OSError):  # without a server there is nobody to tell; the run goes on
            self._pipe.send((kind, *content))
