"""Saved models: fitted as in the workbench, kept, exported in three forms, and stated on a certificate."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib_core.compensation import Compensation
from calib_core.corrected import corrected
from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.sequence import make_plan
from calib_core.twin import board_truth
from server import certify, cli
from server.compute import certify as certified
from server.compute import export_model, save_model
from server.devices import open_rig
from server.documents import render
from server.documents.pdf import page
from server.engine import record
from server.store import Store
from server.store_models import compensation_of

CUBIC, AGE = -3e-6, 0.004


@pytest.fixture(scope="module")
def session() -> Recording:
    """Estimate and rate test of a board that is not linear and answers late."""
    plan = make_plan("standard", seed=3, readings=3, states=("estimate_x", "rate_x"))
    url = f"twin:?seed=3&effects=x.scale_factor_cubic.k:{CUBIC};x.time_offset.delay:{AGE}"
    return record(plan, open_rig(url), board="LPY-3")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, session: Recording) -> Path:
    path = tmp_path_factory.mktemp("data")
    with Store(path) as store:
        store.recordings.add(session, board="LPY-3", name="session")
    return path


def recording_in(data: Path) -> str:
    with Store(data) as store:
        return str(store.recordings.find(board="LPY-3")[0][0]["id"])


def saved(data: Path, *effects: str, axis: str = "x") -> dict[str, Any]:
    made = save_model(data, "bent", recording_in(data), axis, effects, "after class")
    with Store(data) as store:
        return store.models.get(made)


def test_a_model_is_kept_with_all_that_it_needs_and_given_out_in_three_forms(data: Path, tmp_path: Path) -> None:
    row = saved(data, "scale_factor_cubic", "time_offset")
    values = {p["name"]: (p["value"], p["standard_uncertainty"]) for p in row["parameters"]}
    value = values["scale_factor_cubic.k"][0]
    assert value == pytest.approx(CUBIC, rel=0.1)
    assert values["time_offset.delay"][0] == pytest.approx(AGE, abs=2e-4)
    assert row["error"]["held_out_rms_dps"] < 1.1 * row["error"]["floor_rms_dps"]
    assert (row["board"], row["effects"], row["note"]) == (
        "LPY-3", ["scale_factor_cubic", "time_offset"], "after class",
    )  # fmt: skip

    volts = np.linspace(0.7, 1.8, 7)
    code: dict[str, Any] = {}
    exec(export_model(data, row["id"], "py"), code)
    told = Compensation.from_json(export_model(data, row["id"], "json"))
    from_python = [code["rate_dps"](volt) for volt in volts.tolist()]
    out = tmp_path / "code.h"
    assert cli.main(["export", row["id"], "--out", str(out), "--data", str(data)]) == 0
    assert out.read_text() == export_model(data, row["id"], "h")
    bias, scale = told.model.bias, told.model.scale_factor
    back = [bias + scale * (rate + value * rate**3) for rate in from_python]
    assert back == pytest.approx(volts.tolist(), abs=1e-9)
    assert told.delay_s == pytest.approx(AGE, abs=2e-4)


def test_a_certificate_by_a_model_states_its_terms_and_is_computed_again(data: Path) -> None:
    row, recording = saved(data, "scale_factor_cubic", "time_offset"), recording_in(data)
    plain = certified(data, recording, None, None)
    better = certified(data, recording, row["id"], None)
    assert better["number"] != plain["number"]
    assert certified(data, recording, row["id"], None)["number"] == better["number"]
    nonlinear = [c["axes"]["x"]["rate"]["nonlinearity_pct_fs"] for c in (plain, better)]
    assert nonlinear[1] < 0.3 * nonlinear[0]
    delays = [c["axes"]["x"]["delay_s"]["value"] for c in (plain, better)]
    assert delays[0] - delays[1] == pytest.approx(AGE, abs=5e-4)
    # A cubic's slope depends on the motion; without the cubic it is the gyro's own.
    truth = board_truth(3, "LPY-3")["x"].scale_factor
    off = [c["axes"]["x"]["scale_factor_V_per_dps"]["value"] / truth - 1.0 for c in (plain, better)]
    assert off[0] < -5e-3
    assert abs(off[1]) < 1e-3

    stated = better["compensation"]
    assert (stated["model"], stated["name"], stated["effects"]) == (row["id"], "bent", row["effects"])
    assert "compensation" not in plain
    for lang in ("en", "th"):
        told = {s["title"]: s["text"] for s in page(better, lang)["statements"]}
        (text,) = (text for text in told.values() if "scale_factor_cubic.k" in text)
        assert "time_offset.delay" in text
    assert b"compensation,x,scale_factor_cubic.k" in render(better, "csv")
    with Store(data) as store:
        assert certify.verify(better, store.recording(recording))["valid"]
        store.models.delete(row["id"])
        assert certify.verify(json.loads(render(better, "json")), store.recording(recording))["valid"]
        with pytest.raises(Problem, match=r"model\.not_found"):
            store.models.get(row["id"])


def test_a_certificate_takes_one_model_an_axis(data: Path) -> None:
    one, other = saved(data, "scale_factor_cubic"), saved(data)
    with pytest.raises(Problem, match=r"compensation\.same_axis"):
        certified(data, recording_in(data), one["id"], None, [other["id"]])
    again = certified(data, recording_in(data), None, None, [one["id"], one["id"]])
    assert again["number"] == certified(data, recording_in(data), one["id"], None)["number"]
    several = {
        **again,
        "compensation": [again["compensation"], {**again["compensation"], "axis": "z", "name": "bent z"}],
    }
    text = next(s["text"] for s in page(several, "en")["statements"] if "scale_factor_cubic.k" in s["text"])
    assert "axis x" in text
    assert "bent z" in text
    assert render(several, "csv").count(b"compensation,") == 2 * len(again["compensation"]["parameters"])


def test_a_model_of_another_board_axis_or_unit_corrects_nothing(data: Path, session: Recording) -> None:
    compensation = compensation_of(saved(data))
    moved = {**session.header, "board": "LPY-4"}
    for code, change, other in (
        ("other_board", {"header": moved}, compensation),
        ("other_axis", {}, replace(compensation, axis="y")),
        ("other_unit", {}, replace(compensation, model=replace(compensation.model, unit="deg/s"))),
    ):
        with pytest.raises(Problem, match=rf"compensation\.{code}"):
            corrected(replace(session, **change), other)
    with pytest.raises(Problem, match=r"diagnosis\.no_axis"):
        saved(data, axis="y")
    with pytest.raises(Problem, match=r"diagnosis\.effect_not_possible"):
        saved(data, "bias_temperature")


def test_the_command_fits_keeps_lists_and_forgets_models(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def said(*words: str) -> tuple[int, str]:
        code = cli.main(["models", *words, "--data", str(data)])
        return code, "".join(capsys.readouterr())

    assert cli.main(["models", "--data", str(tmp_path / "new")]) == 0
    assert "No model is saved" in capsys.readouterr().out
    assert "--recording is missing" in said("--save", "by hand")[1]
    fit = ["--effects", "scale_factor_cubic, time_offset", "--board", "LPY-3", "--note", "n"]
    code, told = said("--save", "by hand", "--recording", recording_in(data), *fit)
    line = next(line for line in told.splitlines() if "by hand" in line)
    assert (code, "LPY-3 x, scale_factor_cubic, time_offset" in line, " deg/s" in line) == (0, True, True)
    made = next(row for row in json.loads(said("--json")[1])["models"] if row["name"] == "by hand")
    assert (made["note"], line.split()[0]) == ("n", made["id"])
    assert "by hand" not in said("--remove", made["id"])[1]
    assert said("--remove", made["id"])[0] == 2
