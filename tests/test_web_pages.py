"""The other pages: language, phone width, fonts, lists, comparison, a run's own page."""

import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import PHONE, Server, Window, serious, serving

PAGES = (
    "/",
    "/workbench.html",
    "/run.html",
    "/boards.html",
    "/certificates.html",
    "/compare.html",
    "/rig.html",
    "/thesis.html",
)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tmp_path_factory.mktemp("data")) as server:
        for board in ("LPY-A", "LPY-B"):
            server.call("POST", "/runs", {"board": board, "readings": 3, "seed": 1})
            server.wait_idle()
        server.call("GET", "/thesis", seconds=120)  # computed once; its page then comes as soon as the others
        yield server


@pytest.fixture
def window(browser: Any, server: Server) -> Iterator[Window]:
    window = Window(browser, server)
    yield window
    window.close()


def test_language_switch_is_kept_and_sets_the_page_language(window: Window) -> None:
    page = window.open("/boards.html")
    assert window.text("h1") == "Boards"
    page.click("button[lang=th]")
    page.wait_for_selector("html[lang=th][data-ready]")
    window.open("/certificates.html")
    assert window.text("h1") == "ใบรับรอง"
    assert page.locator("button[lang=th]").get_attribute("aria-pressed") == "true"


@pytest.mark.parametrize("locale", ["en-US", "th-TH"])
def test_no_page_scrolls_sideways_on_a_phone_or_sends_a_face_that_is_not_read(
    browser: Any, server: Server, locale: str
) -> None:
    window = Window(browser, server, viewport=PHONE, locale=locale)
    asked: list[str] = []
    window.page.on("request", lambda request: asked.append(request.url))
    run = server.call("GET", "/runs")["items"][0]["id"]
    for path in (*PAGES, f"/run.html?id={run}", "/boards.html?id=LPY-A"):
        page = window.open(path)
        page.wait_for_load_state("networkidle")
        assert window.widest() <= PHONE["width"], path
        stop = page.locator(".stop").bounding_box()
        assert stop["height"] >= 48
        assert stop["y"] + stop["height"] <= PHONE["height"], f"{path}: the stop is not on the screen"
    window.close()
    assert any("sarabun" in url for url in asked) == (locale == "th-TH")


def test_axe_finds_nothing_serious_on_any_page(browser: Any, server: Server) -> None:
    run = server.call("GET", "/runs")["items"][0]["id"]
    paths = [*PAGES, f"/run.html?id={run}", "/boards.html?id=LPY-A", "/compare.html?a=LPY-A&b=LPY-B"]
    assert serious(browser, server, paths) == []


def test_search_finds_a_board_and_says_when_there_is_none(window: Window) -> None:
    page = window.open("/boards.html")
    page.fill("#search", "LPY-B")
    page.wait_for_selector("tbody tr:only-child")
    assert "LPY-B" in window.text("tbody")
    page.fill("#search", "nothing like it")
    page.wait_for_selector(".empty")
    assert "nothing like it" in window.text(".empty")


def test_certificate_is_verified_from_its_list(window: Window) -> None:
    page = window.open("/certificates.html")
    page.locator("tbody button").first.click()
    page.wait_for_selector("output:has-text('same numbers')")


def test_a_recording_from_a_file_is_certified_and_a_bad_one_is_explained(
    browser: Any, server: Server, tmp_path: Path
) -> None:
    window = Window(browser, server)
    page = window.open("/certificates.html")
    bad = tmp_path / "bad.csv"
    bad.write_text("time_s,x_gyro_v\n0,1.2\n0.01,1.2\n0.005,1.2\n", encoding="utf-8")
    page.set_input_files("#file", bad)
    page.wait_for_selector(".error:has-text('Line 4, column time_s')")
    number = server.call("GET", "/certificates?board=LPY-A")["items"][0]["number"]
    recording = server.call("GET", f"/certificates/{number}")["recording"]["id"]
    with urllib.request.urlopen(f"{server.url}/api/v1/recordings/{recording}.csv", timeout=30) as answer:
        bad.write_bytes(answer.read())
    page.set_input_files("#file", bad)
    page.wait_for_selector("output a[href*='.pdf']")
    assert not page.locator(".error").inner_text()
    window.close(refusals=1)


def test_two_boards_stand_side_by_side(window: Window) -> None:
    page = window.open("/compare.html?a=LPY-A&b=LPY-B")
    page.wait_for_selector("table")
    heads = page.locator("thead").first.inner_text()
    assert all(column in heads for column in ("LPY-A x", "LPY-A z", "LPY-B x", "LPY-B z"))
    assert page.locator("table").count() == 3


def test_two_certificates_of_one_board_stand_side_by_side_by_their_numbers(window: Window, server: Server) -> None:
    number = server.call("GET", "/certificates?board=LPY-A")["items"][0]["number"]
    page = window.open(f"/compare.html?a={number}&b=LPY-A")
    page.wait_for_selector("table")
    assert page.locator("thead").first.inner_text().count(f"{number} x") == 2
    page.fill("#b", "nobody")
    page.click("form.compare button")
    page.wait_for_selector(".error:has-text('nobody')")


