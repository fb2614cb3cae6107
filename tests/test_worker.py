"""The worker: samples are kept whatever happens, a stop is quick, and the motors are safe afterwards."""

import math
import os
import signal
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import psutil
import pytest
from running import Server
from websockets.sync.client import connect

from server.conduct import conduct
from server.devices import open_rig
from server.devices.rig import Rig
from server.live import LiveRun, decode
from server.run_plan import create, plan_of
from server.store import Store
from server.store_db import FILE

ABSENT = "dynamixel:/dev/none?ids=1,2&baud=1000000+nidaq:Dev1?channels=ai0,ai1"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    running = Server(tmp_path_factory.mktemp("worker"), "--speed", "20")
    yield running.worker_ready()
    running.close()


def worker_pid(server: Server) -> int:
    pid: int = server.client.get("/health").json()["worker_pid"]
    return pid


def measuring(server: Server, run: str, state: str = "") -> None:
    """Waits until samples of the run (of a state) have been shown."""
    with connect(f"{server.address.replace('http', 'ws')}/api/v1/runs/{run}/live", max_size=None) as socket:
        for data in socket:
            assert isinstance(data, bytes)
            message, arrays = decode(data)
            if arrays and message.get("state", "").startswith(state) and message["progress"]["state_fraction"] > 0:
                return
    raise AssertionError(f"run {run} ended before {state}")


def samples(server: Server, run: dict[str, Any]) -> int:
    file = server.client.get(f"/recordings/{run['recording']}.csv").text
    return sum(not line.startswith("#") for line in file.splitlines()) - 1


# --- stop ------------------------------------------------------------------------------------------------------
def test_stop_works_at_once_in_every_kind_of_state(server: Server) -> None:
    """Within 0.3 s; a machine that is busy with other tests may be late once."""
    took = []
    for state in ("estimate_x", "rate_x", "position_z"):
        run = server.run(speed=200, states=sorted({f"estimate_{state[-1]}", state}))
        measuring(server, run["id"], state)
        began = time.monotonic()
        assert server.client.post("/rig/stop").status_code == 204
        took.append(time.monotonic() - began)
        ended = server.ended(run["id"])
        assert (ended["status"], ended["message"]["code"]) == ("stopped", "run.stopped")
        assert ended["certificate"] is None
        assert samples(server, ended) == server.client.get(f"/recordings/{run['recording']}").json()["samples"]
    assert sorted(took)[1] < 0.3


def test_a_second_run_is_refused_with_a_sentence_while_one_is_on(server: Server) -> None:
    first = server.run(speed=20)
    refused = server.client.post("/runs", json={"board": "LPY-2"})
    assert (refused.status_code, refused.json()["code"]) == (409, "run.busy")
    assert first["id"] in refused.json()["detail"]
    assert server.client.put("/rig", json={"url": "twin:"}).status_code == 409
    stopped = server.client.post(f"/runs/{first['id']}/stop").json()
    assert stopped["status"] == "stopped"
    assert server.client.post(f"/runs/{first['id']}/stop").json()["code"] == "run.not_running"
    assert server.client.get("/boards/LPY-2").status_code == 404, "a refused run left its board behind"


# --- death -----------------------------------------------------------------------------------------------------
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no kill -9 on this system")
def test_a_killed_worker_loses_no_stored_sample_and_the_next_one_starts(server: Server) -> None:
    run = server.run(speed=200, states=["estimate_x", "rate_x", "estimate_z"])
    measuring(server, run["id"], "rate_x")
    pid = worker_pid(server)
    os.kill(pid, signal.SIGKILL)
    ended = server.ended(run["id"])
    assert (ended["status"], ended["message"]["code"]) == ("interrupted", "run.interrupted")
    assert "run.interrupted" not in ended["message"]["sentence"]
    assert ended["results"].keys() == {"estimate_x"}
    kept = samples(server, ended)
    assert kept > 100 * 100, "the whole estimate state, at least"

    server.worker_ready()
    assert worker_pid(server) != pid
    again = server.ended(server.run(speed="max", continues=run["id"], states=["rate_x", "estimate_z"])["id"])
    assert again["status"] == "finished", again["message"]
    assert [state["status"] for state in again["states"]] == ["kept", "done", "done"]


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="a process cannot be frozen on this system")
def test_a_worker_that_hangs_is_ended_by_the_stop_and_the_operator_is_told(server: Server) -> None:
    run = server.run(speed=20)
    measuring(server, run["id"])
    worker = psutil.Process(worker_pid(server))
    worker.send_signal(signal.SIGSTOP)
    while worker.status() != psutil.STATUS_STOPPED:  # its threads go on until the kernel has stopped each
        os.sched_yield()
    told = server.client.post("/rig/stop")
    assert (told.status_code, told.json()["code"]) == (503, "rig.stop_not_confirmed")
    assert server.ended(run["id"])["status"] == "interrupted"
    server.worker_ready()
    assert server.client.post("/rig/stop").status_code == 204


