"""The rig's calibration record from its page to the certificate that names it."""

import json
import math
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import Server, Window, chromium, serving

from calib_core.reference import ReferenceCalibration
from server import run_plan
from server.certify import verify
from server.conduct import conduct
from server.devices import open_rig
from server.documents.pdf import _statements
from server.store import Store

RECORD = {
    "date": "2026-11-20",
    "means": "protractor",
    "by": "A. Student",
    "axes": {"x": {"points": [[-100, -101], [100, 101]], "standard_uncertainty_deg": 0.25}},
}


def certificate(store: Store) -> dict[str, Any]:
    request = {"board": "B-1", "readings": 3, "seed": 1, "states": ["estimate_x"]}
    rig = open_rig("twin:?seed=9")
    filled, plan = run_plan.plan_of(store, request, rig.axes)
    run = run_plan.create(store, filled, plan, rig=rig.url, speed=math.inf)
    last = conduct(store, run, lambda: rig, speed=math.inf, abort=threading.Event())
    content: dict[str, Any] = store.certificates.get(last["certificate"])
    return content


def test_a_certificate_names_the_record_and_its_scale_factor_is_corrected(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        before = certificate(store)
        store.rig_records.set("twin:", ReferenceCalibration.from_json(RECORD))
        after = certificate(store)
        store.rig_records.set("twin:?seed=2", None)
        assert certificate(store)["rig"]["reference_calibration"] == ""
        assert verify(after, store.recording(after["recording"]["id"]))["valid"]
    assert before["rig"]["reference_calibration"] == ""
    assert after["rig"]["reference_calibration"] == "protractor, 2026-11-20, A. Student"
    assert after["rig"]["reference"] == RECORD
    scale = [content["axes"]["x"]["scale_factor_V_per_dps"] for content in (before, after)]
    assert scale[1]["value"] == pytest.approx(scale[0]["value"] / 1.01, rel=1e-5)
    gain = 0.25 * 2**0.5 / 200 / 1.01
    own = scale[0]["standard_uncertainty"] / scale[0]["value"]
    assert scale[1]["standard_uncertainty"] / scale[1]["value"] == pytest.approx(math.hypot(gain, own), rel=0.01)
    said = dict(_statements(after, "en"))
    assert "protractor, 2026-11-20" in said["traceability"]
    assert "not calibrated" in dict(_statements(before, "en"))["traceability"]


def test_a_record_is_of_one_kind_of_rig(tmp_path: Path) -> None:
    record = ReferenceCalibration.from_json(RECORD)
    with Store(tmp_path) as store:
        store.rig_records.set("dynamixel:/dev/ttyUSB0?ids=1,2+nidaq:Dev1", record)
        assert store.rig_records.get("dynamixel:COM3+nidaq:Dev1") == record
        assert store.rig_records.get("twin:") is None


# --- the page --------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tmp_path_factory.mktemp("data")) as server:
        yield server


def test_the_api_keeps_gives_and_drops_a_record(server: Server) -> None:
    assert server.call("GET", "/rig/reference") == {"record": None, "name": "", "gains": {}}
    kept = server.call("PUT", "/rig/reference", RECORD)
    assert kept["gains"]["x"]["scale"] == pytest.approx(1.01)
    assert server.call("GET", "/rig/reference") == kept
    server.call("DELETE", "/rig/reference")
    assert server.call("GET", "/rig/reference")["record"] is None


def test_a_person_enters_a_calibration_on_the_rigs_page(server: Server) -> None:
    with chromium() as browser:
        window = Window(browser, server)
        page = window.open("/rig.html")
        page.wait_for_selector("#reference >> text=Not calibrated")
        page.click("#reference summary")
        page.fill("#ref-date", "2026-11-20")
        page.fill("#ref-means", "protractor")
        page.fill("#ref-x", "-100 -101\n100 101")
        page.click("#ref-save")
        page.wait_for_selector("#reference .error:not(:empty)")
        page.fill("#ref-u-x", "0.25")
        page.click("#ref-save")
        page.wait_for_selector("#reference td >> text=1.01000")
        page.reload()
        page.wait_for_selector("#reference >> text=protractor, 2026-11-20")
        page.click("#reference summary")
        page.click("#ref-drop")
        page.wait_for_selector("#reference >> text=Not calibrated")
        window.close(refusals=1)
    assert json.dumps(server.call("GET", "/rig/reference")["record"]) == "null"
