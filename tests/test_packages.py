"""The chart library is served from the installed package: these are the very files that were looked at."""

import hashlib
from importlib.resources import files

import pytest


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