def test_a_server_that_is_ended_marks_its_run_when_it_starts_again(tmp_path: Path) -> None:
    server = Server(tmp_path).worker_ready()
    run = server.run(speed=20)
    measuring(server, run["id"])
    server.process.kill()
    server.close()
    again = Server(tmp_path)
    try:
        ended = again.client.get(f"/runs/{run['id']}").json()
        assert ended["status"] == "interrupted"
        assert samples(again, ended) > 0
    finally:
        again.close()


# --- a full disk, and other faults in the middle of a run ---------------------------------------------------------
class WatchedRig:
    """A simulated rig that counts how often it was made safe."""

    def __init__(self) -> None:
        self.rig = open_rig("twin:?seed=1")
        self.rig.open()
        self.made_safe = 0
        safe = self.rig.safe

        def counted() -> None:
            self.made_safe += 1
            safe()

        self.rig.safe = counted  # type: ignore[method-assign]

    def __call__(self) -> Rig:
        return self.rig


def queued(store: Store, rig: Rig, **request: Any) -> str:
    filled, plan = plan_of(store, {"board": "LPY-1", "readings": 3, "states": ["estimate_x"], **request}, rig.axes)
    return create(store, filled, plan, rig=rig.url, speed=math.inf)


def test_a_repeated_state_is_held_to_the_specification_of_the_run_it_continues(tmp_path: Path) -> None:
    spec = {"axes": {"x": {"bias_V": {"max": 1.3}}}}
    rig = open_rig("twin:?seed=1")
    with Store(tmp_path) as store:
        run = queued(store, rig, spec=spec, readings=4)
        again = {"board": "LPY-1", "states": ["estimate_x"], "continues": run}
        filled, plan = plan_of(store, again, rig.axes)
        assert (filled["spec"], plan.readings) == (spec, 4)
        assert plan_of(store, {**again, "spec": {**spec, "name": "new"}}, rig.axes)[0]["spec"]["name"] == "new"


def test_a_full_disk_ends_the_run_safely_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    watched = WatchedRig()
    with Store(tmp_path) as store:
        run = queued(store, watched.rig)
        pages = store.connection.rows("pragma page_count")[0]["page_count"]
        store.connection.db.execute(f"pragma max_page_count = {pages + 20}")
        last = conduct(store, run, watched, speed=math.inf, abort=threading.Event(), live=LiveRun(run, {}))
        assert (last["status"], last["message"]["code"]) == ("failed", "store.full")
        assert watched.made_safe == 1
    with Store(tmp_path) as store:
        assert store.connection.rows("pragma integrity_check") == [{"integrity_check": "ok"}]
        store.runs.interrupt_open()
        row = store.runs.get(run)
        assert row["status"] in ("failed", "interrupted")
        assert len(store.recording(row["recording"])) > 500
        assert store.certificates.find() == ([], None)


def test_a_live_view_that_fails_does_not_end_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("no plot today")

    monkeypatch.setattr("server.live_analysis.LiveAnalyser.rows", broken)
    watched = WatchedRig()
    with Store(tmp_path) as store:
        run = queued(store, watched.rig)
        last = conduct(store, run, watched, speed=math.inf, abort=threading.Event(), live=LiveRun(run, {}))
        assert (last["status"], last["message"]) == ("finished", None)
        assert store.runs.get(run)["results"].keys() == {"estimate_x"}


def test_a_rig_that_does_not_open_fails_the_run_with_its_sentence(tmp_path: Path) -> None:
    watched = WatchedRig()
    with Store(tmp_path) as store:
        run = queued(store, watched.rig)
        last = conduct(store, run, lambda: open_rig(ABSENT), speed=1.0, abort=threading.Event(), live=None)
        assert (last["status"], last["message"]["code"]) == ("failed", "rig.port_absent")
        assert store.runs.get(run)["message"] == last["message"]


def test_a_gyro_that_stays_still_fails_the_run_and_keeps_what_was_measured(tmp_path: Path) -> None:
    watched = WatchedRig()
    read = watched.rig.daq.read

    def disconnected(n: int) -> Any:
        found = read(n)
        found.volts[:] = 1.4
        return found

    watched.rig.daq.read = disconnected  # type: ignore[method-assign]
    with Store(tmp_path) as store:
        run = queued(store, watched.rig)
        last = conduct(store, run, watched, speed=math.inf, abort=threading.Event())
        assert (last["status"], last["message"]["code"]) == ("failed", "rig.gyro_still")
        row = store.runs.get(run)
        assert [state["status"] for state in row["states"]] == ["failed"]
        assert store.recordings.row(row["recording"])["digest"].startswith("sha256:")
        assert watched.made_safe >= 1


def test_samples_are_readable_by_another_process_as_they_come(server: Server) -> None:
    run = server.run(speed=20)
    measuring(server, run["id"])
    with closing(sqlite3.connect(f"file:{server.data / FILE}?mode=ro", uri=True)) as other:
        (stored,) = other.execute(
            "select sum(samples) from blocks where recording = ? and kind = 'rows'", [run["recording"]]
        ).fetchone()
    assert stored > 10
    server.client.post(f"/runs/{run['id']}/stop")
