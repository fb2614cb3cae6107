"""The start-up check over HTTP, against a real server."""

import time
from collections.abc import Iterator
from typing import Any

import pytest
from running import Server


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    running = Server(tmp_path_factory.mktemp("data"))
    yield running.worker_ready()
    running.close()


def checked(server: Server, **body: Any) -> dict[str, Any]:
    """The rig once its check is over."""
    answer = server.client.post("/rig/start-check", json=body)
    assert answer.status_code == 202, answer.text
    until = time.monotonic() + 20.0
    while (rig := server.client.get("/rig").json())["checking"]:
        assert time.monotonic() < until
    return rig


def test_the_rigs_physics_are_checked_and_each_check_has_its_sentence(server: Server) -> None:
    rig = checked(server)
    assert [check["part"] for check in rig["checks"]] == [
        "servo x", "servo z", "daq", "range", "gyro x", "gyro z", "step x", "step z",
    ]  # fmt: skip
    assert all(check["ok"] for check in rig["checks"])
    assert "mV/(deg/s)" in rig["checks"][4]["sentence"]


def test_a_check_that_fails_says_what_to_do(server: Server) -> None:
    checks = {check["part"]: check for check in checked(server, gyro_model="LPY503AL-4XOUT")["checks"]}
    assert checks["gyro x"]["ok"] is False
    assert "4xOUT" in checks["gyro x"]["cure"]
    assert server.client.post("/rig/start-check", json={"gyro_model": "NONE"}).status_code == 404


def test_another_rig_forgets_what_was_found_of_the_last(server: Server) -> None:
    checked(server)
    assert server.client.put("/rig", json={"url": "twin:?seed=2"}).json()["checks"] == []
