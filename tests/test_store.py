"""The store: what is written is there, whole or not at all, and certificates never change."""

import multiprocessing
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib_core.gyro_models import PRESETS, GyroModel
from calib_core.problem import Problem
from calib_core.recording import Recording
from server.settings import data_dir
from server.store import Store
from server.store_db import FILE


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path)


def rows(start_s: float, n: int = 100, segment: str = "estimate_x") -> Recording:
    time_s = np.round(start_s + np.arange(n) / 100, 6)
    columns = {
        "x_gyro_v": np.round(1.25 + 0.2 * np.sin(time_s), 6),
        "x_position_deg": np.where(np.arange(n) % 2, np.nan, np.round(np.arange(n) * 300 / 1023, 4)),
    }
    return Recording(time_s, columns, np.zeros(n, np.int32), (segment,))


def recording(store: Store, blocks: int = 5, **more: Any) -> str:
    made = store.recordings.create(board="LPY-1", name="LPY-1", source="run", header={"format": "gyro-recording 1"})
    for i in range(blocks):
        store.recordings.append(made, rows(float(i)), state="estimate_x", **more)
    return made


def content(recording: str, **more: Any) -> dict[str, Any]:
    return {
        "board": "LPY-1", "recording": {"id": recording}, "gyro_model": {"id": "M"}, "spec": None, "verdict": "issued",
        "software": {"version": "1"}, "operator": "Ann", **more,
    }  # fmt: skip


# --- recordings ------------------------------------------------------------------------------------------------
def test_blocks_come_back_as_one_recording_before_and_after_compacting(store: Store) -> None:
    made = recording(store)
    before = store.recording(made)
    store.recordings.compact(made, "estimate_x")
    after = store.recording(made)
    assert len(before) == 500
    assert before.digest() == after.digest() == Recording.join([rows(float(i)) for i in range(5)]).digest()
    assert store.connection.rows("select count(*) as n from blocks")[0]["n"] == 1
    store.recordings.seal(made, after)
    assert store.recordings.row(made)["samples"] == 500


def test_fast_samples_stay_out_of_the_rows(store: Store) -> None:
    made = recording(store)
    store.recordings.append(made, rows(0.0, 10), state="estimate_x", kind="fast")
    assert len(store.recording(made)) == 500
    assert len(store.recordings.load(made, kind="fast")) == 10


def test_kept_states_are_copied_and_new_rows_come_after_them(store: Store) -> None:
    made = recording(store)
    store.recordings.append(made, rows(10.0, segment="rate_x/linearity/+60/1"), state="rate_x")
    copy = store.recordings.create(board="LPY-1", name="copy", source="run", header={})
    store.recordings.copy_states(made, copy, ["rate_x"])
    assert store.recordings.states(copy) == ["rate_x"]
    assert store.recordings.end_s(copy) == 10.99
    store.recordings.append(copy, rows(12.0), state="estimate_x")
    assert store.recording(copy).segment_names == ("rate_x/linearity/+60/1", "estimate_x")


def test_what_is_not_there_is_refused(store: Store) -> None:
    for code, ask in {
        "recording.not_found": lambda: store.recording("none"),
        "recording.empty": lambda: store.recording(recording(store, blocks=0)),
        "run.not_found": lambda: store.runs.get("none"),
        "board.not_found": lambda: store.boards.get("none"),
        "gyro_model.not_found": lambda: store.gyro_models.get("none"),
        "certificate.not_found": lambda: store.certificates.get("none"),
    }.items():
        with pytest.raises(Problem) as refused:
            ask()
        assert refused.value.code == code


# --- certificates ----------------------------------------------------------------------------------------------
def test_certificates_are_numbered_in_order_and_the_same_content_keeps_its_number(store: Store) -> None:
    first = store.issue_certificate(content("a"))
    assert store.issue_certificate(content("a", operator="Bo"))["number"] == first["number"]
    assert store.certificates.get(first["number"])["operator"] == "Ann"
    numbers = [store.issue_certificate(content("a", spec={"n": i}))["number"] for i in range(3)]
    assert [int(number.rsplit("-", 1)[1]) for number in [first["number"], *numbers]] == [1, 2, 3, 4]
    assert store.issue_certificate(content("a", software={"version": "2"}))["number"] not in numbers


