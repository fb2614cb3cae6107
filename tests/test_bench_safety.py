"""The real drivers under the server: whatever dies, the motors are let go; a pulled cable needs no restart."""

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest

if sys.platform == "win32":
    pytest.skip("the servo bus is emulated behind a pseudo-terminal", allow_module_level=True)

from running import Server

from server import emulators
from server.devices.dynamixel_registers import Register
from server.emulators import Bench

PATIENCE_S = 30.0
BUSY = ("rig.host_busy", "rig.bus_noise", "rig.servo_silent", "daq.late")


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    """Stand-ins of their own: they outlive the server, as a real bench does."""
    with closing(emulators.start(seed=8)) as bench:
        yield bench


@pytest.fixture
def server(bench: Bench, tmp_path: Any) -> Iterator[Server]:
    with closing(Server(tmp_path, "--rig", bench.url)) as server:
        wait(lambda: server.client.post("/rig/check").status_code == 200)
        yield server
    wait(lambda: torque(bench) == [0, 0])  # server shutdown


def torque(bench: Bench) -> list[int]:
    return [bench.bus.peek(servo, Register.TORQUE_ENABLE)[0] for servo in (1, 2)]


def wait(for_what: Any, seconds: float = PATIENCE_S) -> None:
    until = time.monotonic() + seconds
    while not for_what():
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.02)


def moving(server: Server, bench: Bench) -> str:
    """A run that turns the table, as its rehearsal does. A machine too busy to read the servos is given more tries."""
    run = ""

    def turning() -> bool:
        nonlocal run
        now = server.client.get(f"/runs/{run}").json() if run else {"status": "failed", "message": None}
        if now["status"] == "failed":
            assert now["message"] is None or now["message"]["code"] in BUSY, now["message"]
            run = str(server.run(speed=1, states=["estimate_x"])["id"])
        return torque(bench) == [1, 1]

    wait(turning)
    return run


def test_the_emergency_stop_lets_go_and_the_run_says_so(server: Server, bench: Bench) -> None:
    run = moving(server, bench)
    assert server.client.post("/rig/stop").status_code == 204
    assert torque(bench) == [0, 0]
    assert server.ended(run)["status"] == "stopped"


def test_a_killed_worker_leaves_its_servos_inside_the_limits_and_the_next_one_lets_go(
    server: Server, bench: Bench
) -> None:
    run = moving(server, bench)
    pid = server.client.get("/health").json()["worker_pid"]
    os.kill(pid, signal.SIGKILL)
    wait(lambda: torque(bench) == [0, 0])
    assert server.ended(run)["status"] == "interrupted"
    for axis in ("x", "z"):
        assert abs(bench.plant.shaft(axis)[0]) < 151.0


def test_a_pulled_cable_ends_the_run_with_its_sentence_and_the_next_run_needs_no_restart(
    server: Server, bench: Bench
) -> None:
    run = moving(server, bench)
    bench.bus.unplug()
    ended = server.ended(run)
    assert (ended["status"], ended["message"]["code"]) == ("failed", "rig.port_gone")
    assert "power" in ended["message"]["sentence"] or "Plug" in ended["message"]["sentence"]
    assert not server.client.get("/rig").json()["connected"]
    bench.bus.plug()
    wait(lambda: torque(bench) == [0, 0])
    run = moving(server, bench)
    server.client.post(f"/runs/{run}/stop")
    assert server.ended(run)["status"] == "stopped"


def test_an_idle_rigs_page_sees_a_cable_come_off(server: Server, bench: Bench) -> None:
    bench.bus.silence(2)
    wait(lambda: not server.client.get("/rig").json()["connected"])
    bad = [part["sentence"] for part in server.client.get("/rig").json()["parts"] if part["ok"] is False]
    assert bad
    assert all(bad)
    bench.bus.rejoin(2)
    wait(lambda: server.client.post("/rig/check").status_code == 200)
