"""Batches over HTTP, as a page or a script uses them: every file has its own end, whatever happens to the others."""

import csv
import io
import os
import re
import signal
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from recordings import to_csv, to_parquet
from sessions import session_recording
from shared import ROOT

from server import batch_work
from server.app import create_app
from server.batch_engine import file_of, forget
from server.commands.serve import listen
from server.settings import Settings
from server.store import Store

PATIENCE_S = 120.0


class Lab:
    """A server's routes and its batch process, without the bench."""

    def __init__(self, data: Path) -> None:
        app = create_app(Settings(data))
        self.services = app.state.services
        listener = listen("127.0.0.1", 0)
        self.address = f"http://127.0.0.1:{listener.getsockname()[1]}"
        self.server = uvicorn.Server(uvicorn.Config(app, lifespan="off", log_level="error"))
        self.thread = threading.Thread(target=self.server.run, args=([listener],))
        self.thread.start()
        self.http = httpx.Client(base_url=f"{self.address}/api/v1", timeout=PATIENCE_S)

    def send(self, *files: tuple[str, bytes], key: str = "", **fields: str) -> Any:
        headers = {"Idempotency-Key": key} if key else {}
        return self.http.post("/batches", files=[("files", file) for file in files], data=fields, headers=headers)

    def batch(self, batch: str) -> dict[str, Any]:
        shown: dict[str, Any] = self.http.get(f"/batches/{batch}").json()
        return shown

    def files(self, batch: str) -> list[dict[str, Any]]:
        items = self.http.get(f"/batches/{batch}/files").json()["items"]
        return sorted(items, key=lambda file: int(file["position"]))

    def until(self, batch: str, ready: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        limit = time.monotonic() + PATIENCE_S
        while not ready(shown := self.batch(batch)):
            assert time.monotonic() < limit, shown
            time.sleep(0.05)
        return shown

    def ended(self, batch: str) -> dict[str, Any]:
        return self.until(batch, lambda shown: shown["finished_at"])

    def close(self) -> None:
        self.http.close()
        self.server.should_exit = True
        self.thread.join()
        self.services.batches.close()
        self.services.compute.close()
        self.services.store.close()


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    before, os.environ["GYROBENCH_WORKERS"] = os.environ.get("GYROBENCH_WORKERS"), "1"
    lab = Lab(tmp_path_factory.mktemp("data"))
    yield lab
    lab.close()
    os.environ.pop("GYROBENCH_WORKERS") if before is None else os.environ.update(GYROBENCH_WORKERS=before)


def board(name: str, kind: Callable[..., bytes] = to_parquet) -> bytes:
    whole = session_recording(states=("estimate_x",))
    return kind(replace(whole, header={**whole.header, "board": name}))


def test_a_batch_goes_on_where_it_was_when_its_process_is_killed(lab: Lab) -> None:
    """Must be the first: it starts the process, and leaves the next tests the one that took over."""
    sent = lab.send(*((f"K{i}.parquet", board(f"K{i}")) for i in range(3)))
    assert sent.status_code == 201
    batch = sent.json()["id"]
    lab.until(batch, lambda shown: shown["status"] == "running")
    first = lab.services.batches.pid
    os.kill(first, signal.SIGKILL)
    assert lab.ended(batch)["verdicts"] == {"issued": 3}
    assert lab.services.batches.pid != first
    assert [file["board"] for file in lab.files(batch)] == ["K0", "K1", "K2"]


@pytest.fixture(scope="module")
def mixed(lab: Lab) -> dict[str, Any]:
    """One board in three forms, another, and three files that are none."""
    rows = session_recording(states=("estimate_x",))
    sent = lab.send(
        ("A.csv", board("A", to_csv)),
        ("again.csv", board("A", to_csv)),
        ("A.parquet", board("A")),
        ("words.csv", b"time_s,x_gyro_v\n0,1.2\n0.01,oops\n"),
        ("B.parquet", board("B")),
        ("empty.csv", b""),
        ("bad name!.parquet", to_parquet(replace(rows, header={}))),
        key="mixed",
    )
    assert sent.status_code == 201, sent.text
    return lab.ended(sent.json()["id"])


def test_one_bad_file_never_harms_the_others_and_each_says_why(lab: Lab, mixed: dict[str, Any]) -> None:
    assert (mixed["status"], mixed["done"], mixed["failed"], mixed["waiting"]) == ("finished", 4, 3, 0)
    assert (mixed["verdicts"], mixed["seconds_left"]) == ({"issued": 4, "error": 3}, 0.0)
    files = lab.files(mixed["id"])
    errors = {file["name"]: file["error"] and file["error"]["sentence"] for file in files}
    assert [name for name, error in errors.items() if error is None] == ["A.csv", "again.csv", "A.parquet", "B.parquet"]
    assert "Line 3, column x_gyro_v" in errors["words.csv"]
    assert errors["empty.csv"]
    assert "bad name!" in errors["bad name!.parquet"]
    thai = lab.http.get(f"/batches/{mixed['id']}/files?status=failed", headers={"Accept-Language": "th"}).json()
    assert "บรรทัด" in thai["items"][0]["error"]["sentence"]


def test_the_same_recording_has_one_certificate_and_the_numbers_of_every_other_path(
    lab: Lab, mixed: dict[str, Any], tmp_path: Path
) -> None:
    a, again, parquet, _, b, *_ = lab.files(mixed["id"])
    assert a["certificate"] == again["certificate"] == parquet["certificate"] != b["certificate"]
    (tmp_path / "A.csv").write_bytes(board("A", to_csv))
    found = batch_work.certify(str(tmp_path / "A.csv"), "A.csv", None, None)
    with Store(tmp_path) as store:
        issued = batch_work.keep(store, found, "A.csv")
        assert batch_work.keep(store, found, "A.csv")["number"] == issued["number"]
        assert len(store.recordings.find()[0]) == 1
        assert store.recording(issued["recording"]["id"]).digest() == issued["recording"]["digest"]
    assert a["axes"] == issued["axes"] == lab.http.get(f"/certificates/{a['certificate']}").json()["axes"]
    assert lab.http.get(f"/certificates/{a['certificate']}/verify").json()["valid"]


def test_only_files_that_may_be_tried_again_stay_on_the_disk(lab: Lab, mixed: dict[str, Any]) -> None:
    data = lab.services.store.data
    there = [file["name"] for file in lab.files(mixed["id"]) if file_of(data, mixed["id"], file["position"]).exists()]
    assert there == ["words.csv", "empty.csv", "bad name!.parquet"]


def test_uploads_that_nobody_tried_again_are_removed_and_open_batches_are_not(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        for name, error in (("ended", {"code": "batch.file_gone", "values": {}}), ("open", None), ("fresh", None)):
            file_of(tmp_path, name, 1).parent.mkdir(parents=True)
            file_of(tmp_path, name, 1).write_bytes(b"x")
            if name != "fresh":
                os.utime(file_of(tmp_path, name, 1).parent, (0, 0))
                store.batches.create(name, [{"name": "A", "size": 1, "error": error}], name="A", fingerprint=name)
        forget(store)
    assert {folder.name for folder in (tmp_path / "batches").iterdir()} == {"open", "fresh"}


def test_a_repeated_request_is_harmless_and_another_under_its_key_is_refused(lab: Lab) -> None:
    words = ("words.csv", b"time_s,x_gyro_v\n0,1.2\n")
    first = lab.send(words, key="once")
    repeated = lab.send(words, key="once")
    assert (first.status_code, repeated.status_code) == (201, 200)
    assert first.json()["id"] == repeated.json()["id"]
    other = lab.send(words, ("more.csv", b""), key="once")
    assert (other.status_code, other.json()["code"]) == (409, "batch.key_used")
    folders = {path.name for path in (lab.services.store.data / "batches").iterdir()}
    assert folders <= {batch["id"] for batch in lab.http.get("/batches").json()["items"]}
    lab.ended(first.json()["id"])


def test_failed_files_are_tried_again_and_what_waits_can_be_left(lab: Lab, mixed: dict[str, Any]) -> None:
    batch = mixed["id"]
    seen = max(file["change"] for file in lab.files(batch))
    again = lab.http.post(f"/batches/{batch}/retry").json()
    assert (again["status"], again["waiting"], again["done"]) == ("queued", 3, 4)
    lab.http.post(f"/batches/{batch}/cancel")
    cancelled = lab.ended(batch)
    assert cancelled["status"] in ("cancelled", "finished")
    assert cancelled["waiting"] == 0
    changed = lab.http.get(f"/batches/{batch}/files?cursor={seen}").json()["items"]
    assert {file["name"] for file in changed} == {"words.csv", "empty.csv", "bad name!.parquet"}
    assert {file["status"] for file in changed} <= {"cancelled", "failed"}
    lab.http.post(f"/batches/{batch}/retry")
    assert lab.ended(batch)["failed"] == 3


def test_nothing_to_retry_and_unknown_batches_are_told(lab: Lab) -> None:
    assert lab.http.get("/batches/none").status_code == 404
    empty = lab.http.post("/batches", files=[("name", (None, "x"))])
    assert (empty.status_code, empty.json()["code"]) == (422, "batch.no_files")


def test_a_specification_and_a_model_hold_for_the_whole_batch(lab: Lab) -> None:
    limits = '{"name": "lab", "axes": {"x": {"bias_V": {"max": 1.0}}}}'
    sent = lab.send(("A.parquet", board("A")), spec=limits, gyro_model="LPY503AL-OUT", name="morning")
    assert lab.ended(sent.json()["id"])["verdicts"] == {"fail": 1}
    assert sent.json()["name"] == "morning"
    assert lab.http.post(f"/batches/{sent.json()['id']}/retry").json()["code"] == "batch.nothing_to_retry"
    for fields, code in (({"spec": "{"}, "request.not_json"), ({"gyro_model": "none"}, "gyro_model.not_found")):
        assert lab.send(("A.parquet", b"x"), **fields).json()["code"] == code


def test_results_come_as_one_table_and_as_a_zip_of_every_document(lab: Lab, mixed: dict[str, Any]) -> None:
    table = lab.http.get(f"/batches/{mixed['id']}/results.csv")
    rows = list(csv.DictReader(io.StringIO(table.content.decode("utf-8-sig"))))
    files = lab.files(mixed["id"])
    assert [row["file"] for row in rows] == [file["name"] for file in files]
    assert float(rows[0]["x.bias_V"]) == files[0]["axes"]["x"]["bias_V"]["value"]
    assert "column x_gyro_v" in rows[3]["reason"]
    answer = lab.http.get(f"/batches/{mixed['id']}/results.zip?lang=th")
    with zipfile.ZipFile(io.BytesIO(answer.content)) as packed:
        assert packed.testzip() is None
        numbers = {file["certificate"] for file in files if file["certificate"]}
        documents = {f"{number}.{kind}" for number in numbers for kind in ("pdf", "csv", "json")}
        assert set(packed.namelist()) == {"results.csv"} | documents
        number = files[0]["certificate"]
        assert packed.read(f"{number}.pdf") == lab.http.get(f"/certificates/{number}.pdf?lang=th").content


def test_the_example_in_the_readme_runs_as_it_is_written(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(import time.*?)```", readme, re.DOTALL)
    (tmp_path / "boards").mkdir()
    (tmp_path / "boards" / "A.parquet").write_bytes(board("A"))
    (tmp_path / "boards" / "words.csv").write_text("hello\n")
    monkeypatch.chdir(tmp_path)
    exec(program.replace("http://127.0.0.1:8000", lab.address), {})
    said = capsys.readouterr().out
    assert "words.csv: Line 1: there is no column time_s" in said
    with zipfile.ZipFile("results.zip") as packed:
        assert len(packed.namelist()) == 4