@pytest.mark.parametrize("statement", ["update certificates set verdict = 'pass'", "delete from certificates"])
def test_a_certificate_cannot_be_changed_even_by_hand(store: Store, tmp_path: Path, statement: str) -> None:
    store.issue_certificate(content("a"))
    with sqlite3.connect(tmp_path / FILE) as by_hand, pytest.raises(sqlite3.IntegrityError, match="never changed"):
        by_hand.execute(statement)


def test_a_certificate_is_on_disk_when_it_is_issued_and_samples_need_not_wait(store: Store) -> None:
    said: list[str] = []
    store.connection.raw.set_trace_callback(said.append)
    recording(store, blocks=2)
    store.issue_certificate(content("a"))
    store.connection.raw.set_trace_callback(None)
    begun = [i for i, sql in enumerate(said) if sql == "begin immediate"]
    full = [i for i, sql in enumerate(said) if sql == "pragma synchronous = full"]
    assert len(begun) == 4, "one transaction for the recording, each block, and the certificate"
    assert full == [begun[-1] - 1]
    assert store.connection.rows("pragma synchronous")[0]["synchronous"] == 1
    assert store.connection.rows("pragma journal_mode")[0]["journal_mode"] == "wal"


def _issue(data: Path, name: str) -> str:
    with Store(data) as store:
        return str(store.issue_certificate(content(name))["number"])


def test_two_processes_never_give_one_number_twice(tmp_path: Path) -> None:
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        numbers = pool.starmap(_issue, [(tmp_path, f"r{i}") for i in range(12)])
    assert len(set(numbers)) == 12


def test_a_recording_that_nobody_sealed_is_counted_as_it_stands(store: Store) -> None:
    made = recording(store)
    shown = store.recordings.row(made)
    assert (shown["samples"], shown["duration_s"], shown["digest"]) == (500, 4.99, None)
    assert store.recordings.find()[0][0]["samples"] == 500
    empty = store.recordings.create(board="LPY-1", name="LPY-1", source="run", header={})
    assert (store.recordings.row(empty)["samples"], store.recordings.row(empty)["duration_s"]) == (0, 0.0)


@pytest.mark.parametrize("wanted", [{"board": "LPY-1"}, {"q": "LPY"}, {"cursor": "7"}])
def test_a_list_of_certificates_reads_indexes_and_never_all_of_the_table(store: Store, wanted: dict[str, str]) -> None:
    store.issue_certificate(content("a"))
    asked: list[str] = []
    store.connection.raw.set_trace_callback(asked.append)
    store.certificates.find(**wanted)
    store.connection.raw.set_trace_callback(None)
    (plan,) = [store.connection.rows(f"explain query plan {sql}") for sql in asked]
    steps = [row["detail"] for row in plan if row["detail"].startswith("SCAN certificates")]
    assert all("USING COVERING INDEX" in step for step in steps), plan


# --- faults ----------------------------------------------------------------------------------------------------
def test_a_full_disk_is_a_sentence_and_leaves_no_half_row(store: Store) -> None:
    made = recording(store)
    before = store.recording(made).digest()
    pages = store.connection.rows("pragma page_count")[0]["page_count"]
    store.connection.db.execute(f"pragma max_page_count = {pages + 2}")

    def fill() -> None:
        for i in range(5, 1000):
            store.recordings.append(made, rows(float(i)), state="estimate_x")

    with pytest.raises(Problem) as refused:
        fill()
    assert refused.value.code == "store.full"
    store.connection.db.execute("pragma max_page_count = 1000000")
    assert store.recording(made).duration_s > 4.9
    store.recordings.append(made, rows(2000.0), state="estimate_x")
    assert store.recording(made).digest() != before


def test_a_transaction_that_fails_leaves_nothing(store: Store) -> None:
    def fail() -> None:
        with store.connection.write():
            store.boards.add("LPY-1", gyro_model="LPY503AL-OUT")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert store.boards.find() == ([], None)


