"""What the model is missing, told: sentences, digits, both languages, the command and the API."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from running import Server
from shared import ROOT

from calib_core import points
from calib_core.effects import library
from calib_core.recording import write_csv
from server import cli, diagnosis, untested
from server.bench.gap_campaign import as_recording
from server.bench.gap_records import record
from server.texts import LANGUAGES, texts

KEYS = {
    "recording", "axis", "unit", "verdict", "sentence", "code", "values", "checks", "model", "noise", "error",
    "where_it_fails", "missing", "rivals", "rival_sets", "candidates", "unknown", "next_experiment", "after",
}  # fmt: skip
"""CONTRACT 3."""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a minute of one sine with a lag in it, which one frequency cannot tell from a delay."""
    path = tmp_path_factory.mktemp("gap") / "sine.csv"
    with path.open("wb") as opened:
        whole = as_recording(record(3, {"bandwidth_lag": 2.0}, plan="sine"))
        write_csv(whole.take(whole.time_s < 35.0), opened)
    return path


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    running = Server(tmp_path_factory.mktemp("data"))
    yield running
    running.close()


def answer(**parts: Any) -> dict[str, Any]:
    """An answer as the core gives it, before anything is told."""
    empty: dict[str, Any] = {
        "recording": {"file": "a.csv", "board": "B", "samples": 100, "duration_s": 1.0}, "axis": "x", "unit": "V",
        "verdict": "adequate", "checks": [], "model": {"effects": [], "parameters": []}, "noise": None,
        "error": {"held_out_rms_dps": 0.1724, "floor_rms_dps": 0.0428, "holdout": {"block_s": 1.0, "blocks": 8}},
        "where_it_fails": [], "missing": [], "rivals": [], "rival_sets": [], "candidates": [], "unknown": None,
        "next_experiment": None, "after": {"effects": [], "held_out_rms_dps": 0.0431, "parameters": []},
        "code": "diagnosis.adequate", "values": {},
    }  # fmt: skip
    return empty | parts


def said(lang: str = "en", **parts: Any) -> dict[str, Any]:
    return diagnosis.told(diagnosis.explained(answer(**parts)), lang)


def found(name: str, p: float = 1e-30) -> dict[str, Any]:
    return {"effect": name, "two_delta_lnL": 100.0, "p": p, "parameters": []}


def fails(covariate: str, low: float, high: float, residual: float, z: float = 40.0) -> str:
    row = {"covariate": covariate, "from": low, "to": high, "residual_dps": residual, "z": z}
    return str(said(where_it_fails=[row])["where_it_fails"][0]["sentence"])


def test_where_the_model_fails_is_told_with_the_digits_that_are_known() -> None:
    assert fails("temperature_c", 35.98, 38.11, 0.4196) == "The model reads 0.42 deg/s low between 36 and 38.1 °C."
    assert fails("x_rate_dps", -100.05, -50.05, -0.2456) == (
        "The model reads 0.25 deg/s high at rates of x from -100 to -50 deg/s."
    )
    assert fails("time_s", 48.49, 64.0, 0.3345) == "The model reads 0.33 deg/s low from 48 to 64 s into the recording."
    assert fails("x_rate_dps", 0.0, 0.0009, 0.0633) == "The model reads 0.063 deg/s low while x does not turn."
    assert "while the other axis stands still" in fails("other_rate_dps", 0.0, 0.0, 0.2)


@pytest.mark.parametrize("lang", LANGUAGES)
@pytest.mark.parametrize(
    "covariate", [*diagnosis.KINDS, "x_rate_dps", "z_position_deg", "y_acceleration_dps2", "humidity"]
)
def test_every_covariate_has_words(covariate: str, lang: str) -> None:
    row = {"covariate": covariate, "from": 1.0, "to": 9.0, "residual_dps": 0.5, "z": 9.0}
    told = said(lang, verdict="unknown", where_it_fails=[row], unknown={"covariate": covariate, "p": 1e-9})
    for sentence in (told["sentence"], told["where_it_fails"][0]["sentence"]):
        assert "{" not in sentence
        assert "diagnosis." not in sentence


