"""Lab notebooks: lines in order that nobody changes, said in both languages, and the PDF that is handed in."""

import sqlite3
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from calib_core.problem import Problem
from server import notebook
from server.api import notebooks
from server.api.common import _services
from server.documents.notebook import page
from server.store import Store

SINE = {"axis": "x", "kind": "sine", "amplitude_deg": [30.0], "frequency_hz": [0.2513], "duration_s": 99.5}
STEPS: list[dict[str, Any]] = [
    {"step": "opened", "recording": "r1", "name": "LPY-1", "axis": "x", "samples": 22191, "duration_s": 221.9},
    {"step": "guessed", "effects": ["hysteresis"], "covariate": "x_rate_dps", "why": "it jumps\nat reversals"},
    {"step": "guessed", "effects": ["hysteresis", "my_own"]},
    {"step": "seen", "effect": "bandwidth_lag", "two_delta_lnL": 812.34},
    {"step": "guessed", "why": "only noise"},
    {"step": "seen", "effect": "thermal_lag"},
    {"step": "added", "effects": ["bandwidth_lag"], "before": 0.6123, "after": 0.0812, "floor": 0.079},
    {"step": "removed", "effects": ["bandwidth_lag"], "before": 0.0812, "after": 0.6123},
    {"step": "experiment", "motion": [SINE], "duration_s": 99.5},
    {"step": "verdict", "code": "diagnosis.limit.rivals",
     "values": {"rivals": {"code": "diagnosis.both", "values": {"some": ["a"], "last": "b"}}}},
    {"step": "note", "text": "#panic() is only text"},
    {"step": "submitted", "findings": [["bandwidth_lag", "time_offset"]], "confidence": 80, "reasoning": "4 Hz"},
    {"step": "submitted", "findings": [], "confidence": 100},
]  # fmt: skip


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path)


@pytest.fixture
def client(tmp_path: Path) -> TestClient:
    """The routes without the rig's worker, which they do not need."""
    from fastapi import FastAPI

    from server import problems
    from server.compute import Compute

    class Here:
        store = Store(tmp_path)
        compute = Compute()

    app = FastAPI()
    problems.install(app)
    app.include_router(notebooks.router)
    app.dependency_overrides[_services] = lambda: Here
    return TestClient(app)


def test_every_step_has_a_line_in_both_languages(client: TestClient) -> None:
    made = client.post("/notebooks", json={"title": "T", "author": "Ada"}).json()["id"]
    for number, step in enumerate(STEPS, 1):
        answer = client.post(f"/notebooks/{made}/lines", json=step)
        assert (answer.status_code, answer.json().get("n")) == (201, number), answer.text
    for lang in ("en", "th"):
        opened = client.get(f"/notebooks/{made}", headers={"Accept-Language": lang}).json()
        said = [line["sentence"] for line in opened["content"]]
        assert (opened["lines"], len(said)) == (len(STEPS), len(STEPS))
        assert not [text for text in said if "{" in text or "notebook." in text or "None" in text]
        assert "0.612" in said[6]
        assert "0.079" in said[6]
        assert "0.2513" in said[8]
        assert [line["own"] for line in opened["content"]][10] == "#panic() is only text"
    assert "lag of the sensor or delay" in client.get(f"/notebooks/{made}").json()["content"][11]["sentence"]
    listed = client.get("/notebooks").json()["items"]
    assert [(item["id"], item["lines"]) for item in listed] == [(made, len(STEPS))]


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ({"step": "verdict", "code": "page.stop", "values": {}}, "notebook.verdict"),
        ({"step": "verdict", "code": "diagnosis.missing", "values": {"a": [[[[[[[[[[1]]]]]]]]]]}}, "notebook.verdict"),
        ({"step": "added", "effects": [], "before": 1.0, "after": 1.0}, "request.unacceptable"),
        ({"step": "note", "text": ""}, "request.too_short"),
        ({"step": "erased"}, "request.unacceptable"),
    ],
)
def test_lines_that_cannot_be_said_are_refused(client: TestClient, line: dict[str, Any], code: str) -> None:
    made = client.post("/notebooks", json={}).json()["id"]
    answer = client.post(f"/notebooks/{made}/lines", json=line)
    assert (answer.status_code, answer.json()["code"]) == (422, code)
    assert client.get(f"/notebooks/{made}").json()["lines"] == 0
    assert client.post("/notebooks/none/lines", json=STEPS[0]).status_code == 404


def test_lines_are_never_changed(store: Store) -> None:
    made = store.notebooks.create()
    store.notebooks.append(made, "note", {"text": "first"})
    for sql in ("update notebook_lines set body = '{}'", "delete from notebook_lines"):
        with pytest.raises(sqlite3.IntegrityError, match="never changed"), store.connection.write() as db:
            db.execute(sql)
    assert store.notebooks.lines(made)[0]["values"] == {"text": "first"}


def test_a_notebook_of_a_blind_exercise_is_in_no_list_and_a_full_one_takes_no_more(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    hidden, open_ = store.notebooks.create(lab="L"), store.notebooks.create()
    assert [row["id"] for row in store.notebooks.find()[0]] == [open_]
    monkeypatch.setattr("server.store_notebooks.MOST_LINES", 1)
    store.notebooks.append(hidden, "note", {"text": "x"})
    with pytest.raises(Problem) as refused:
        store.notebooks.append(hidden, "note", {"text": "y"})
    assert refused.value.code == "notebook.full"


def test_the_pdf_says_every_line_and_shows_the_error_fall(store: Store) -> None:
    made = store.notebooks.create(title="Bench KQ7M", author="สมหญิง")
    for step in STEPS:
        store.notebooks.append(made, step["step"], {k: v for k, v in step.items() if k != "step"})
    head, lines = store.notebooks.get(made), store.notebooks.lines(made)
    for lang in ("en", "th"):
        set_ = page(head, lines, lang)
        rows = [row for day in set_["days"] for row in day["rows"]]
        assert [row[2] for row in rows] == [notebook.told(line, lang)["sentence"] for line in lines]
        assert rows[1][3] == ["it jumps", "at reversals"]
        assert [bar[1] for bar in set_["error"]["bars"]] == [0.6123, 0.0812, 0.6123]
        from server.documents.notebook import render_notebook

        pdf = render_notebook(head, lines, lang)
        assert pdf.startswith(b"%PDF")
        assert pdf == render_notebook(head, lines, lang)
