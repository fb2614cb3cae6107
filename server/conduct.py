"""One run from its first document to its certificate: store first, then viewers.

Every sample is in the store before anything else sees it; what a state gives is computed from what was stored.
A fault of the rig, of an analysis or of the disk ends the run with its sentence and the motors safe.
"""

import json
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from typing import Any

import numpy as np

from calib_core import session
from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.reference import HEADER
from calib_core.sequence import Plan
from server import __version__, engine
from server.devices.rig import Rig
from server.live import LiveRun
from server.live_analysis import LiveAnalyser
from server.store import Store
from server.store_db import now
from server.store_runs import INTERRUPTED

log = logging.getLogger("gyrobench.run")
PAUSE_S = 1.0  # between the kept states' last sample and the first of a run that continues them


def conduct(
    store: Store,
    run: str,
    rig: Callable[[], Rig],
    *,
    speed: float,
    abort: threading.Event,
    live: LiveRun | None = None,
    lost: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Runs a queued run to its end; gives {"status", "message": {"code", "values"} | None, "certificate", "states"}.

    ``rig`` gives the rig, opened or not; ``lost`` says whether nobody asked for a stop, but whoever started the run
    is gone. Does not raise what ends a run: that is its message.
    """
    last: dict[str, Any] = {"status": "failed", "message": None, "certificate": None}
    try:
        last = _Conductor(store, run, rig(), speed, abort, live).conduct()
        if last["status"] == "stopped" and lost():
            last |= {"status": "interrupted", "message": INTERRUPTED}
    except Problem as problem:
        last["message"] = _message(problem)
    except Exception as error:
        log.exception("run %s", run)
        last["message"] = _message(Problem("server.fault", kind=type(error).__name__))
    try:
        store.runs.finish(run, last["status"], message=last["message"], certificate=last["certificate"])
    except Problem:
        # A full disk may refuse even this line; the next start of the server finds the run open and marks it.
        log.exception("run %s: its end could not be stored", run)
    return {**last, "states": _states(store, run)}


def _message(problem: Problem) -> dict[str, Any]:
    return {"code": problem.code, "values": json.loads(json.dumps(problem.values, default=str))}


def _states(store: Store, run: str) -> list[dict[str, str]]:
    states: list[dict[str, str]] = store.runs.get(run)["states"]
    return states


class _Conductor:
    def __init__(
        self, store: Store, run: str, rig: Rig, speed: float, abort: threading.Event, live: LiveRun | None
    ) -> None:
        self.store, self.run, self.rig, self.speed, self.abort, self.live = store, run, rig, speed, abort, live
        row = store.runs.get(run)
        self.request = row["request"]
        self.recording = row["recording"]
        self.plan = Plan.from_json(row["plan"])
        self.results: dict[str, Any] = row["results"]
        self.order = [entry["name"] for entry in row["states"]]
        end_s = store.recordings.end_s(self.recording)
        self.offset_s = 0.0 if end_s is None else round(end_s + PAUSE_S, 6)
        self.analyser = LiveAnalyser(self.plan, self._parameters()) if live is not None else None
        self.began = time.monotonic()

    def conduct(self) -> dict[str, Any]:
        self.store.runs.start(self.run)
        self._show(status="running", states=_states(self.store, self.run))
        documents = engine.run(
            self.plan,
            self.rig,
            run_id=self.run,
            board=self.request["board"],
            header=self._header(),
            abort=self.abort,
            pace=engine.Pacer(self.speed),
        )
        try:
            with closing(documents):  # the rig is safe after it, whatever happens inside
                for document in documents:
                    match document:
                        case engine.Descriptor():
                            self.store.recordings.set_header(self.recording, document.header)
                        case engine.StateBegin():
                            self._begin(document.state)
                        case engine.Rows():
                            self._rows(document)
                        case engine.StateEnd():
                            self._analyse(document.state)
                        case engine.Stop():
                            return self._end(document)
        except Exception:
            with suppress(Problem):
                self._seal()
            raise
        raise AssertionError("a run ends with a stop")

    def _header(self) -> dict[str, str]:
        """The recording's identity: all that its certificate says of it is read from here."""
        request = self.request
        temperature = request.get("conditions", {}).get("room_temperature_degC")
        calibration = self.store.rig_records.get(self.rig.url)
        facts = {
            HEADER: "" if calibration is None else json.dumps(calibration.to_json(), ensure_ascii=False),
            "run": self.run,
            "operator": request.get("operator", ""),
            "note": " ".join(request.get("note", "").split()),
            "room_temperature_degC": "" if temperature is None else f"{temperature:g}",
            "gyro_model": json.dumps(self.plan.gyro_model.to_json(), ensure_ascii=False),
            "ranges": json.dumps(self.plan.to_json()["ranges"]),
            "states": ",".join(self.order),
            "software": f"gyrobench {__version__}",
            "started_at": now(),
        }
        return {name: value for name, value in facts.items() if value}

    def _begin(self, state: str) -> None:
        self.store.runs.set_state(self.run, state, "running")
        if self.analyser is not None:
            self.analyser.begin(next(entry for entry in self.plan.states if entry.name == state))
        self._show(state=state, state_index=self.order.index(state), states=_states(self.store, self.run))

    def _rows(self, document: engine.Rows) -> None:
        rows = self._recording(document.columns, document.segment)
        with self.store.connection.write():
            self.store.recordings.append(self.recording, rows, state=document.state)
            if document.fast is not None:
                fast = self._recording(document.fast, document.segment)
                self.store.recordings.append(self.recording, fast, state=document.state, kind="fast")
        if self.live is None or self.analyser is None:
            return
        try:
            arrays, points = self.analyser.rows(rows)
            progress = document.progress
            self.live.feed(
                {
                    "step": document.segment,
                    "progress": {**vars(progress), "seconds_left": self._seconds_left(progress)},
                    "bench_time_s": float(rows.time_s[-1]),
                    "points": points,
                },
                arrays,
            )
        except Exception:
            log.exception("run %s: the live view failed; the run goes on", self.run)
            self.analyser = None

    def _recording(self, columns: Mapping[str, Any], segment: str) -> Recording:
        shifted = dict(columns)
        if self.offset_s:
            for name in shifted:
                if name.endswith("time_s"):
                    shifted[name] = np.round(shifted[name] + self.offset_s, 6)
        time_s = shifted.pop("time_s")
        return Recording(time_s, shifted, np.zeros(len(time_s), np.int32), (segment,))

    def _seconds_left(self, progress: engine.Progress) -> float:
        """By the clock on the wall; at full speed from how fast it has gone so far."""
        if math.isfinite(self.speed):
            return progress.seconds_left / self.speed
        elapsed = time.monotonic() - self.began
        return elapsed * (1.0 - progress.run_fraction) / max(progress.run_fraction, 1e-3)

    def _analyse(self, state: str) -> None:
        self.store.recordings.compact(self.recording, state)
        points = self.analyser.stroke_ended() if self.analyser is not None else []
        if self.plan.experiment is not None:  # judged with the data that asked for it, by server/experiments.py
            self.store.runs.set_state(self.run, state, "done")
            self._show(states=_states(self.store, self.run))
            return
        result = session.analyse_state(
            self.store.recordings.load(self.recording, state=state),
            state,
            profile=self.plan.profile,
            gyro_model=self.plan.gyro_model,
            estimates=session.estimates_of(self.results),
        )
        self.results[state] = result
        with self.store.connection.write():
            self.store.runs.set_result(self.run, state, result)
            self.store.runs.set_state(self.run, state, "done")
        if self.analyser is not None:
            self.analyser.parameters |= self._parameters()
        self._show(points=points, results={state: result}, states=_states(self.store, self.run))

    def _parameters(self) -> dict[str, tuple[float, float]]:
        known = session.estimates_of(self.results)
        return {axis: (found.bias_V, found.scale_factor_V_per_dps) for axis, found in known.items()}

    def _end(self, stop: engine.Stop) -> dict[str, Any]:
        self._seal()
        if stop.status != "finished":
            # A stop takes the devices away from under a read; what that read says is no fault of theirs.
            stopped = self.abort.is_set() or stop.status == "stopped"
            message = _message(Problem("run.stopped") if stopped else Problem(stop.code, **stop.values))
            return {"status": "stopped" if stopped else stop.status, "message": message, "certificate": None}
        if self.plan.experiment is not None:
            return {"status": "finished", "message": None, "certificate": None}
        from server.certify import certify

        content = certify(self.store, self.recording, spec=self.request.get("spec"))
        with self.store.connection.write():
            for state, result in content["states"].items():
                self.store.runs.set_result(self.run, state, result)
        self._show(results=content["states"])
        return {"status": "finished", "message": None, "certificate": content["number"]}

    def _seal(self) -> None:
        """Whatever was measured is whole and has its digest, however the run ended."""
        states = self.store.recordings.states(self.recording)
        if not states:
            return
        for state in states:
            self.store.recordings.compact(self.recording, state)
        self.store.recordings.set_header(self.recording, {"finished_at": now(), **self.rig.clock_facts})
        self.store.recordings.seal(self.recording, self.store.recording(self.recording))

    def _show(self, **message: Any) -> None:
        if self.live is not None:
            self.live.feed(message)