def test_verdicts_are_words_that_say_evidence_and_limits() -> None:
    plain = said(error={"held_out_rms_dps": 0.0431, "floor_rms_dps": 0.0428, "holdout": {}})
    assert plain["sentence"].startswith("The model explains this recording")
    assert "noise alone makes 0.043" in plain["sentence"]
    above = said()
    assert above["sentence"].startswith("Nothing that is missing stands out")
    assert [limit["code"] for limit in above["limits"]] == ["diagnosis.limit.above_floor"]

    two = said(verdict="missing", missing=[found("bias_temperature"), found("scale_factor_cubic", 1e-6)])
    assert "lacks bias that follows temperature and cubic scale factor" in two["sentence"]
    assert "falls from 0.172 to 0.043 deg/s" in two["sentence"]
    certain, likely = (finding["sentence"] for finding in two["missing"])
    assert certain.startswith("Certain: bias that follows temperature.")
    assert likely.startswith("Very likely: cubic scale factor.")
    assert "1000000 recordings" in likely

    tied = said(
        verdict="ambiguous", missing=[found("time_offset")], rivals=[["time_offset", "bandwidth_lag"]],
        candidates=[{"effect": "cross_axis", "status": "not_excited"}, {"effect": "my_own", "status": "no_data"}],
    )  # fmt: skip
    assert "delay between gyro and encoder or lag of the sensor" in tied["sentence"]
    limits = [limit["sentence"] for limit in tied["limits"]]
    assert "cannot tell delay between gyro and encoder and lag of the sensor apart" in limits[0]
    assert limits[1].endswith("sensitivity to the other axis.")
    assert limits[2].endswith("my_own.")


def test_a_model_that_explains_its_recording_says_what_was_not_tested_and_why() -> None:
    reach = {
        "rate_dps": 47.123, "low_deg": -30.02, "high_deg": 30.01,
        "temperature_degC": 0.0213, "supply_mV": None, "duration_s": 68.0,
    }  # fmt: skip
    names = {"bias_temperature": "not_excited", "scale_factor_cubic": "not_excited", "supply_sensitivity": "no_data"}
    rows = [{"effect": name, "status": status} for name, status in {**names, "input_loading": "no_data"}.items()]
    error = {"held_out_rms_dps": 0.043, "floor_rms_dps": 0.0428}
    told = said(reach=reach, error=error, candidates=[*rows, {"effect": "bias_drift", "status": "tested"}])
    assert told["sentence"].endswith(
        "Effects that it could not test: 3, because the temperature moved only by 0.021 °C, the supply was not "
        "recorded, nothing turned faster than 47 deg/s."
    )
    assert "could not" not in said(reach=reach, error=error, candidates=[rows[-1]])["sentence"]


def test_every_effect_that_a_motion_can_show_has_a_reason_where_it_did_not() -> None:
    told = {name for names in untested.TOLD_BY.values() for name in names}
    assert told == set(library()) - {*untested.NEVER}
    for name in (*untested.TOLD_BY, "other"):
        parts = ("", "no_") if name in (*untested.RECORDED, "other") else ("",)
        assert all(f"untested.{part}{name}" in texts("th") for part in parts)


def test_no_p_value_is_in_a_sentence() -> None:
    told = said(verdict="missing", missing=[found("dead_band", 3e-7)], unknown=None)
    text = " ".join([told["sentence"], *(part["sentence"] for part in told["missing"])])
    assert "e-0" not in text
    assert "p =" not in text


def test_what_is_no_number_is_null() -> None:
    told = diagnosis.plain({"a": float("nan"), "b": [float("inf"), 1.5], "c": (True, None, "x")})
    assert told == {"a": None, "b": [None, 1.5], "c": [True, None, "x"]}


# --- the command -------------------------------------------------------------------------------------------------
def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    code = cli.main(["diagnose", *words])
    out, err = capsys.readouterr()
    return code, out, err


