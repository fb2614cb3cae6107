"""docker-compose.yml: what it says is what the project has, and its command starts a server."""

import asyncio
import os
import re
import socket
import subprocess
import sys
from collections.abc import Awaitable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from running import Server
from shared import ROOT

from calib_core.problem import Problem
from server import batch_cluster, batch_work
from server.batch_cluster import ADDRESS, Cluster


@pytest.fixture
def services() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))["services"]
    return found


@pytest.fixture
def service(services: dict[str, Any]) -> dict[str, Any]:
    alone = [name for name, service in services.items() if "profiles" not in service]
    assert alone == ["gyrobench"], "the server alone"
    found: dict[str, Any] = services["gyrobench"]
    return found


def test_its_command_starts_a_server_that_answers_its_health_check(service: dict[str, Any], tmp_path: Path) -> None:
    program, command, *options = service["command"]
    assert (program, command) == ("gyrobench", "serve")
    given = dict(zip(options[::2], options[1::2], strict=True))
    assert given.pop("--port") == "8000"
    assert given.pop("--data") == "/data"
    server = Server(tmp_path, *(word for pair in given.items() for word in pair))
    try:
        check = service["healthcheck"]["test"][-1].replace("http://127.0.0.1:8000", server.address)
        exec(check, {})
    finally:
        server.close()


def test_it_is_reachable_from_this_computer_only_and_keeps_its_data(
    service: dict[str, Any], services: dict[str, Any]
) -> None:
    assert "ports" not in services["scheduler"]
    assert service["ports"] == ["127.0.0.1:8000:8000"]
    assert service["volumes"] == ["data:/data"]


def test_its_image_is_made_of_what_the_project_has(service: dict[str, Any]) -> None:
    dockerfile = service["build"]["dockerfile_inline"]
    copied = [name for line in re.findall(r"^COPY (.+) \S+$", dockerfile, re.MULTILINE) for name in line.split()]
    assert {"pyproject.toml", "calib_core", "server", "web"} <= set(copied)
    for name in copied:
        assert (ROOT / name).exists(), name


@pytest.fixture
def cluster(services: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[str]:
    """The scheduler and a worker, by their own commands; in place of its name, the scheduler has a free port here."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    running = []
    for name in ("scheduler", "worker"):
        words = " ".join(services[name]["command"]).replace("scheduler:8786", address)
        words = words.replace("0.0.0.0 --port 8786", address.replace(":", " --port "))
        program, *options = words.split()
        environment = {**os.environ, **services[name].get("environment", {})}
        command = [Path(sys.executable).with_name(program), *options]
        with (tmp_path / name).open("w") as log:
            running.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log, cwd=ROOT))
    monkeypatch.setenv(ADDRESS, f"tcp://{address}")
    yield f"tcp://{address}"
    for process in running:
        process.terminate()
    for process in running:
        process.wait(20)


@pytest.mark.usefixtures("cluster")
def test_its_workers_certify_and_a_task_that_kills_its_worker_is_told_and_harms_no_other() -> None:
    async def told(working: Awaitable[object]) -> object:
        try:
            return await working
        except Problem as problem:
            return problem.code

    async def work() -> list[object]:
        async with Cluster.open() as workers:
            assert not workers.is_local
            bad = await workers.run(batch_work.certify_here, b"hello", "bad.csv", None, None)
            tasks = (workers.run(pow, 2, 3), workers.run(os._exit, 1), workers.run(pow, 2, 4))
            return [bad, *await asyncio.gather(*map(told, tasks))]

    bad, first, killed, second = asyncio.run(work())
    assert (first, killed, second) == (8, "batch.worker_died", 16)
    assert isinstance(bad, dict)
    assert bad["error"]["code"] == "recording.no_time"


def test_a_cluster_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    async def work() -> None:
        async with Cluster.open():
            pass

    monkeypatch.setenv(ADDRESS, "tcp://127.0.0.1:1")
    monkeypatch.setattr(batch_cluster, "CONNECT_S", 0.2)
    with pytest.raises(Problem, match=r"batch\.cluster_gone"):
        asyncio.run(work())
