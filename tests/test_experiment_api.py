"""An experiment over HTTP: a record that cannot tell, a motion proposed, done on the rig, and judged with it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from running import Server

from calib_core.excitation import Excitation, plan_of
from calib_core.recording import write_csv
from server.devices import open_rig
from server.engine import record

URL = "twin:?seed=5&covariates=1&effects=bandwidth_lag.tau:0.006"
SINE = (Excitation("x", "sine", 59.7, (30.0,), (0.2513,)),)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    running = Server(tmp_path_factory.mktemp("data"), "--rig", URL)
    yield running.worker_ready()
    running.close()


@pytest.fixture(scope="module")
def uploaded(server: Server, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A record of one slow sine, made by the same board on the same rig."""
    rig = open_rig(URL)
    rig.open()
    file = Path(tmp_path_factory.mktemp("record"), "sine.csv")
    with file.open("wb") as opened:
        write_csv(record(plan_of(SINE, experiment="hand", axis="x"), rig, board="LPY-9"), opened)
    answer = server.client.post("/recordings", files={"file": file.open("rb")}, data={"board": "LPY-9"})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def test_a_lag_is_told_from_a_delay_by_one_run(server: Server, uploaded: str) -> None:
    answer = server.client.post("/experiments", json={"recording": uploaded, "axis": "x"})
    assert answer.status_code == 201, answer.text
    proposed: dict[str, Any] = answer.json()
    following = proposed["next_experiment"]
    assert (proposed["status"], proposed["result"]) == ("proposed", None)
    assert {"bandwidth_lag", "time_offset"} <= set(following["separates"])
    assert following["decides"]
    assert following["motion"][0]["kind"] == "multisine"
    assert "4.0313 Hz" in following["sentence"]

    begun = server.client.post(f"/experiments/{proposed['id']}/run", json={"speed": "max"})
    assert begun.status_code == 201, begun.text
    run = server.ended(begun.json()["run"])
    assert (run["status"], run["certificate"]) == ("finished", None)
    assert [state["name"] for state in run["states"]] == ["experiment"]

    done = server.client.get(f"/experiments/{proposed['id']}").json()
    assert done["status"] == "done", done["message"]
    diagnosis = done["result"]["diagnosis"]
    assert diagnosis["verdict"] == "missing"
    assert [found["effect"] for found in diagnosis["missing"]] == ["bandwidth_lag"]
    joined = server.client.get(f"/recordings/{done['result']['recording']}").json()
    assert joined["duration_s"] > run["plan"]["seconds"] + 59.0
    listed = server.client.get("/experiments", params={"recording": uploaded}).json()["items"]
    assert [item["id"] for item in listed] == [proposed["id"]]


def test_experiments_that_cannot_be_are_refused(server: Server, uploaded: str) -> None:
    assert server.client.get("/experiments/none").status_code == 404
    assert server.client.post("/experiments", json={"recording": "none", "axis": "x"}).status_code == 404
    refused = server.client.post("/experiments", json={"recording": uploaded, "axis": "y"})
    assert (refused.status_code, refused.json()["code"]) == (422, "request.choice")
