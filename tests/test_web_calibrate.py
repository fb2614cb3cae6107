"""What a person does on the Calibrate page, in a real browser on a real server with the simulated rig."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import PHONE, Server, Window, serving


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tmp_path_factory.mktemp("data")) as server:
        yield server


@pytest.fixture
def window(browser: Any, server: Server) -> Iterator[Window]:
    window = Window(browser, server)
    yield window
    server.call("POST", "/rig/stop")
    server.wait_idle()
    window.close()


def start(window: Window, board: str, readings: int = 3) -> None:
    page = window.page
    page.fill("#board", board)
    page.click("summary")
    page.fill("#readings", str(readings))
    page.click("#start")


def test_start_leads_to_a_downloaded_certificate(window: Window, server: Server, tmp_path: Path) -> None:
    server.speed("max")
    page = window.open()
    assert "Mount the gyro" in window.text("h1")
    assert page.locator("#mounting svg").is_visible()
    page.fill("#operator", "Somchai")
    start(window, "LPY-0001")
    page.wait_for_selector("#documents a.main")
    assert "LPY-0001" in window.text("h1")
    assert page.locator("#states li").all_inner_texts()[5].endswith("done")
    assert page.locator("#results section").count() == 6
    with page.expect_download() as download:
        page.click("#documents a.main")
    path = tmp_path / "certificate.pdf"
    download.value.save_as(path)
    assert path.read_bytes().startswith(b"%PDF")


def test_stop_ends_the_run_and_keeps_what_was_measured(window: Window, server: Server) -> None:
    server.speed(20)
    page = window.open()
    start(window, "LPY-0002")
    page.wait_for_selector("li[aria-current=step]")
    page.click("#stop-run")
    page.wait_for_selector("#again")
    assert "stopped" in window.text("h1")
    run = server.call("GET", "/runs?q=LPY-0002")["items"][0]
    assert run["status"] == "stopped"
    assert server.call("GET", f"/recordings/{run['recording']}")["samples"] > 0


def test_emergency_stop_works_from_any_page_and_says_so(window: Window, server: Server) -> None:
    server.speed(20)
    run = server.call("POST", "/runs", {"board": "LPY-0003", "readings": 3})["id"]
    page = window.open("/certificates.html")
    box = page.locator(".stop").bounding_box()
    assert box["height"] >= 48
    page.click(".stop")
    page.wait_for_selector(".notice.fail:has-text('motors are off')")
    server.wait_idle()
    assert server.call("GET", f"/runs/{run}")["status"] == "stopped"


def test_reload_and_second_browser_show_the_run_so_far(window: Window, browser: Any, server: Server) -> None:
    server.speed(100)
    page = window.open()
    start(window, "LPY-0004")
    page.wait_for_selector("#result-estimate_x")
    page.reload()
    page.wait_for_selector("#result-estimate_x")
    other = Window(browser, server, viewport=PHONE, locale="th-TH")
    other.open()
    other.page.wait_for_selector("#result-estimate_x")
    assert other.page.get_attribute("html", "lang") == "th"
    assert other.page.locator("#board").is_hidden()
    other.close()


def test_nothing_moves_under_the_eye_when_the_page_opens(browser: Any, server: Server) -> None:
    run = server.call("POST", "/runs", {"board": "LPY-0010", "readings": 3})["id"]
    window = Window(browser, server, viewport=PHONE)
    window.page.add_init_script(
        "window.shifted = 0; new PerformanceObserver((list) => { for (const entry of list.getEntries())"
        " window.shifted += entry.value; }).observe({ type: 'layout-shift', buffered: true });"
    )
    for path in ("/", "/rig.html"):
        page = window.open(path)
        page.wait_for_load_state("networkidle")
        assert page.evaluate("shifted") < 0.1, path  # "good" as browsers' makers count it
    window.close()
    server.call("POST", f"/runs/{run}/stop")
    server.wait_idle()


def test_second_run_is_refused_with_a_sentence_and_the_first_is_shown(browser: Any, server: Server) -> None:
    server.speed(20)
    window = Window(browser, server)
    page = window.open()
    page.fill("#board", "LPY-0006")
    run = server.call("POST", "/runs", {"board": "LPY-0005", "readings": 3})["id"]
    page.click("#start")
    page.wait_for_selector("[data-for=form]:not(:empty)")
    assert page.locator("[data-for=form]").inner_text()
    page.wait_for_selector("#about:has-text('LPY-0005')")
    server.call("POST", f"/runs/{run}/stop")
    server.wait_idle()
    window.close(refusals=1)


def test_bad_input_is_explained_beside_its_field_and_starts_nothing(browser: Any, server: Server) -> None:
    window = Window(browser, server)
    page = window.open()
    before = len(server.call("GET", "/runs")["items"])
    page.fill("#board", "LPY 1;drop")
    page.click("#start")
    page.wait_for_selector("[data-for=board]:not(:empty)")
    assert page.get_attribute("#board", "aria-invalid") == "true"
    page.fill("#board", "LPY-0007")
    page.click("summary")
    page.fill("[name='x.rate_dps']", "119999")
    page.wait_for_selector("[data-for=ranges]:not(:empty)")
    assert len(server.call("GET", "/runs")["items"]) == before
    window.close(refusals=4)


def test_chart_values_are_read_with_the_arrow_keys(window: Window, server: Server) -> None:
    server.speed(100)
    page = window.open()
    start(window, "LPY-0008")
    page.wait_for_selector("#result-estimate_x")
    page.click("#stop-run")
    page.wait_for_selector("#again")
    plot = page.locator("#live .plot").first
    plot.focus()
    plot.press("Home")
    first = page.locator("#live .readout").first.inner_text()
    plot.press("ArrowRight")
    second = page.locator("#live .readout").first.inner_text()
    assert "encoder" in first
    assert "deg/s" in first
    assert first != second