def test_run_page_shows_results_pictures_and_the_raw_recording(window: Window, server: Server, tmp_path: Path) -> None:
    run = server.call("GET", "/runs?q=LPY-A")["items"][0]["id"]
    page = window.open(f"/run.html?id={run}")
    page.wait_for_selector("#result-position_z")
    page.wait_for_selector("#result-estimate_x .u-wrap >> nth=1")
    assert page.locator(".error:not(:empty)").count() == 0
    with page.expect_download() as download:
        page.click("a[href$='.csv']:has-text('Raw')")
    path = tmp_path / "run.csv"
    download.value.save_as(path)
    assert "x_gyro_v" in path.read_text(encoding="utf-8")[:3000]


def test_one_state_is_repeated_and_the_others_are_kept(window: Window, server: Server) -> None:
    run = server.call("GET", "/runs?q=LPY-A")["items"][0]["id"]
    page = window.open(f"/run.html?id={run}")
    page.click("#result-rate_z button")
    page.wait_for_url("**/?run=*")
    page.wait_for_selector("#again")
    states = page.locator("#states li").all_inner_texts()
    assert "kept" in states[0]
    assert "done" in states[4]
    server.wait_idle()


def test_rig_page_names_every_part_and_its_state(window: Window) -> None:
    page = window.open("/rig.html")
    page.wait_for_selector(".parts li")
    assert page.locator(".parts li").count() == 4
    assert "RX-28" in window.text(".parts")


def test_the_bench_that_is_chosen_is_asked_for_and_a_refusal_shows_the_rig_that_is_there(
    browser: Any, server: Server
) -> None:
    rig = server.call("GET", "/rig")
    ports = ["/dev/ttyS7", "/dev/ttyUSB9"]
    benches = [{"url": f"dynamixel:{port}?ids=1,2+nidaq:Dev1", "label": f"Bench at {port}"} for port in ports]
    asked: list[Any] = []

    def answer(route: Any) -> None:
        if route.request.method == "PUT":
            asked.append(route.request.post_data_json["url"])
            route.continue_()
        else:
            route.fulfill(json={**rig, "ports": ports, "choices": [*rig["choices"], *benches]})

    window = Window(browser, server)
    window.page.route("**/api/v1/rig", answer)
    page = window.open("/rig.html")
    page.select_option("#rig-url", label="Bench at /dev/ttyUSB9")
    page.wait_for_selector(".error:has-text('/dev/ttyUSB9')")
    assert asked == [benches[1]["url"]]
    assert page.input_value("#rig-url") == rig["url"]
    window.close(refusals=1)
    server.call("PUT", "/rig", {"url": rig["url"], "speed": rig["speed"]})


def test_the_rig_page_checks_the_physics_and_shows_each_check(window: Window, server: Server) -> None:
    page = window.open("/rig.html")
    page.click("#start-check")
    page.wait_for_selector("#physics .parts li:nth-child(8)")
    said = window.text("#physics .parts")
    assert "mV/(deg/s)" in said
    assert "3.18 %" in said
    rig = server.call("GET", "/rig")
    server.call("PUT", "/rig", {"url": rig["url"], "speed": rig["speed"]})


def test_numbers_show_as_many_digits_as_their_uncertainty_allows(window: Window) -> None:
    page = window.open("/rig.html")
    pairs = [[5.94823, 0.0031], [1.2630412, 0.000021], [45.61, 1.24], [0.123, 0.00996], [-5.9482, 0.0996], [7.0, 0.0]]
    written = page.evaluate(
        "async pairs => { const text = await import('/js/text.js');"
        " return pairs.map(([value, u]) => text.withUncertainty(value, u)); }",
        pairs,
    )
    assert written == ["5.9482(31)", "1.263041(21)", "45.6(1.2)", "0.123(10)", "−5.95(10)", "7.0000"]


def test_limits_decide_and_each_is_shown(window: Window, server: Server) -> None:
    limits = {"name": "lab", "axes": {"x": {"bias_V": {"min": 2.0}, "rate": {"nonlinearity_pct_fs": {"max": 50.0}}}}}
    recording = server.call("GET", "/runs?q=LPY-B")["items"][0]["recording"]
    issued = server.call("POST", "/certificates", {"recording": recording, "spec": limits})
    assert issued["verdict"] == "fail"
    page = window.open("/certificates.html")
    page.wait_for_selector(f"tr:has-text('{issued['number']}'):has-text('fail')")


@pytest.mark.parametrize(
    ("path", "link"),
    [
        ("/boards.html", "tr:has-text('LPY-A') a[href^='/workbench']"),
        ("/boards.html?id=LPY-A", "a[href^='/workbench'] >> nth=-1"),
        ("/certificates.html", "tr:has-text('LPY-A') a[href^='/workbench'] >> nth=-1"),
        ("/run.html", "tr:has-text('LPY-A') a[href^='/workbench'] >> nth=-1"),
    ],
)
def test_every_list_leads_to_the_workbench_with_its_recording(
    window: Window, server: Server, path: str, link: str
) -> None:
    newest = server.call("GET", "/recordings?board=LPY-A")["items"]
    page = window.open(path)
    page.click(link)
    page.wait_for_selector(".opened strong")
    assert "LPY-A" in window.text(".opened")
    assert any(row["id"] in page.url for row in newest)


def test_the_start_page_says_where_to_look_for_what_is_missing(window: Window) -> None:
    page = window.open("/")
    page.click("text=Find what a gyro's model is missing")
    page.wait_for_selector(".example")
    assert "missing" in window.text("h1")
