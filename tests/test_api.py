"""The server over HTTP, as a page or a program uses it: one real process, one short run end to end."""

import asyncio
import errno
import io
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from running import Server
from websockets.exceptions import ConnectionClosedError
from websockets.sync.client import connect
from websockets.typing import Origin

from calib_core import recording as recordings
from server.app import create_app
from server.live import WINDOW_S, decode
from server.settings import Settings
from server.store import Store


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    running = Server(tmp_path_factory.mktemp("data"))
    yield running.worker_ready()
    running.close()


@pytest.fixture(scope="module")
def run(server: Server) -> dict[str, Any]:
    """A whole session with few readings, watched to its end."""
    started = server.run(
        board="LPY-7", operator="Somchai", note="two\nlines", conditions={"room_temperature_degC": 24.5}, seed=5
    )
    return server.ended(started["id"])


def problem(answer: Any, status: int, code: str) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    document: dict[str, Any] = answer.json()
    assert document["code"] == code
    assert document["status"] == status
    assert set(document) == {"type", "title", "status", "detail", "code", "values", "instance"}
    assert not document["detail"].startswith(code), "the sentence is missing in the texts"
    assert "{" not in document["detail"], "a placeholder was not filled"
    return document


# --- one run, end to end ---------------------------------------------------------------------------------------
def test_a_run_goes_through_six_states_to_a_certificate(run: dict[str, Any]) -> None:
    assert (run["status"], run["message"]) == ("finished", None)
    assert [state["status"] for state in run["states"]] == ["done"] * 6
    assert run["certificate"]
    for axis in "xz":
        estimate = run["results"][f"estimate_{axis}"]
        assert 1.2 < estimate["bias_V"]["value"] < 1.3
        assert estimate["scale_factor_V_per_dps"]["expanded_uncertainty"] > 0
        assert run["results"][f"rate_{axis}"]["nonlinearity_pct_fs"] < 1
        assert run["results"][f"position_{axis}"]["repeatability_pct_fs"] < 1


def test_the_certificate_names_its_run_and_can_be_computed_again(server: Server, run: dict[str, Any]) -> None:
    certificate = server.client.get(f"/certificates/{run['certificate']}").json()
    assert (certificate["board"], certificate["operator"]) == ("LPY-7", "Somchai")
    assert certificate["conditions"] == {"room_temperature_degC": 24.5}
    assert certificate["recording"]["id"] == run["recording"]
    verified = server.client.get(f"/certificates/{run['certificate']}/verify").json()
    assert verified["valid"], verified


def test_certifying_the_same_recording_again_gives_the_same_certificate(server: Server, run: dict[str, Any]) -> None:
    again = server.client.post("/certificates", json={"recording": run["recording"]})
    assert (again.status_code, again.json()["number"]) == (201, run["certificate"])
    spec = {"axes": {"x": {"bias_V": {"max": 1.0}}}}
    judged = server.client.post("/certificates", json={"recording": run["recording"], "spec": spec}).json()
    assert judged["verdict"] == "fail"
    assert judged["number"] != run["certificate"]


@pytest.mark.parametrize(("form", "starts"), [("pdf", b"%PDF-"), ("csv", b""), ("json", b"{")])
def test_every_document_of_a_certificate_downloads(
    server: Server, run: dict[str, Any], form: str, starts: bytes
) -> None:
    answer = server.client.get(f"/certificates/{run['certificate']}.{form}", params={"lang": "th"})
    assert answer.status_code == 200, answer.text
    assert answer.content.startswith(starts)
    assert run["certificate"] in answer.headers["content-disposition"]


def test_the_raw_recording_downloads_and_uploads_to_the_same_digest(server: Server, run: dict[str, Any]) -> None:
    known = server.client.get(f"/recordings/{run['recording']}").json()
    for form in ("csv", "parquet"):
        file = server.client.get(f"/recordings/{run['recording']}.{form}")
        read = recordings.read(io.BytesIO(file.content), name=f"a.{form}")
        assert read.digest() == known["digest"]
        assert read.header["operator"] == "Somchai"
    uploaded = server.client.post("/recordings", files={"file": ("a.parquet", file.content)})
    assert uploaded.status_code == 201, uploaded.text
    assert uploaded.json()["digest"] == known["digest"]
    fast = server.client.get(f"/recordings/{run['recording']}.fast.csv")
    assert recordings.read(io.BytesIO(fast.content), name="fast.csv").duration_s > 2


