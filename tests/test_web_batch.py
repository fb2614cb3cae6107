"""The Batch page: what a person sees of boards that were certified, and of an upload that is refused."""

import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from browser import PHONE, Server, Window, serving
from recordings import to_parquet
from sessions import session_recording

from server import batch_work
from server.store import Store

BOARDS = ("LPY-1", "LPY-2", "LPY-3")
BATCH = "b0"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    data = tmp_path_factory.mktemp("data")
    certified(data)
    with serving(data) as server:
        yield server


def certified(data: Path) -> None:
    """A batch as its process leaves it: three boards, and a file that was none."""
    whole = session_recording(states=("estimate_x",))
    with Store(data) as store:
        names = [*(f"{board}.parquet" for board in BOARDS), "words.csv"]
        store.batches.create(BATCH, [{"name": name, "size": 1} for name in names], name=names[0], fingerprint="f")
        for row in store.batches.waiting(10):
            board = row["name"].removesuffix(".parquet")
            source = to_parquet(replace(whole, header={**whole.header, "board": board}))
            found = batch_work.certify(source if board in BOARDS else b"hello", row["name"], None, None)
            if "error" in found:
                store.batches.end(row["id"], "failed", verdict="error", error=found["error"])
            else:
                issued = batch_work.keep(store, found, row["name"])
                facts = {name: issued[name] for name in ("board", "verdict", "axes", "warnings")}
                store.batches.end(row["id"], "done", certificate=issued["number"], **facts)


def test_each_board_has_its_row_and_its_place_in_the_fleet(browser: Any, server: Server) -> None:
    window = Window(browser, server)
    page = window.open("/batch.html")
    page.click(f"a[href*='id={BATCH}']")
    page.wait_for_selector(".sentence:has-text('4 of 4 done · 3 issued · 1 without a certificate')")
    page.wait_for_selector("tr:has-text('words.csv') .reason:has-text('there is no column time_s')")
    assert page.locator("tbody tr:has-text('LPY-2') a[href$='.json']").count() == 1
    assert page.locator(".fleet .u-wrap").count() == 2  # one axis, estimated only: its bias and its scale factor
    page.click("button:has-text('Failed 1')")
    page.wait_for_selector(".of-batch tbody tr:only-child")
    with page.expect_download() as download:
        page.click("a[href$='results.csv']")
    assert "LPY-2" in Path(download.value.path()).read_text(encoding="utf-8-sig")
    window.close()


@pytest.mark.parametrize("locale", ["en-US", "th-TH"])
def test_it_fits_a_phone(browser: Any, server: Server, locale: str) -> None:
    window = Window(browser, server, viewport=PHONE, locale=locale)
    page = window.open(f"/batch.html?id={BATCH}")
    page.wait_for_selector(".fleet .u-wrap")
    assert window.widest() <= PHONE["width"]
    window.close()


def test_what_is_chosen_is_told_before_it_is_sent_and_a_refusal_stands_where_it_was_sent(
    browser: Any, server: Server, tmp_path: Path
) -> None:
    with zipfile.ZipFile(tmp_path / "boards.zip", "w") as trick:
        trick.writestr("../LPY-4.csv", "a")
    window = Window(browser, server)
    page = window.open("/batch.html")
    page.set_input_files("#files", tmp_path / "boards.zip")
    page.wait_for_selector("output:has-text('1 file(s)')")
    page.keyboard.press("Enter")  # the button has the focus
    page.wait_for_selector(".error:has-text('../LPY-4.csv names a place outside the zip')")
    window.close(refusals=1)
