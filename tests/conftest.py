"""Makes the tests' own helpers importable, lends a browser, and begins with the files that take longest."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# Before numpy is there: three processes with two BLAS threads each spin on two cores, and take twice as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent))

LONG = ("test_web_", "test_bench", "test_gap", "test_batch", "test_compose", "test_bus", "test_worker", "test_style")
"""Browsers, emulators, campaigns: begun last, one of them would be all that still runs."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: not item.path.name.startswith(LONG))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from browser import chromium

    with chromium() as browser:
        yield browser
