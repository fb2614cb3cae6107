"""docker-compose.yml: what it says is what the project has, and its command starts a server."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from running import Server
from shared import ROOT


@pytest.fixture
def service() -> dict[str, Any]:
    services = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))["services"]
    assert list(services) == ["gyrobench"], "the server alone"
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


def test_it_is_reachable_from_this_computer_only_and_keeps_its_data(service: dict[str, Any]) -> None:
    assert service["ports"] == ["127.0.0.1:8000:8000"]
    assert service["volumes"] == ["data:/data"]


def test_its_image_is_made_of_what_the_project_has(service: dict[str, Any]) -> None:
    dockerfile = service["build"]["dockerfile_inline"]
    copied = [name for line in re.findall(r"^COPY (.+) \S+$", dockerfile, re.MULTILINE) for name in line.split()]
    assert {"pyproject.toml", "calib_core", "server", "web"} <= set(copied)
    for name in copied:
        assert (ROOT / name).exists(), name
