"""The run as it is watched: what has been measured so far, and one cursor a viewer.

The worker's frames are added up here, so that a page opened late, or again, has everything at once. A viewer takes
what is newer than its cursor, whenever it can: one that stalls gets a longer message later and delays nobody.

A message is: length of the JSON (u32, little-endian), the JSON, padded with spaces until the arrays start at a
multiple of 8 after the length, then Float64 arrays back to back, named and counted by the JSON's "arrays".
"""

import json
import struct
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from server import texts

Arrays = Mapping[str, npt.NDArray[np.float64]]

WINDOW_S = 120.0  # of bench time that a page can plot of the fast columns; the traces are kept whole
TRACE = ("trace_time_s", "adaptive_bias_V", "adaptive_scale_factor")
ENDED = ("finished", "stopped", "failed", "interrupted")


def encode(message: Mapping[str, Any], arrays: Arrays) -> bytes:
    head = {**message, "arrays": [[name, len(values)] for name, values in arrays.items()]}
    text = json.dumps(head, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return b"".join((struct.pack("<I", len(text)), text, *(values.tobytes() for values in arrays.values())))


def decode(data: bytes) -> tuple[dict[str, Any], dict[str, npt.NDArray[np.float64]]]:
    (length,) = struct.unpack_from("<I", data)
    message: dict[str, Any] = json.loads(data[4 : 4 + length])
    arrays, at = {}, 4 + length
    for name, count in message.pop("arrays"):
        arrays[name] = np.frombuffer(data, np.float64, count, at)
        at += 8 * count
    return message, arrays


class LiveRun:
    """One run so far. `feed` is called by the worker's reader thread, `since` by viewers; both are quick."""

    def __init__(self, run: str, head: Mapping[str, Any]) -> None:
        self.run = run
        self.seq = 0
        self._lock = threading.Lock()
        self._head: dict[str, Any] = {"run": run, **head}
        self._chunks: dict[str, deque[tuple[int, Arrays]]] = {}
        self._dropped = 0  # the newest frame whose rows have left the window
        self._points: list[tuple[int, Any]] = []
        self._results: dict[str, tuple[int, Any]] = {}
        self._encoded: dict[tuple[int | None, str], bytes] = {}
        self._wakers: dict[object, Callable[[], object]] = {}

    @property
    def ended(self) -> bool:
        return self._head["status"] in ENDED

    def feed(self, message: Mapping[str, Any], arrays: Arrays | None = None) -> None:
        """Adds a frame: its "points" and "results" to those before, its arrays to the rings; all else replaces.

        A frame that says "reset" is everything so far, and comes where its sender had to start again.
        """
        with self._lock:
            self.seq += 1
            rest = {name: value for name, value in message.items() if name not in ("seq", "run")}
            if rest.pop("reset", False):
                self._chunks, self._points, self._results, self._dropped = {}, [], {}, self.seq
            self._points += [(self.seq, point) for point in rest.pop("points", ())]
            self._results |= {state: (self.seq, result) for state, result in rest.pop("results", {}).items()}
            self._head.update(rest)
            self._keep(arrays or {})
            self._encoded.clear()
            wakers = list(self._wakers.values())
        for wake in wakers:
            wake()

    def _keep(self, arrays: Arrays) -> None:
        grouped: dict[str, dict[str, Any]] = {}
        for name, values in arrays.items():
            axis, column = name.split(".", 1)
            grouped.setdefault(f"{axis}.trace_time_s" if column in TRACE else f"{axis}.time_s", {})[name] = values
        for clock, chunk in grouped.items():
            self._chunks.setdefault(clock, deque()).append((self.seq, chunk))
        latest = max((chunk[clock][-1] for clock, chunk in grouped.items() if len(chunk[clock])), default=None)
        if latest is None:
            return
        for clock, chunks in self._chunks.items():
            if not clock.endswith(".time_s"):
                continue
            while chunks and not chunks[0][1][clock][-1] > latest - WINDOW_S:
                self._dropped = max(self._dropped, chunks.popleft()[0])
            if chunks and chunks[0][1][clock][0] < latest - WINDOW_S:  # at full speed a frame can be minutes long
                seq, oldest = chunks[0]
                inside = oldest[clock] >= latest - WINDOW_S
                chunks[0] = seq, {name: values[inside] for name, values in oldest.items()}

    def since(self, cursor: int | None, lang: str = "en") -> tuple[bytes, int] | None:
        """What is newer than the cursor, and the next cursor; None where nothing is. Without a cursor: all of it.

        Encoded once for all viewers who stand at the same place and read the same language.
        """
        with self._lock:
            if cursor == self.seq:
                return None
            if cursor is not None and cursor < self._dropped:
                cursor = None  # too far behind to be continued: start again
            if (cursor, lang) not in self._encoded:
                self._encoded[cursor, lang] = self._encode(cursor, lang)
            return self._encoded[cursor, lang], self.seq

    def _encode(self, cursor: int | None, lang: str) -> bytes:
        after = -1 if cursor is None else cursor
        arrays: dict[str, Any] = {}
        for chunks in self._chunks.values():
            new = [chunk for seq, chunk in chunks if seq > after]
            for name in new[0] if new else ():
                arrays[name] = np.concatenate([chunk[name] for chunk in new])
        message = self._head.get("message")
        if message is not None:
            message = {**message, "sentence": texts.render(message["code"], message["values"], lang)}
        head = {
            **self._head,
            "message": message,
            "seq": self.seq,
            "reset": cursor is None,
            "points": [point for seq, point in self._points if seq > after],
            "results": {state: result for state, (seq, result) in self._results.items() if seq > after},
        }
        return encode(head, arrays)

    def watch(self, wake: Callable[[], object]) -> Callable[[], None]:
        """Calls ``wake`` after each frame, from the feeding thread, until the returned function is called."""
        key = object()
        with self._lock:
            self._wakers[key] = wake

        def leave() -> None:
            with self._lock:
                self._wakers.pop(key, None)

        return leave
