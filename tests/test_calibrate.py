"""A whole run without a browser: `calibrate`, `certify` and `verify`, from an empty home."""

import gzip
import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from pypdf import PdfReader
from shared import ROOT

from calib_core.recording import read, write_csv
from server import cli
from server.store import Store
from server.store_db import Connection
from server.store_recordings import Recordings
from server.store_runs import Runs

COMMAND = ("calibrate", "--board", "LPY-1", "--readings", "5", "--speed", "max", "--seed", "1", "--operator", "Ada")


def gyrobench(home: Path, *words: str) -> subprocess.CompletedProcess[str]:
    kept = {name: value for name, value in os.environ.items() if name in ("PATH", "LANG")}
    script = "import sys; from server.cli import main; sys.exit(main())"
    return subprocess.run(
        [sys.executable, "-c", script, *words],
        capture_output=True, text=True, cwd=home, env={**kept, "HOME": str(home), "PYTHONPATH": str(ROOT)},
        timeout=120,
    )  # fmt: skip


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def calibrated(home: Path) -> dict[str, Any]:
    """The outcome of the run, in a process of its own with an empty home."""
    done = gyrobench(home, *COMMAND, "--out", str(home / "out"), "--json")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    outcome: dict[str, Any] = json.loads(done.stdout)
    return outcome


def data_of(home: Path) -> str:
    return str(next((home / ".local").rglob("gyrobench.sqlite")).parent)


@pytest.fixture(scope="module")
def exported(home: Path, calibrated: Mapping[str, Any]) -> Path:
    """The run's recording as a file."""
    with Store(data_of(home)) as store:
        recording = store.recording(calibrated["recording"])
    path = home / "LPY-1.csv.gz"
    with gzip.open(path, "wb", compresslevel=1) as file:
        write_csv(recording, file)  # type: ignore[arg-type]
    return path


def test_the_outcome_is_the_contracts_object(calibrated: Mapping[str, Any]) -> None:
    assert calibrated["board"] == "LPY-1"
    assert (calibrated["verdict"], calibrated["error"]) == ("issued", None)
    assert set(calibrated["axes"]) == {"x", "z"}
    for figures in calibrated["axes"].values():
        assert {"bias_V", "scale_factor_V_per_dps", "adaptive", "rate", "position"} <= set(figures)
    assert "session.short_plan" in {warning["code"] for warning in calibrated["warnings"]}
    assert all(warning["sentence"] for warning in calibrated["warnings"])


def test_the_certificate_is_written_in_every_format(calibrated: Mapping[str, Any]) -> None:
    assert set(calibrated["documents"]) == {"pdf", "csv", "json"}
    assert len(PdfReader(calibrated["documents"]["pdf"]).pages) == 2
    content = json.loads(Path(calibrated["documents"]["json"]).read_text(encoding="utf-8"))
    assert content["axes"] == calibrated["axes"]
    assert content["operator"] == "Ada"
    assert not list(Path(calibrated["documents"]["pdf"]).parent.glob(".*"))


