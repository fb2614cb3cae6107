"""README promises only what is there."""

import re
import subprocess
import sys

import pytest
from shared import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = sorted(set(re.findall(r"`gyrobench ([a-z]+)", README)))


def test_the_two_commands_are_the_ones_ci_runs() -> None:
    install = "python3 -m pip install -q --target .tools uv && .tools/bin/uv run"
    assert f"{install} gyrobench serve" in README
    test_command = f"{install} --group dev pytest"
    assert test_command in README
    assert test_command in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_named_has_help_with_an_example(command: str) -> None:
    arguments = [sys.executable, "-m", "server.cli", command, "--help"]
    answer = subprocess.run(arguments, capture_output=True, text=True, cwd=ROOT, check=False)
    assert answer.returncode == 0, answer.stderr
    assert f"gyrobench {command}" in answer.stdout


def test_every_file_named_exists() -> None:
    section = README[README.index("## Map of the code") : README.index("## Decisions")]
    missing = []
    for row in section.splitlines():
        folder = ""
        for name in re.findall(r"`([\w./*]+\.(?:py|typ|json|js|html)|[\w/]+/)`", row):
            if "/" in name:
                folder = name.rsplit("/", 1)[0] + "/"
            path = name if "/" in name else folder + name
            if not list(ROOT.glob(path)) and not list(ROOT.glob(f"web/{path}")):
                missing.append(path)
    assert not missing


def test_nothing_else_lies_at_the_top() -> None:
    listed = subprocess.run(["git", "ls-files"], capture_output=True, text=True, cwd=ROOT, check=False)
    if listed.returncode != 0:
        pytest.skip("this copy is no git checkout")
    top = {name.split("/")[0] for name in listed.stdout.splitlines()}
    files = {".gitignore", "LICENSE", "README.md", "docker-compose.yml", "pyproject.toml"}
    assert top <= files | {".ci", "calib_core", "server", "tests", "web"}
