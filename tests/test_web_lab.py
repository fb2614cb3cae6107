"""The blind lab in a browser, from the teacher's form to the table; and what a student could learn in other ways."""

import csv
import io
import json
import re
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import PHONE, Server, Window, chromium, serious, serving

SHORT = [
    {"axis": "x", "kind": "sine", "amplitude_deg": [30.0], "frequency_hz": [0.2513], "duration_s": 12.0},
    {"axis": "x", "kind": "hold", "duration_s": 3.0},
]
HIDDEN = {"tau": 0.0087654, "h": 0.00123456}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tmp_path_factory.mktemp("data")) as server:
        yield server


def answered(server: Server, method: str, path: str, body: object = None, **headers: str) -> tuple[int, str, bytes]:
    """Status, headers and body, whatever they are."""
    request = urllib.request.Request(server.url + path, method=method, headers=headers)
    if body is not None:
        request.add_header("Content-Type", "application/json")
        request.data = json.dumps(body).encode()
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, str(answer.headers), answer.read()
    except urllib.error.HTTPError as error:
        return error.code, str(error.headers), error.read()


def test_no_route_tells_a_student_what_is_hidden(server: Server) -> None:
    """Every GET of the API with everything that a student knows, and every answer that a student gets on the way."""
    effects = [
        {"effect": "bandwidth_lag", "parameters": {"tau": HIDDEN["tau"]}},
        {"effect": "hysteresis", "parameters": {"h": HIDDEN["h"]}},
    ]
    seed = 8_765_432_123_456
    made = server.call("POST", "/lab", {"effects": effects, "seed": seed, "starter": "sine"}, seconds=60)
    code, key = made["code"], made["key"]
    heard: list[tuple[str, bytes]] = []

    def ask(method: str, path: str, body: object = None) -> Any:
        status, head, content = answered(server, method, path, body)
        heard.append((f"{method} {path}", head.encode() + content))
        return status, content

    _, content = ask("POST", f"/api/v1/lab/{code}/students", {"name": "Eve"})
    student = json.loads(content)
    own = f"/api/v1/lab/{code}/students/{student['student']}"
    ask("POST", f"{own}/plan", {"motion": SHORT})
    _, content = ask("POST", f"{own}/runs", {"motion": SHORT})
    recording = json.loads(content)["recording"]
    ask("POST", f"{own}/runs", {"motion": [{"axis": "x", "kind": "hold", "duration_s": 9999.0}]})
    answer = {"findings": [["bandwidth_lag", "time_offset"]], "confidence": 80, "recording": None}
    for findings in ([["hysteresis"]], [["bandwidth_lag", "time_offset"]]):  # right or wrong, it says the same
        status, content = ask("PUT", f"{own}/answer", answer | {"findings": findings})
        assert status == 200
        assert {name: json.loads(content)[name] for name in ("grade", "diagnosis")} == {
            "grade": None,
            "diagnosis": None,
        }
    for wrong in (None, "guessed"):
        for method, path in (("POST", "reveal"), ("GET", "results"), ("GET", "results.csv"), ("DELETE", "")):
            given = {"X-Lab-Key": wrong} if wrong else {}
            status, head, content = answered(server, method, f"/api/v1/lab/{code}/{path}".rstrip("/"), **given)
            assert (status, json.loads(content)["code"]) == (403, "lab.key")
            heard.append((path, head.encode() + content))

    described = json.loads(answered(server, "GET", "/openapi.json")[2])
    known = {
        "code": [code], "who": [student["student"]], "notebook_id": [student["notebook"]],
        "recording": [recording, student["runs"][0]["recording"]], "form": ["csv", "json", "pdf"],
        "board": [f"LAB-{code}"], "lang": ["en"],
    }  # fmt: skip
    walked = 0
    for path, operations in described["paths"].items():
        # The thesis' tables are the same for everybody and take seconds.
        if "get" not in operations or path.endswith("/thesis"):
            continue
        names = re.findall(r"{(\w+)}", path)
        for i in range(max([len(known.get(name, [code])) for name in names], default=1)):
            filled = path
            for name in names:
                values = known.get(name, [code, student["student"]])
                filled = filled.replace(f"{{{name}}}", values[i % len(values)])
            ask("GET", filled)
            walked += 1
    assert walked > 30
    assert any(b"x_gyro_v" in content for _, content in heard), "no recording was read"
    secret = [str(seed), f"{HIDDEN['tau']}", f"{HIDDEN['h']}", "twin:?", str(key), '"strength"']
    open_ = ("GET /openapi.json", "GET /api/v1/rig", "GET /api/v1/health")
    told = [
        (where, word)
        for where, content in heard
        for word in secret
        if word.encode() in content and not (word == "twin:?" and where.startswith(open_))
    ]
    assert told == []
    # Names of effects are in the library for everybody, and in the student's own answer; nowhere else.
    names = [w for w, content in heard if b"bandwidth_lag" in content and "effects" not in w and own not in w]
    assert [where for where in names if student["notebook"] not in where] == []
    status, _, _ = answered(server, "DELETE", f"/api/v1/lab/{code}", **{"X-Lab-Key": str(key)})
    assert status == 204
    assert answered(server, "GET", f"/api/v1/lab/{code}")[0] == 404