def test_stored_samples_come_thinned_for_a_chart(server: Server, run: dict[str, Any]) -> None:
    columns = server.client.get(f"/runs/{run['id']}/series", params={"state": "rate_x", "max_points": 100}).json()[
        "columns"
    ]
    assert 50 <= len(columns["time_s"]) <= 100
    assert {len(values) for values in columns.values()} == {len(columns["time_s"])}
    compared = server.client.get(f"/runs/{run['id']}/comparison", params={"axis": "x"}).json()
    assert compared["estimated"]["angle_rms_deg"] < compared["datasheet"]["angle_rms_deg"]


def test_a_state_is_repeated_alone_and_the_others_are_taken_over(server: Server, run: dict[str, Any]) -> None:
    again = server.ended(server.run(board="LPY-7", continues=run["id"], states=["rate_x"])["id"])
    assert again["status"] == "finished", again["message"]
    assert [state["status"] for state in again["states"]] == ["kept", "done", "kept", "kept", "kept", "kept"]
    assert again["certificate"] not in (None, run["certificate"])
    before, after = run["results"], again["results"]
    assert after["estimate_z"]["bias_V"] == before["estimate_z"]["bias_V"]
    assert after["rate_x"]["points"] != before["rate_x"]["points"]


def test_lists_page_and_search(server: Server, run: dict[str, Any]) -> None:
    first = server.client.get("/recordings", params={"limit": 1}).json()
    assert (len(first["items"]), first["next"] is not None) == (1, True)
    second = server.client.get("/recordings", params={"limit": 1, "cursor": first["next"]}).json()
    assert second["items"][0]["id"] != first["items"][0]["id"]
    assert server.client.get("/boards", params={"q": "PY-7"}).json()["items"][0]["id"] == "LPY-7"
    assert server.client.get("/boards", params={"q": "100%_"}).json()["items"] == []
    assert server.client.get("/certificates", params={"q": run["certificate"]}).json()["items"]
    assert server.client.get("/boards/LPY-7").json()["runs"][-1]["id"] == run["id"]


# --- the live socket -------------------------------------------------------------------------------------------
def test_a_late_viewer_has_the_run_so_far_in_one_message(server: Server, run: dict[str, Any]) -> None:
    with connect(f"{server.address.replace('http', 'ws')}/api/v1/runs/{run['id']}/live", max_size=None) as socket:
        data = socket.recv()
        assert isinstance(data, bytes)
    (length,) = struct.unpack_from("<I", data)
    assert length % 8 == 0
    message, arrays = decode(data)
    assert (message["run"], message["reset"], message["status"]) == (run["id"], True, "finished")
    assert message["certificate"] == run["certificate"]
    assert set(message["results"]) == {state["name"] for state in run["states"]}
    linearity = [point for point in message["points"] if (point["state"], point["test"]) == ("rate_x", "linearity")]
    assert len(linearity) == 36
    assert max(abs(point["gyro"] - point["reference"]) for point in linearity) < 2
    for axis in "xz":
        trace = arrays[f"{axis}.adaptive_scale_factor"]
        assert len(trace) == len(arrays[f"{axis}.trace_time_s"]) > 900
        certified = run["results"][f"estimate_{axis}"]["scale_factor_V_per_dps"]["value"]
        assert np.mean(trace[-200:]) == pytest.approx(certified, rel=0.02)
    assert 60 < np.ptp(arrays["z.time_s"]) <= WINDOW_S


def test_the_socket_of_an_unknown_run_says_so(server: Server) -> None:
    with connect(f"{server.address.replace('http', 'ws')}/api/v1/runs/none/live?lang=th") as socket:
        with pytest.raises(ConnectionClosedError):
            socket.recv()
        assert (socket.close_code, "none" in (socket.close_reason or "")) == (4404, True)


def test_a_page_of_another_site_cannot_watch(server: Server, run: dict[str, Any]) -> None:
    address = f"{server.address.replace('http', 'ws')}/api/v1/runs/{run['id']}/live"
    with connect(address, origin=Origin("http://evil.example")) as socket:
        with pytest.raises(ConnectionClosedError):
            socket.recv()
        assert socket.close_code == 4403
    with connect(address, origin=Origin(server.address), max_size=None) as socket:
        assert socket.recv()


