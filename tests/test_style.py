"""The code keeps to its own style: ruff's rules and layout, and mypy's strict types."""

import subprocess
import sys

import pytest
from shared import ROOT

TOOLS = {
    "rules": ["ruff", "check"],
    "layout": ["ruff", "format", "--check"],
    "types": ["mypy", "--strict", "calib_core", "server"],
}


@pytest.mark.parametrize("tool", TOOLS)
def test_the_code_keeps_to_its_style(tool: str) -> None:
    said = subprocess.run([sys.executable, "-m", *TOOLS[tool]], cwd=ROOT, capture_output=True, text=True)
    assert said.returncode == 0, said.stdout + said.stderr
