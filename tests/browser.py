"""A real server on a free port and a real Chromium, for tests of what a person does."""

import json
import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from shared import ROOT

CHROMIUM = Path("/usr/bin/chromium")
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
PHONE = {"width": 390, "height": 844}
DESK = {"width": 1440, "height": 900}


class Server:
    """A running `gyrobench serve`, and its API for what a test needs to arrange."""

    def __init__(self, url: str) -> None:
        self.url = url

    def call(self, method: str, path: str, body: object = None, *, seconds: float = 30.0) -> Any:
        request = urllib.request.Request(f"{self.url}/api/v1{path}", method=method)
        if body is not None:
            request.add_header("Content-Type", "application/json")
            request.data = json.dumps(body).encode()
        with urllib.request.urlopen(request, timeout=seconds) as answer:
            content = answer.read()
        return json.loads(content) if content else None

    def speed(self, speed: float | str) -> None:
        self.call("PUT", "/rig", {"url": "twin:?seed=1", "speed": speed})

    def wait_idle(self) -> None:
        """Until no run is on; at most half a minute."""
        until(lambda: self.call("GET", "/rig")["run"] is None)


def until(ready: Any, seconds: float = 30.0) -> None:
    limit = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < limit, "it did not happen in time"
        time.sleep(0.05)


@contextmanager
def serving(data: Path) -> Iterator[Server]:
    command = [sys.executable, "-m", "server.cli", "serve", "--port", "0", "--data", str(data), "--speed", "max"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("Gyrobench: "), f"the server said {line!r}"
            server = Server(line.split()[1].rstrip("/"))
            until(lambda: server.call("GET", "/rig")["connected"])
            yield server
        finally:
            process.terminate()
            process.wait(timeout=20)


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser; without one the test is skipped, saying so, unless GYROBENCH_BROWSER_REQUIRED is set."""
    if not CHROMIUM.exists():
        (pytest.fail if os.environ.get("GYROBENCH_BROWSER_REQUIRED") else pytest.skip)(f"there is no {CHROMIUM}")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
        yield browser
        browser.close()


class Window:
    """One page in its own profile; what its console and its scripts complained about."""

    def __init__(self, browser: Any, server: Server, *, viewport: dict[str, int] = DESK, locale: str = "en-US") -> None:
        self.server = server
        self.context = browser.new_context(viewport=viewport, locale=locale, base_url=server.url)
        self.context.set_default_timeout(20_000)
        self.page = self.context.new_page()
        self.complaints: list[str] = []
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", lambda said: self.complaints.append(said.text) if said.type == "error" else None)

    def open(self, path: str = "/") -> Any:
        self.page.goto(path)
        self.page.wait_for_selector("html[data-ready]")
        return self.page

    def text(self, selector: str) -> str:
        return str(self.page.locator(selector).inner_text())

    def widest(self) -> int:
        return int(self.page.evaluate("document.documentElement.scrollWidth"))

    def close(self, refusals: int = 0) -> None:
        """Closes; a refused request is the one thing a browser may write to its console, and only as often as said."""
        self.context.close()
        refused = [line for line in self.complaints if line.startswith("Failed to load resource")]
        others = [line for line in self.complaints if line not in refused]
        assert not others, others
        assert len(refused) <= refusals, refused


def serious(browser: Any, server: Server, paths: Sequence[str], *, first: str = "") -> list[str]:
    """What axe-core calls serious or critical on these pages, dark and light in turn; ``first`` is run before each."""
    from axe_playwright_python.sync_playwright import Axe

    found = []
    # The pages' own policy forbids the script that axe is.
    context = browser.new_context(viewport=DESK, locale="en-US", base_url=server.url, bypass_csp=True)
    context.add_init_script(first)
    page = context.new_page()
    for k, path in enumerate(paths):
        page.emulate_media(color_scheme=("light", "dark")[k % 2])
        page.goto(path)
        page.wait_for_selector("html[data-ready]")
        page.wait_for_load_state("networkidle")
        for violation in Axe().run(page).response["violations"]:
            if violation["impact"] in ("serious", "critical"):
                found.append(f"{path}: {violation['id']}: {violation['nodes'][0]['html'][:200]}")
    context.close()
    return found