def test_from_the_teachers_form_to_the_table(server: Server, tmp_path: Path) -> None:
    with chromium() as browser:
        teacher = Window(browser, server)
        page = teacher.open("/lab.html")
        page.fill("#title", "Lab 3")
        page.check("input[value=chosen]")
        page.select_option("#hidden-0", "hysteresis")
        page.fill("#hidden-0-strength", "3")
        page.click("text=Make the exercise")
        page.wait_for_selector(".board-code .code")  # seen: the page shows itself when it is whole
        code = page.inner_text(".board-code .code")
        assert re.fullmatch("[B-Z2-9]{6}", code)

        student = Window(browser, server, viewport=PHONE)
        bench = student.open("/lab.html")
        assert student.widest() <= PHONE["width"]
        bench.fill("#lab-code", code.lower())
        bench.fill("#lab-name", "Ann")
        bench.click("text=Join >> nth=-1")
        bench.click("[data-offer=staircase]")
        bench.fill("input[type=number]", "20")
        bench.fill("#motion-0-rates_dps", "10, 400")
        bench.wait_for_selector("text=400.0 deg/s asked")
        bench.fill("#motion-0-rates_dps", "10, 40")
        bench.click("[data-offer=hold]")
        bench.locator("li input[type=number]").last.fill("4")
        bench.wait_for_selector("text=of bench time")
        bench.click("text=Run it")
        link = bench.locator("a.open").get_attribute("href")
        assert re.search(rf"recording=\w+&axis=x&lab={code}&notebook=\w+", link)
        bench.click("a.open")
        bench.wait_for_selector("[data-effect=hysteresis] .add", timeout=60_000)
        bench.wait_for_selector(".lines:has-text('Opened')")
        bench.click("text=Back to the bench")
        bench.click("text=Hand in >> nth=-1")
        bench.wait_for_selector("text=Say what is hidden")
        bench.check("input[value=found]")
        bench.select_option(".finding select", "hysteresis")
        bench.fill("#reasoning", "It jumps when the rotation turns round.")
        bench.click("text=Hand in >> nth=-1")
        bench.wait_for_selector("text=Handed in at")
        bench.wait_for_selector(".lines li:last-child >> text=Handed in: hysteresis")
        assert student.widest() <= PHONE["width"]

        page.evaluate("() => document.dispatchEvent(new Event('visibilitychange'))")  # the teacher looks again
        page.wait_for_selector("text=Joined: 1. Handed in: 1.")
        assert page.locator(".mark").count() == 0, "marks before the reveal, where the class may look"
        page.click("text=Reveal the truth")
        page.click("text=Reveal now")
        page.wait_for_selector(".mark.right", timeout=90_000)  # the instrument first looks at the answer's recording
        with page.expect_download() as download:
            page.click("text=Results as CSV")
        download.value.save_as(tmp_path / "results.csv")
        (row,) = csv.DictReader(io.StringIO((tmp_path / "results.csv").read_text(encoding="utf-8-sig")))
        assert (row["name"], row["answer"], row["truth"], row["score"]) == ("Ann", "hysteresis", "hysteresis", "1.0")
        assert row["instrument_verdict"], "the reveal waits for the instrument's word on every answer"

        bench.reload()
        bench.wait_for_selector(".about svg")
        assert "Right:" in student.text(".mark")
        assert "reversal" in student.text(".about")
        assert student.widest() <= PHONE["width"]
        kept = [window.evaluate("() => localStorage['gyrobench.lab']") for window in (page, bench)]
        known = {name: value for text in kept for name, value in json.loads(text)[code].items()}
        first = f"localStorage['gyrobench.lab'] = JSON.stringify({json.dumps({code: known})})"
        assert serious(browser, server, [f"/lab.html?code={code}", f"/lab.html?code={code}&student"], first=first) == []
        teacher.close()
        student.close(refusals=1)
