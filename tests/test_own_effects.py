"""A user's own effect: kept, listed, hidden in a twin, named by the diagnosis, taken out again, forgotten."""

import json
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from calib_core.compensation import Compensation
from calib_core.excitation import Excitation, plan_of
from calib_core.problem import Problem
from calib_core.recording import write_csv
from server import cli, diagnosis
from server.app import create_app
from server.devices import open_rig
from server.engine import record
from server.settings import Settings
from server.store import Store

OWN = {
    "name": "seven_waves", "formula": "sin(7 * radians(position_deg))", "parameter": "a", "unit": "{out}",
    "acts": "output",
}  # fmt: skip
TRUTH = 0.002


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data")
    with Store(path) as store:
        store.effects.add(OWN, note="cogging of the motor")
    return path


@pytest.fixture(scope="module")
def file(data: Path) -> Path:
    """Forty seconds of a twin that has it."""
    with Store(data) as store:
        rig = open_rig(store.effects.address(f"twin:?seed=2&effects=x.seven_waves.a:{TRUTH}"))
    rig.open()
    motion = [Excitation("x", "sine", 37.7, (60.0,), (0.1037,)), Excitation("x", "hold", 3.0)]
    path = data / "own.csv"
    with path.open("wb") as opened:
        write_csv(record(plan_of(motion, experiment="1", axis="x"), rig, board="B"), opened)
    return path


def test_it_is_named_where_it_is_kept_and_in_no_library_elsewhere(data: Path, file: Path, tmp_path: Path) -> None:
    with Store(data) as store:
        (said,) = diagnosis.of_file(file, suspects=store.effects.suspects())
    assert (said["verdict"], [found["effect"] for found in said["missing"]]) == ("missing", ["seven_waves"])
    amplitude = next(p for p in said["after"]["parameters"] if p["name"] == "seven_waves.a")
    assert amplitude["unit"] == "V"
    assert abs(amplitude["value"] - TRUTH) < 4.0 * amplitude["standard_uncertainty"]
    assert said["user_effects"] == [OWN]
    assert "seven_waves" in diagnosis.told(said, "th")["sentence"]
    # The answer carries the formula: compensation needs no store.
    assert Compensation.of_diagnosis(said).undone == ("seven_waves",)
    out = tmp_path / "own.h"
    assert cli.main(["export", str(file), "--out", str(out), "--effects", "seven_waves", "--data", str(data)]) == 0
    assert "position_deg" in out.read_text()
    (elsewhere,) = diagnosis.of_file(file)
    assert elsewhere["verdict"] == "unknown"


def test_a_twin_without_the_formula_cannot_hide_it(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        assert store.effects.address("twin:?effects=bias_drift.r:1e-5") == "twin:?effects=bias_drift.r:1e-5"
    for url in ("twin:?effects=seven_waves.a:1", "twin:?own=[1]", 'twin:?own=[{"name":"a"}]'):
        with pytest.raises(Problem, match=r"effects|formula"):
            open_rig(url)


def test_over_http_it_is_made_listed_and_forgotten(tmp_path: Path) -> None:
    client = TestClient(create_app(Settings(data=tmp_path)), base_url="http://127.0.0.1:8000/api/v1")

    def post(**changes: Any) -> Any:
        return client.post("/effects", json={**OWN, **changes})

    made = post(note="cogging")
    assert made.status_code == 201, made.text
    assert (made.json()["own"], made.json()["summary"], made.json()["formula"]) == (True, "cogging", OWN["formula"])
    assert post().json()["code"] == "effect.exists"
    refusals = {
        "formula.unknown_name": post(name="b", formula="rate_dps * __import__"),
        "formula.not_allowed": post(name="b", formula="rate_dps.real"),
        "formula.syntax": post(name="b", formula="(rate_dps"),
        "formula.name_taken": post(name="bias_drift"),
        "formula.bad_parameter": post(name="b", parameter="sin"),
    }
    for code, answer in refusals.items():
        assert (answer.status_code, answer.json()["code"]) == (422, code)
        assert "position" in answer.json()["detail"] or "name" in answer.json()["detail"]
    thai = client.get("/effects", headers={"Accept-Language": "th"}).json()["items"]
    assert (thai[-1]["name"], thai[-1]["own"], thai[0]["own"]) == ("seven_waves", True, False)
    assert client.get("/effects/seven_waves").json()["excite_it"] == "Change position_deg."
    assert client.delete("/effects/bias_drift").status_code == 409
    assert client.delete("/effects/seven_waves").status_code == 204
    assert client.delete("/effects/seven_waves").status_code == 404


def test_the_command_keeps_lists_and_forgets_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def said(*words: str) -> tuple[int, str]:
        code = cli.main(["effects", "--data", str(tmp_path), *words])
        return code, "".join(capsys.readouterr())

    made = ["--add", "seven_waves", "--formula", OWN["formula"], "--parameter", "a", "--note", "cogging"]
    assert "your own: a × (sin(7 * radians(position_deg)))" in said(*made)[1]
    code, told = said("--lang", "th")
    assert (code, "ของคุณเอง" in told, "warm_up" in told) == (0, True, True)
    assert json.loads(said("--json")[1])["effects"][-1]["summary"] == "cogging"
    assert said(*made)[0] == said("--add", "b", "--formula", "rate_dps.real")[0] == said("--remove", "warm_up")[0] == 2
    assert "seven_waves" not in said("--remove", "seven_waves")[1]
