"""What is done with one file of many: by a worker, wherever that is, and then by the one writer of the store.

A worker needs no store and gives back everything that the store keeps: what the certificate says, and the samples
already packed.
"""

import faulthandler
import io
import os
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from calib_core.problem import Problem
from server import __version__
from server.store import Store

LONGEST_S = 900.0
"""A file of 200 MB takes about 15 s of CPU; what takes a quarter of an hour does not end."""


def certify(
    source: str | bytes, name: str, gyro_model: Mapping[str, Any] | None, spec: Mapping[str, Any] | None
) -> dict[str, Any]:
    """The recording at a path, or in bytes, as {"content", "packed", "cpu_s"}; else {"error": {"code", "values"}}.

    Nothing that is in a file harms more than that file: whatever goes wrong is its error.
    """
    start = time.process_time()
    try:
        found = _certified(source, name, gyro_model, spec)
    except Problem as problem:
        return {"error": {"code": problem.code, "values": problem.values}}
    except OSError as error:
        path = str(error.filename or name)
        return {"error": {"code": "file", "values": {"path": path, "reason": error.strerror or str(error)}}}
    except Exception as error:
        return {"error": {"code": "internal", "values": {"kind": type(error).__name__, "detail": str(error)[:200]}}}
    return {**found, "cpu_s": time.process_time() - start}


def certify_here(*arguments: Any) -> dict[str, Any]:
    """`certify` in a worker's own process, which ends where a file takes longer than LONGEST_S."""
    faulthandler.dump_traceback_later(LONGEST_S, exit=True)
    try:
        return certify(*arguments)
    finally:
        faulthandler.cancel_dump_traceback_later()


def _certified(
    source: str | bytes, name: str, gyro_model: Mapping[str, Any] | None, spec: Mapping[str, Any] | None
) -> dict[str, Any]:
    from calib_core.gyro_models import GyroModel
    from calib_core.packing import pack_recording
    from calib_core.recording import read
    from server.certify import content
    from server.store_db import checked_id

    with io.BytesIO(source) if isinstance(source, bytes) else Path(source).open("rb") as opened:
        recording = read(opened, name=name)
    board = checked_id(recording.header.get("board") or Path(name).name.split(".")[0], "board")
    recording = replace(recording, header={**recording.header, "board": board})
    model = None if gyro_model is None else GyroModel.from_json(gyro_model)
    found = content(recording, "", gyro_model=model, spec=spec)
    return {
        "content": found,
        "packed": {
            "header": dict(recording.header),
            "digest": found["recording"]["digest"],
            "samples": len(recording),
            "duration_s": round(recording.duration_s, 3),
            "end_s": float(recording.time_s[-1]),
            "data": pack_recording(recording),
        },
    }


def documents(content: Mapping[str, Any], lang: str) -> dict[str, bytes]:
    """An issued certificate in every format."""
    from server import documents as room

    return {kind: room.render(content, kind, lang) for kind in room.FORMATS}


def version() -> str:
    """Whose work a worker does."""
    return __version__


def dask_setup(_: object) -> None:
    """Called by Dask in each new worker that names this module as its preload.

    Everything else on its computer goes first: a server that answers, a bench in real time.
    """
    if hasattr(os, "nice"):
        os.nice(10)


def keep(store: Store, found: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Stores what `certify` gave and issues its certificate; the same recording keeps the one it has."""
    content, packed = found["content"], found["packed"]
    with store.connection.write(durable=True):
        store.boards.ensure(content["board"], gyro_model=_known(store, content["gyro_model"]["id"]))
        recording = store.recordings.keep(packed, board=content["board"], name=name)
        return store.issue_certificate({**content, "recording": {**content["recording"], "id": recording}})


def _known(store: Store, gyro_model: str) -> str:
    """The model for a new board: what its recording names, where this store knows it."""
    from server.store_boards import USUAL_MODEL

    return gyro_model if any(gyro_model == model.id for model in store.gyro_models.find()) else USUAL_MODEL