# --- refusals --------------------------------------------------------------------------------------------------
def test_what_is_not_there_is_a_problem_in_the_language_asked_for(server: Server) -> None:
    english = problem(server.client.get("/runs/none"), 404, "run.not_found")
    thai = problem(server.client.get("/runs/none", headers={"Accept-Language": "th, en;q=0.5"}), 404, "run.not_found")
    assert "none" in english["detail"]
    assert "none" in thai["detail"]
    assert english["detail"] != thai["detail"]
    problem(server.client.get("/nothing"), 404, "request.not_found")
    problem(server.client.delete("/health"), 405, "request.method_not_allowed")


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ({}, "request.missing"),
        ({"board": "LPY/42"}, "board.characters"),
        ({"board": "ก\N{GRINNING FACE}"}, "board.characters"),
        ({"board": "B", "colour": 1}, "request.unknown_field"),
        ({"board": "B", "readings": 2}, "request.too_small"),
        ({"board": "B", "readings": "7"}, "request.not_whole"),
        ({"board": "B", "profile": "fast"}, "request.choice"),
        ({"board": "B", "operator": "a\tb"}, "request.control_characters"),
        ({"board": "B", "states": ["rate_x"]}, "session.no_estimate"),
        ({"board": "B", "ranges": {"x": {"rate_dps": 200.0}}}, "plan.rate_past_sensor"),
        ({"board": "B", "ranges": {"x": {"sine_deg": 149.0}}}, "plan.rate_past_sensor"),
        ({"board": "B", "spec": {"axes": {"x": {"colour": {"max": 1}}}}}, "spec.unknown_key"),
        ({"board": "B", "gyro_model": "none"}, "gyro_model.not_found"),
        ({"board": "B", "continues": "none", "states": ["rate_x"]}, "run.not_found"),
    ],
)
def test_a_run_that_cannot_be_is_refused_before_anything_is_stored(
    server: Server, body: dict[str, Any], code: str
) -> None:
    before = server.client.get("/runs").json()["items"]
    for path in ("/runs/plan", "/runs"):
        problem(server.client.post(path, json=body), 404 if code.endswith("not_found") else 422, code)
    assert server.client.get("/runs").json()["items"] == before
    assert server.client.get("/boards", params={"q": "B"}).json() == server.client.get("/boards?q=B").json()


def test_json_that_is_none_is_a_bad_request(server: Server) -> None:
    answer = server.client.post("/runs", content=b"{", headers={"Content-Type": "application/json"})
    problem(answer, 400, "request.not_json")


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (b"\x00\x01\x02\xff\xfe", "recording.not_text"),
        (b"", "recording.empty_file"),
        (b"time_s,x_gyro_v\n0,1\n0.5,1\n0.4,1\n", "recording.time_not_increasing"),
        (b"time_s,temperature_c\n0,1\n5,1\n", "recording.no_gyro"),
        (b"time_s,x_gyro_v\n0,1\n0.5,1\n", "recording.too_short"),
    ],
)
def test_a_bad_recording_is_refused_with_its_sentence(server: Server, text: bytes, code: str) -> None:
    before = server.client.get("/recordings").json()
    answer = server.client.post("/recordings", files={"file": ("bad.csv", text)})
    problem(answer, 422, code)
    assert server.client.get("/recordings").json() == before


def test_a_full_disk_is_a_problem_document_and_nothing_is_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = create_app(Settings(tmp_path))

    def ask(method: str, path: str, **content: Any) -> httpx.Response:
        """Of the application itself, in this process and without a worker."""

        async def asked() -> httpx.Response:
            async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test") as client:
                return await client.request(method, f"/api/v1{path}", **content)

        return asyncio.run(asked())

    store: Store = app.state.services.store
    pages = store.connection.rows("pragma page_count")[0]["page_count"]
    store.connection.db.execute(f"pragma max_page_count = {pages + 1}")
    answers = [ask("POST", "/boards", json={"id": f"B{i}", "note": "n" * 2000}) for i in range(6)]
    problem(answers[-1], 507, "store.full")
    made = [answer.json()["id"] for answer in answers if answer.status_code == 201]
    assert [board["id"] for board in ask("GET", "/boards").json()["items"]] == made[::-1]

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device", "upload")

    monkeypatch.setattr("server.api.recordings.Path.open", full)
    problem(ask("POST", "/recordings", files={"file": ("a.csv", b"time_s")}), 507, "store.full")


def test_too_much_is_refused_while_it_is_read(server: Server) -> None:
    answer = server.client.post("/boards", content=b" " * (2 << 20), headers={"Content-Type": "application/json"})
    problem(answer, 413, "request.too_large")
    pieces = (b" " * (1 << 16) for _ in range(40))  # sent in chunks, its length not said
    answer = server.client.post("/boards", content=pieces, headers={"Content-Type": "application/json"})
    problem(answer, 413, "request.too_large")


def test_a_write_from_another_sites_page_is_refused_but_the_stop_is_not(server: Server) -> None:
    foreign = {"Origin": "http://evil.example"}
    problem(server.client.post("/boards", json={"id": "B"}, headers=foreign), 403, "auth.foreign_origin")
    assert server.client.post("/rig/stop", headers=foreign).status_code == 204


