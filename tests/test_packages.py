"""What is installed is what was looked at: the chart library's very files, and the versions that pyproject pins."""

import hashlib
import tomllib
from importlib.metadata import distributions
from importlib.resources import files

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from shared import ROOT


@pytest.mark.parametrize(
    ("name", "digest"),
    [
        ("uplot.iife.min.js", "2d27e8ad3d228164525ce213f9dc716f39b4e3aee0cc773fb3491c96cf4921a2"),
        ("uplot.min.css", "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04"),
    ],
)
def test_uplot_is_the_pinned_one(name: str, digest: str) -> None:
    content = files("youplot").joinpath("vendor", name).read_bytes()
    assert hashlib.sha256(content).hexdigest() == digest


def test_every_installed_package_is_pinned() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    pinned = {r.name: r.specifier for r in map(Requirement, settings["tool"]["uv"]["constraint-dependencies"])}
    found = {canonicalize_name(d.metadata["Name"]): d.version for d in distributions()}
    del found["gyrobench"]
    assert [f"{name}=={found[name]}" for name in found if name not in pinned or found[name] not in pinned[name]] == []