def test_a_directory_that_cannot_be_a_store_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(Problem, match=r"store\.cannot_open"):
        Store(tmp_path / "file")
    (tmp_path / FILE).write_bytes(b"not a database" * 1000)
    with pytest.raises(Problem, match=r"store\.not_a_store"):
        Store(tmp_path)


def test_open_runs_are_marked_as_interrupted_and_keep_their_samples(store: Store) -> None:
    made = recording(store)
    run = store.runs.create(
        board="LPY-1", gyro_model="M", profile="standard", recording=made, request={}, plan={}, states=["estimate_x"]
    )
    store.runs.start(run)
    store.runs.set_state(run, "estimate_x", "running")
    assert store.runs.interrupt_open() == [run]
    row = store.runs.get(run)
    assert (row["status"], row["message"]["code"]) == ("interrupted", "run.interrupted")
    assert row["states"] == [{"name": "estimate_x", "status": "failed"}]
    assert len(store.recording(made)) == 500
    assert store.runs.interrupt_open() == []


def test_a_run_of_another_program_that_lives_is_left_alone(store: Store, tmp_path: Path) -> None:
    script = (
        "import sys; from server.store import Store; store = Store(sys.argv[1]);"
        "made = store.recordings.create(board='B', name='B', source='run', header={});"
        "print(store.runs.create(board='B', gyro_model='M', profile='standard', recording=made, request={}, plan={},"
        " states=[]), flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        run = other.stdout.readline().strip()
        assert store.runs.interrupt_open() == []
        assert store.runs.get(run)["status"] == "queued"
        other.kill()
    assert store.runs.interrupt_open() == [run]


# --- boards, models, lists -------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["", "LPY/1", "../LPY", "a b", "ก", "-x", "x" * 65, "a\n", "\N{GRINNING FACE}"])
def test_board_ids_with_other_characters_are_refused(store: Store, name: str) -> None:
    with pytest.raises(Problem, match=r"board\.characters"):
        store.boards.add(name, gyro_model="LPY503AL-OUT")


def test_lists_give_pages_newest_first(store: Store) -> None:
    for i in range(7):
        store.boards.add(f"B{i}", gyro_model="M", note="50% off_" if i == 3 else "")
    seen, cursor = [], None
    while True:
        page, cursor = store.boards.find(limit=3, cursor=cursor)
        seen.append([board["id"] for board in page])
        if cursor is None:
            break
    assert seen == [["B6", "B5", "B4"], ["B3", "B2", "B1"], ["B0"]]
    assert [board["id"] for board in store.boards.find(q="50% off_")[0]] == ["B3"]
    assert store.boards.find(q="50_ off")[0] == []
    with pytest.raises(Problem, match=r"request\.cursor"):
        store.boards.find(cursor="; drop")


def test_gyro_models_keep_what_was_given(store: Store) -> None:
    given = {"id": "MINE", "axes": {"x": {"bias_V": 1.0, "scale_factor_V_per_dps": 0.01, "range_dps": 90.0}}}
    model = GyroModel.from_json({**given, "ranges": {"x": {"rate_dps": 50.0}}})
    store.gyro_models.save(model, new=True)
    assert store.gyro_models.get("MINE") == model
    assert [kept.id for kept in store.gyro_models.find()] == [*PRESETS, "MINE"]
    store.boards.add("B", gyro_model="MINE")
    with pytest.raises(Problem, match=r"gyro_model\.in_use"):
        store.gyro_models.delete("MINE")


def test_the_data_directory_is_the_option_then_the_environment_then_the_platforms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GYROBENCH_DATA", str(tmp_path / "env"))
    assert data_dir(tmp_path / "option") == tmp_path / "option"
    assert data_dir() == tmp_path / "env"
    monkeypatch.delenv("GYROBENCH_DATA")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "local"))
    for platform, part in {"linux": "xdg", "win32": "local", "darwin": "Library"}.items():
        monkeypatch.setattr("sys.platform", platform)
        assert part in data_dir().parts
        assert data_dir().name.lower() == "gyrobench"