def test_certifying_the_exported_recording_gives_the_same_numbers(
    home: Path, calibrated: Mapping[str, Any], exported: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["certify", str(exported), "--out", str(home / "again"), "--data", str(home / "other"), "--json"]
    assert cli.main(words) == 0
    outcome = json.loads(capsys.readouterr().out)
    assert cli.main(words) == 0
    assert json.loads(capsys.readouterr().out) == outcome
    assert outcome["file"] == str(exported)
    assert outcome["axes"] == calibrated["axes"]
    assert outcome["board"] == "LPY-1"


def test_certifying_the_stored_recording_again_gives_the_same_certificate(
    home: Path, calibrated: Mapping[str, Any]
) -> None:
    from server.certify import certify

    with Store(data_of(home)) as store:
        assert certify(store, calibrated["recording"])["number"] == calibrated["certificate"]


def test_a_specification_decides_the_verdict_and_the_exit_code(
    exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for limit, code, verdict in ((2.0, 0, "pass"), (1.0, 1, "fail")):
        spec = tmp_path / "spec.json"
        spec.write_text(json.dumps({"name": "lab", "axes": {"x": {"bias_V": {"max": limit}}}}), encoding="utf-8")
        words = [
            "certify",
            str(exported),
            "--out",
            str(tmp_path),
            "--data",
            str(tmp_path),
            "--spec",
            str(spec),
            "--json",
        ]
        assert cli.main(words) == code
        assert json.loads(capsys.readouterr().out)["verdict"] == verdict


def test_a_certificate_is_verified_from_its_recording_and_a_changed_one_is_not(
    home: Path, calibrated: Mapping[str, Any], exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = ["--data", data_of(home)]
    assert cli.main(["verify", calibrated["documents"]["json"], *data]) == 0
    assert "valid" in capsys.readouterr().out
    content = json.loads(Path(calibrated["documents"]["json"]).read_text(encoding="utf-8"))
    content["axes"]["x"]["bias_V"]["value"] += 1e-8
    content["software"]["version"] = "0.0.1"
    forged = tmp_path / "forged.json"
    forged.write_text(json.dumps(content), encoding="utf-8")
    assert cli.main(["verify", str(forged), *data]) == 1
    _, first, version = capsys.readouterr().out.splitlines()
    path, _, certified, _, computed = first.replace(",", "").split()
    assert path == "axes.x.bias_V.value:"
    assert certified != computed
    assert "0.0.1" in version
    elsewhere = ["--data", str(tmp_path / "empty")]
    assert cli.main(["verify", calibrated["documents"]["json"], *elsewhere]) == 1
    assert "--recording" in capsys.readouterr().out
    assert cli.main(["verify", calibrated["documents"]["json"], *elsewhere, "--recording", str(exported)]) == 0


def test_one_bad_file_among_several_is_told_and_the_others_are_certified(
    exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.csv"
    bad.write_text("time_s,x_gyro_v\n0,1.2\n0.01,1.2\n0.005,1.2\n", encoding="utf-8")
    none = tmp_path / "none.csv"
    words = ["certify", str(bad), str(none), str(exported), "--out", str(tmp_path), "--data", str(tmp_path), "--json"]
    assert cli.main(words) == 1
    said = capsys.readouterr()
    outcomes = [json.loads(line) for line in said.out.splitlines()]
    assert [outcome["verdict"] for outcome in outcomes] == ["error", "error", "issued"]
    assert "4" in outcomes[0]["error"]
    assert "none.csv" in outcomes[1]["error"]
    assert len(said.err.splitlines()) == 2
    assert said.err.count("none.csv") == 1
    with Store(tmp_path) as store:
        assert len(store.recordings.find()[0]) == 1


def test_what_the_sensor_cannot_do_is_refused_before_anything_moves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = ["--data", str(tmp_path), "--out", str(tmp_path)]
    for words, said in (
        (["--board", "LPY 1/../x"], "LPY 1/../x"),
        (["--board", "B", "--states", "rate_x"], "estimate_x"),
        (["--board", "B", "--states", "dance_x"], "dance_x"),
        (["--board", "B", "--profile", "fast"], "fast"),
        (["--board", "B", "--readings", "1"], "3"),
        (["--board", "B", "--gyro-model", "NOPE"], "NOPE"),
        (["--board", "B", "--rig", "nowhere:"], "nowhere"),
        (["--board", "B", "--speed", "0.5"], "0.5"),
        (["--board", "B", "--spec", str(tmp_path / "no.json")], "no.json"),
    ):
        assert cli.main(["calibrate", *words, *data]) in (1, 2), words
        err = capsys.readouterr().err
        assert said in err, words
        assert err.count("\n") == 1
    with Store(tmp_path) as store:
        assert store.runs.find() == ([], None)


def test_the_thesis_profile_runs_to_its_certificate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    states = "estimate_z,rate_z"
    words = ["calibrate", "--board", "T", "--profile", "thesis", "--states", states, "--readings", "3", "--seed", "2"]
    assert cli.main([*words, "--data", str(tmp_path), "--out", str(tmp_path), "--lang", "th"]) == 0
    out = capsys.readouterr().out
    assert "สเกลแฟกเตอร์" in out
    content = json.loads(next(tmp_path.glob("*.json")).read_text(encoding="utf-8"))
    assert content["profile"] == "thesis"
    assert list(content["states"]) == states.split(",")


def test_the_exported_recording_names_what_it_was_made_with(exported: Path) -> None:
    with exported.open("rb") as file:
        header = read(file, name=exported.name).header
    assert header["profile"] == "standard"
    assert header["seed"] == "1"
    assert json.loads(header["gyro_model"])["id"] == "LPY503AL-OUT"


def test_a_full_disk_is_told_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(store: Connection) -> None:
        store.db.execute(f"pragma max_page_count = {store.db.execute('pragma page_count').fetchone()[0]}")

    create = Runs.create
    monkeypatch.setattr(Runs, "create", lambda runs, **given: (create(runs, **given), full(runs._at))[0])
    words = ["calibrate", "--board", "S", "--readings", "3", "--data", str(tmp_path), "--out", str(tmp_path)]
    assert cli.main(words) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("The disk is full")
    assert said.err.count("\n") == 1


def test_ctrl_c_stops_the_run_keeps_its_samples_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # what starts the tests may have it ignored
    compact = Recordings.compact
    monkeypatch.setattr(Recordings, "compact", lambda *a: (signal.raise_signal(signal.SIGINT), compact(*a))[1])
    words = ["calibrate", "--board", "S", "--readings", "3", "--data", str(tmp_path), "--out", str(tmp_path), "--json"]
    assert cli.main(words) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["verdict"] == "error"
    assert said.err.count("\n") == 1
    with Store(tmp_path) as store:
        [run] = store.runs.find()[0]
        assert run["status"] == "stopped"
        assert len(store.recording(run["recording"])) > 10_000
        assert store.certificates.find() == ([], None)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