# --- boards, models, rig ---------------------------------------------------------------------------------------
def test_boards_are_made_changed_and_not_made_twice(server: Server) -> None:
    assert server.client.post("/boards", json={"id": "LPY-9", "note": "new"}).status_code == 201
    problem(server.client.post("/boards", json={"id": "LPY-9"}), 409, "board.exists")
    changed = server.client.patch("/boards/LPY-9", json={"gyro_model": "LPY503AL-4XOUT"}).json()
    assert (changed["gyro_model"], changed["note"]) == ("LPY503AL-4XOUT", "new")
    plan = server.client.post("/runs/plan", json={"board": "LPY-9"}).json()
    assert plan["states"][0]["name"] == "estimate_x"


def test_own_gyro_models_are_kept_and_presets_stay(server: Server) -> None:
    sheet = {"bias_V": 1.5, "scale_factor_V_per_dps": 0.01, "range_dps": 90}
    assert server.client.post("/gyro-models", json={"id": "MINE", "axes": {"x": sheet}}).status_code == 201
    problem(server.client.post("/gyro-models", json={"id": "MINE", "axes": {"x": sheet}}), 409, "gyro_model.exists")
    changed = server.client.put("/gyro-models/MINE", json={"axes": {"x": {**sheet, "range_dps": 60}}}).json()
    assert changed["axes"]["x"]["range_dps"] == 60
    problem(server.client.delete("/gyro-models/LPY503AL-OUT"), 409, "gyro_model.preset")
    problem(server.client.post("/runs/plan", json={"board": "B", "gyro_model": "MINE"}), 422, "plan.axis")
    assert server.client.delete("/gyro-models/MINE").status_code == 204
    problem(server.client.get("/gyro-models/MINE"), 404, "gyro_model.not_found")


def test_a_rig_that_is_not_there_is_refused(server: Server, run: dict[str, Any]) -> None:
    problem(server.client.put("/rig", json={"url": "nothing"}), 422, "rig.address")
    assert server.client.get("/rig").json()["url"] == "twin:", "a refused address left its mark"
    absent = {"url": "dynamixel:/dev/none?ids=1,2&baud=1000000+nidaq:Dev1?channels=ai0,ai1"}
    problem(server.client.put("/rig", json=absent), 502, "rig.port_absent")
    assert server.client.get("/rig").json()["connected"] is False
    problem(server.client.put("/rig", json={"url": "emulated:", "speed": 20}), 422, "rig.speed_only_simulated")
    back = server.client.put("/rig", json={"url": "twin:?seed=3", "speed": "max"}).json()
    assert (back["connected"], back["simulated"], back["speed"]) == (True, True, "max")
    assert {part["part"]: part["ok"] for part in back["parts"]}["servo x"] is True
    elsewhere = server.client.post("/runs", json={"board": "LPY-7", "continues": run["id"], "states": ["rate_x"]})
    problem(elsewhere, 422, "run.continues_other")
    server.client.put("/rig", json={"url": "twin:"})


def test_the_lease_keeps_others_from_starting_but_never_from_stopping(server: Server) -> None:
    held = server.client.post("/rig/lease", json={"holder": "Ann"}).json()
    mine = {"X-Rig-Lease": held["token"]}
    problem(server.client.post("/runs", json={"board": "B"}), 409, "rig.leased")
    problem(server.client.put("/rig", json={"url": "twin:"}), 409, "rig.leased")
    assert server.client.post("/rig/lease", json={"holder": "Ann"}, headers=mine).json()["token"] == held["token"]
    assert server.client.get("/rig").json()["lease"]["holder"] == "Ann"
    assert server.client.post("/rig/stop").status_code == 204
    assert server.client.delete("/rig/lease", headers=mine).status_code == 204
    assert server.client.get("/rig").json()["lease"] is None


# --- the description -------------------------------------------------------------------------------------------
def test_every_operation_declares_its_errors_as_problem_documents(server: Server) -> None:
    schema = server.client.get(f"{server.address}/openapi.json").json()
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            failing = {status: answer for status, answer in operation["responses"].items() if status >= "400"}
            assert failing, (path, method)
            assert all(set(answer["content"]) == {"application/problem+json"} for answer in failing.values())
            assert "404" in failing or "{" not in path, (path, method)
    assert "/api/v1/runs/{run}/stop" in schema["paths"]
    assert json.dumps(schema).count("HTTPValidationError") == 0
    page = server.client.get(f"{server.address}/docs").text
    assert "/api/v1/rig/stop" in page
    assert "<script" not in page
