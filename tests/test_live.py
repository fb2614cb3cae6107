"""The live view: what a viewer gets, at what pace, and that one who stalls delays nobody."""

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from running import Server
from websockets.sync.client import ClientConnection, connect

from server.live import WINDOW_S, LiveRun, decode, encode


def frame(start_s: float, seconds: float = 1.0) -> dict[str, Any]:
    time_s = start_s + np.arange(0, seconds, 0.02)
    return {"x.time_s": time_s, "x.gyro_V": 1.25 + 0 * time_s}


def test_arrays_lie_at_multiples_of_eight_and_come_back_exactly() -> None:
    arrays = {"x.time_s": np.array([0.1, 0.2]), "x.gyro_V": np.array([1.0, np.nan]), "z.time_s": np.empty(0)}
    for text in ("", "a", "ไทย", "seven letters"):
        data = encode({"step": text}, arrays)
        message, read = decode(data)
        assert message["step"] == text
        assert len(data) % 8 == 4
        assert {name: values.tolist() for name, values in read.items() if name != "x.gyro_V"} == {
            "x.time_s": [0.1, 0.2],
            "z.time_s": [],
        }
        assert np.isnan(read["x.gyro_V"][1])


def test_a_viewer_gets_each_sample_once_and_a_late_one_all_that_is_kept() -> None:
    live = LiveRun("r", {"status": "running"})
    cursor, seen = None, []
    for second in range(200):
        live.feed({"state": "rate_x", "points": [second]}, frame(float(second)))
        if second % 3 == 0:
            new = live.since(cursor)
            assert new is not None
            message, arrays = decode(new[0])
            assert message["reset"] is (cursor is None)
            cursor = new[1]
            seen += arrays["x.time_s"].tolist()
    assert live.since(cursor) is not None
    assert np.allclose(np.diff(seen), 0.02)
    late, arrays = decode(live.since(None)[0])  # type: ignore[index]
    assert late["points"] == list(range(200))
    assert WINDOW_S - 0.03 < np.ptp(arrays["x.time_s"]) <= WINDOW_S


def test_a_viewer_who_fell_behind_the_window_starts_again() -> None:
    live = LiveRun("r", {"status": "running"})
    live.feed({}, frame(0.0))
    _, cursor = live.since(None)  # type: ignore[misc]
    for second in range(1, 300):
        live.feed({}, frame(float(second)))
    message, arrays = decode(live.since(cursor)[0])  # type: ignore[index]
    assert message["reset"] is True
    assert arrays["x.time_s"][0] > 170


def test_a_message_is_encoded_once_for_all_who_stand_at_the_same_place() -> None:
    live = LiveRun("r", {"status": "running"})
    live.feed({}, frame(0.0))
    assert live.since(None)[0] is live.since(None)[0]  # type: ignore[index]


def test_the_adaptive_trace_is_kept_whole() -> None:
    live = LiveRun("r", {"status": "running"})
    for second in range(300):
        live.feed(
            {}, {"x.trace_time_s": np.array([float(second)]), "x.adaptive_bias_V": np.array([1.2]), **frame(second)}
        )
    _, arrays = decode(live.since(None)[0])  # type: ignore[index]
    assert len(arrays["x.adaptive_bias_V"]) == 300


# --- with real sockets -----------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    running = Server(tmp_path_factory.mktemp("live"), "--speed", "20")
    yield running.worker_ready()
    running.close()


def viewer(server: Server, run: str, **options: Any) -> ClientConnection:
    address = f"{server.address.replace('http', 'ws')}/api/v1/runs/{run}/live"
    return connect(address, max_size=None, compression=None, **options)


def watch(server: Server, run: str, frames: int, heads: list[dict[str, Any]]) -> None:
    with viewer(server, run) as socket:
        while len(heads) < frames:
            data = socket.recv(timeout=10)
            assert isinstance(data, bytes)
            heads.append({**decode(data)[0], "at": time.monotonic()})


def watched(frames: int, server: Server, run: str) -> list[list[dict[str, Any]]]:
    """So many frames for each of four viewers."""
    came: list[list[dict[str, Any]]] = [[] for _ in range(4)]
    viewers = [threading.Thread(target=watch, args=(server, run, frames, heads)) for heads in came]
    for thread in viewers:
        thread.start()
    for thread in viewers:
        thread.join()
    return came


def test_frames_reach_every_viewer_while_others_stall(server: Server) -> None:
    run = server.run(speed=100, readings=22)["id"]
    with ExitStack() as stack:
        # Nobody reads these.
        stalled = [stack.enter_context(viewer(server, run, max_queue=1, close_timeout=0.1)) for _ in range(6)]
        came = watched(100, server, run)
        began = time.monotonic()
        assert server.client.get("/health").status_code == 200
        assert time.monotonic() - began < 1.0
        server.client.post(f"/runs/{run}/stop")
        # One of the stalled reads on: everything comes, in fewer messages, up to the end.
        messages = [decode(data) for data in stalled[0] if isinstance(data, bytes)]
    for heads in came:
        # Twenty a second on a machine that has the time; whatever it has, each viewer gets the frames there are.
        assert len(heads) == 100
        assert heads[-1]["at"] - heads[0]["at"] > 4.0
        assert len(heads) > 0.8 * (heads[-1]["seq"] - heads[0]["seq"])
        assert max(np.diff([head["at"] for head in heads])) < 2.0
    assert len(messages) < 0.9 * len(came[0])
    assert messages[-1][0]["status"] == "stopped"
    kept = [arrays["x.time_s"] for message, arrays in messages if not message["reset"] and "x.time_s" in arrays]
    assert np.diff(np.concatenate(kept)).max() < 0.1


def test_the_socket_agrees_to_no_compression(server: Server) -> None:
    run = server.run(speed="max", states=["estimate_x"])["id"]
    with connect(f"{server.address.replace('http', 'ws')}/api/v1/runs/{run}/live", max_size=None) as socket:
        assert socket.response is not None
        assert "Sec-WebSocket-Extensions" not in socket.response.headers
    server.client.post(f"/runs/{run}/stop")
