"""`gyrobench import` and `gyrobench export`: foreign columns in, recordings out, nothing half-written."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import csv_bytes, csv_lines

from calib_core.recording import Recording, read
from server.bench.gap_records import record
from server.cli import main
from server.recording_files import save
from server.store import Store

FOREIGN = "t,gx,angle,what"
MAP = ["--map", "t=time_s", "--map", "gx=x_gyro_v", "--map", "angle=x_position_deg", "--map", "what=segment"]


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    path = tmp_path / "imu.csv"
    path.write_bytes(csv_bytes([FOREIGN, *csv_lines()[2:]]))
    return path


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main([str(word) for word in words])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_a_foreign_file_goes_into_the_store_and_out_again(
    foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "lab"
    code, out, _ = run(capsys, "import", foreign, *MAP, "--board", "IMU-1", "--data", data, "--json")
    told = json.loads(out)
    expected = read(csv_bytes(csv_lines()))
    assert (code, told["board"], told["samples"], told["axes"]) == (0, "IMU-1", 210, ["x"])
    assert told["digest"] == expected.digest()
    for name in ("run.csv", "run.csv.gz", "run.parquet"):
        code, out, _ = run(capsys, "export", told["recording"], "--out", tmp_path / name, "--data", data, "--json")
        assert (code, json.loads(out)["files"]) == (0, [str(tmp_path / name)])
        back = read((tmp_path / name).read_bytes())
        assert back.digest() == expected.digest()
        assert back.header["board"] == "IMU-1"


def test_samples_at_1_khz_are_exported_beside_the_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = read(csv_bytes(csv_lines()))
    fast = Recording(
        recording.time_s / 10, {"x_gyro_v": recording.columns["x_gyro_v"]}, recording.segment_codes, ("hold",)
    )
    with Store(tmp_path) as store:
        store.boards.ensure("B", gyro_model="LPY503AL-OUT")
        kept = store.recordings.add(recording, board="B", name="run")
        store.recordings.append(kept, fast, state="estimate_x", kind="fast")
    code, *_ = run(capsys, "export", kept, "--out", tmp_path / "run.csv.gz", "--data", tmp_path)
    assert code == 0
    assert (tmp_path / "run.fast.csv.gz").exists()


def test_a_file_is_converted_without_a_store(foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mapped, again = tmp_path / "mapped.parquet", tmp_path / "new" / "again.csv"
    code, out, _ = run(capsys, "import", foreign, *MAP, "--header", "reference=stationary", "--out", mapped)
    assert code == 0
    assert "210 rows" in out
    assert read(mapped.read_bytes()).stationary
    code, out, _ = run(capsys, "export", mapped, "--out", again, "--lang", "th")
    assert code == 0
    assert "210 แถว" in out
    assert read(again.read_bytes()).digest() == read(mapped.read_bytes()).digest()


def test_columns_of_text_are_left_out_and_named(
    foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = run(capsys, "import", foreign, *MAP[:4], "--out", tmp_path / "out.csv")
    assert code == 0
    assert out.rstrip().endswith("what")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["imu.csv", "--map", "gx"], "--map takes two words joined by ="),
        (["imu.csv", "--map", "gyro=x_gyro_v"], "The mapping names column gyro"),
        (["imu.csv", *MAP, "--out", "run.xlsx"], "run.xlsx: the ending says what to write; allowed are .csv, .csv.gz"),
        (["imu.csv", "imu.csv", *MAP, "--out", "run.csv"], "--out takes one recording and 2 were given"),
        (["imu.csv"], "there is no column time_s"),
        (["absent.csv"], "absent.csv: No such file"),
    ],
)
def test_bad_use_is_told_in_one_sentence(
    words: list[str], sentence: str, foreign: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(foreign.parent)
    code, out, err = run(capsys, "import", *words)
    assert (code, out) == (2, "")
    assert sentence in err
    assert err.count("\n") == 1


def test_an_unknown_recording_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "export", "none", "--out", tmp_path / "run.csv", "--data", tmp_path)
    assert code == 2
    assert "none" in err
    assert not (tmp_path / "run.csv").exists()


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.csv.gz"
    recording = read(csv_bytes(csv_lines()))
    save(recording, path)
    before = path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("server.recording_files.write_csv", full)
    with pytest.raises(OSError, match="No space left"):
        save(recording, path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    monkeypatch.undo()
    save(recording, path)
    assert path.read_bytes() == before


@pytest.fixture(scope="module")
def warm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a gyro whose zero moves with temperature, with its true rate."""
    made = record(3, {"bias_temperature": 2.0}, reference="rate")
    names = tuple(dict.fromkeys(made.segments))
    columns = dict(made.columns)
    codes = np.array([names.index(name) for name in made.segments], np.int32)
    path = tmp_path_factory.mktemp("warm") / "warm.csv"
    save(Recording(columns.pop("time_s"), columns, codes, names, {"board": "W-1"}), path)
    return path


def test_the_model_of_a_recording_compensates_as_python_json_and_c(
    warm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = {ending: tmp_path / f"gyro{ending}" for ending in (".py", ".json", ".h")}
    code, out, _ = run(capsys, "export", warm, "--out", paths[".py"])
    assert code == 0
    assert "bias_temperature" in out
    room: dict[str, Any] = {}
    exec(paths[".py"].read_text(encoding="utf-8"), room)
    recording = read(warm.read_bytes())
    rate, volts = recording.columns["x_rate_dps"], recording.columns["x_gyro_v"]
    error = (
        np.array([room["rate_dps"](v, t) for v, t in zip(volts, recording.columns["temperature_c"], strict=True)])
        - rate
    )
    plain = (volts - np.polynomial.Polynomial.fit(rate, volts, 1)(rate)) / room["SCALE_FACTOR"]
    noise = 1.25e-3 / room["SCALE_FACTOR"]
    assert np.std(error) < 1.01 * noise < 1.1 * noise < np.std(plain)

    code, out, _ = run(capsys, "export", warm, "--out", paths[".json"], "--json")
    assert json.loads(out)["effects"] == ["bias_temperature"]
    code, *_ = run(capsys, "export", paths[".json"], "--out", paths[".h"])
    assert code == 0
    assert "gyro_x_rate_dps(GYRO_REAL output_V, GYRO_REAL temperature_c)" in paths[".h"].read_text(encoding="ascii")
    code, out, _ = run(capsys, "export", warm, "--effects", "", "--out", tmp_path / "base.json", "--json")
    assert json.loads(out)["effects"] == []


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["warm.csv", "--out", "gyro.exe"], "allowed are .csv, .csv.gz, .parquet, .json, .h, .py"),
        (["warm.csv", "--axis", "z", "--out", "gyro.h"], "Axis z"),
        (["warm.csv", "--effects", "magic", "--out", "gyro.h"], "magic"),
        (["short.csv", "--out", "gyro.h"], "has no fitted model to export. The recording holds"),
        (["odd.json", "--out", "gyro.h"], "This is no compensation"),
    ],
)
def test_a_model_that_cannot_be_exported_is_told_in_one_sentence(
    words: list[str],
    sentence: str,
    warm: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "warm.csv").symlink_to(warm)
    (tmp_path / "short.csv").write_bytes(csv_bytes(csv_lines(300)))
    (tmp_path / "odd.json").write_text("[1]", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, "export", *words)
    assert (code, out) == (2, "")
    assert sentence in err
    assert err.count("\n") == 1
    assert not (tmp_path / "gyro.h").exists()