def test_the_command_prints_one_json_object_an_input(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    readings = ROOT / "calib_core" / "thesis" / "data" / "rate.csv"
    code, out, err = run(capsys, "--json", "--axis", "x", str(file), str(readings))
    first, *boards = (json.loads(line) for line in out.splitlines())
    assert (code, err) == (0, "")
    assert [(told["recording"]["board"], told["axis"]) for told in boards] == [("1", "x"), ("2", "x")]
    assert set(first) >= KEYS
    assert first["recording"]["file"] == "sine.csv"
    assert first["verdict"] == "ambiguous"
    assert {"bandwidth_lag", "time_offset"} <= set(first["rivals"][0])
    assert all(check["sentence"] for check in first["checks"])


def test_the_command_tells_it_in_words(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, str(file), "--lang", "th")
    assert code == 0
    assert "บอกไม่ได้" in out
    assert "ความหน่วงของเซนเซอร์" in out
    assert "V/(deg/s)" in out


def test_a_model_that_is_given_is_the_one_that_is_judged(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "--json", "--effects", "bandwidth_lag", str(file))
    told = json.loads(out)
    assert code == 0
    assert told["model"]["effects"] == ["bandwidth_lag"]
    assert any(parameter["name"] == "bandwidth_lag.tau" for parameter in told["model"]["parameters"])
    assert told["verdict"] == "adequate"
    # 70 windows that overlap by half: their RMS is known to a tenth.
    assert told["error"]["held_out_rms_dps"] == pytest.approx(told["error"]["floor_rms_dps"], rel=0.25)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--axis", "z"], "Axis z is not in this recording; it has x."),
        (["--effects", "magic"], 'There is no effect "magic"'),
        (["--effects", "saturation"], '"saturation" cannot be put into the model'),
    ],
)
def test_what_cannot_be_asked_is_refused(
    file: Path, words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = run(capsys, str(file), *words)
    assert (code, out) == (2, "")
    assert err.startswith(sentence)


# --- the API -----------------------------------------------------------------------------------------------------
def test_the_api_gives_what_the_command_gives(server: Server, file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = server.client.post("/recordings", files={"file": ("sine.csv", file.read_bytes())}).json()["id"]
    posted = server.client.post(
        f"/recordings/{recording}/diagnosis", json={"axis": "x"}, headers={"Accept-Language": "th"}
    )
    assert posted.status_code == 200, posted.text
    told, printed = posted.json(), json.loads(run(capsys, "--json", "--lang", "th", str(file))[1])
    assert told.keys() == printed.keys()
    for part in ("recording", "sentence", "checks", "rivals", "limits"):
        assert told[part] == printed[part]
    assert told["after"]["held_out_rms_dps"] == pytest.approx(printed["after"]["held_out_rms_dps"])
    refused = server.client.post(f"/recordings/{recording}/diagnosis", json={"effects": ["magic"]})
    assert (refused.status_code, refused.json()["code"]) == (422, "diagnosis.no_such_effect")
    assert server.client.post("/recordings/none/diagnosis", json={}).status_code == 404


def test_the_api_keeps_points_and_diagnoses_one_board_and_axis(server: Server) -> None:
    shipped = (ROOT / "calib_core" / "thesis" / "data" / "position.csv").read_bytes()
    kept = server.client.post("/recordings", files={"file": ("position.csv", shipped)}).json()
    assert (kept["header"]["format"], kept["samples"]) == ("gyro-points 1", 992)
    where = f"/recordings/{kept['id']}"
    again = points.read(server.client.get(f"{where}.csv").content)
    assert again.gyro.tolist() == points.read(shipped).gyro.tolist()
    said = server.client.post(f"{where}/diagnosis", json={"board": "2", "axis": "x"}).json()
    assert {"bias_step", "scale_factor_asymmetry"} <= set(said["rivals"][0])
    assert "held_out_rms_deg" in said["error"]
    refused = server.client.post(f"{where}/diagnosis", json={"board": "3"})
    assert (refused.status_code, refused.json()["code"]) == (422, "diagnosis.no_board")
    assert server.client.post("/certificates", json={"recording": kept["id"]}).json()["code"] == "recording.is_points"


def test_the_api_tells_of_every_effect_in_the_language_asked_for(server: Server) -> None:
    from calib_core.effects import library

    english = server.client.get("/effects").json()["items"]
    thai = server.client.get("/effects", headers={"Accept-Language": "th"}).json()["items"]
    assert [effect["name"] for effect in english] == [effect["name"] for effect in thai] == list(library())
    for ours, theirs in zip(english, thai, strict=True):
        assert ours["equation"] == theirs["equation"]
        assert ours["summary"] != theirs["summary"]
        assert ours["title"] != theirs["title"]
        assert ours["parameters"], ours["name"]


def test_the_recording_of_a_gyro_that_never_moved_is_not_testable() -> None:
    """Refusals come as answers too: the sentence says what is wrong and what to do."""
    still = as_recording(record(1, {}, plan="sine"))
    told = diagnosis.told(diagnosis.of_recording(still.take(still.time_s < 2.5)), "en")
    assert told["verdict"] == "not_testable"
    assert told["after"] is None
    assert len(told["sentence"]) > 40
