"""Work that takes more than a moment, in a process of its own: the server goes on answering and the live page moving.

Every function here is named by the caller and run there; it opens the store by its directory.
"""

import asyncio
import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from calib_core.problem import Problem

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor

    from calib_core.compensation import Compensation

T = TypeVar("T")


STAGES = ("reading", "fitting", "searching", "structure", "motions")
"""What a long work is at; a page has a sentence for each."""
SLOTS = 256
"""So many works can tell theirs at a time."""


class Compute:
    """A process or a few, started with the first work and again if one was ended."""

    def __init__(self, processes: int = 1, *, niceness: int = 0) -> None:
        self._processes, self._niceness = processes, niceness
        self._pool: ProcessPoolExecutor | None = None
        self._stages: Any = None
        self._once: dict[str, Any] = {}

    async def run(self, work: Callable[..., T], *arguments: object, slot: int = 0) -> T:
        from concurrent.futures import ProcessPoolExecutor
        from concurrent.futures.process import BrokenProcessPool

        for attempt in (1, 2):
            if self._pool is None:
                context = multiprocessing.get_context("spawn")
                self._stages = context.RawArray("b", SLOTS)
                told = (self._niceness, self._stages)
                self._pool = ProcessPoolExecutor(self._processes, mp_context=context, initializer=_begin, initargs=told)
            pool = self._pool
            self._stages[slot] = 0
            try:
                return await asyncio.get_running_loop().run_in_executor(pool, _watched, slot, work, *arguments)
            except BrokenProcessPool:
                if self._pool is pool:
                    self._pool = None
                if attempt == 2:
                    raise Problem("server.fault", kind="BrokenProcessPool") from None
        raise AssertionError("unreachable")

    def stage(self, slot: int) -> str:
        """What the work that was given this slot is at."""
        return STAGES[0 if self._stages is None else self._stages[slot]]

    async def once(self, name: str, work: Callable[[], T]) -> T:
        """What does not change while the program runs, computed at the first request for it."""
        if name not in self._once:
            self._once[name] = await self.run(work)
        result: T = self._once[name]
        return result

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


_told: Any = None
_slot = 0


def _watched(slot: int, work: Callable[..., T], *arguments: object) -> T:
    global _slot
    _slot = slot
    return work(*arguments)


def tell(stage: str) -> None:
    """Says what the work in this process is at, to whoever waits for it."""
    if _told is not None:
        _told[_slot] = STAGES.index(stage)


def _begin(niceness: int, stages: Any) -> None:
    global _told
    _told = stages
    if niceness and hasattr(os, "nice"):  # not on Windows
        os.nice(niceness)
    # The small matrices of this work are slower with two threads than with one.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C is the server's; it ends this process in order
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()


def _end_with_parent() -> None:
    """A server that is killed cannot say so, and a process of a pool waits for work for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def import_recording(data: Path, file: Path, name: str, mapping: Mapping[str, str] | None, board: str | None) -> str:
    """Reads and keeps an uploaded recording or file of points; gives its id. Raises Problem as their `read`."""
    from calib_core import points
    from calib_core.recording import read
    from server.store import Store

    with file.open("rb") as opened:
        try:
            recording = read(opened, name=name, mapping=mapping)
        except Problem as problem:
            if problem.code != "recording.is_points":
                raise
            opened.seek(0)
            readings = points.read(opened, mapping=mapping)
            with Store(data) as store:
                return store.recordings.add_points(readings, board=board or "", name=name)
    board = board or recording.header.get("board", "")
    with Store(data) as store:
        if board:
            store.boards.ensure(board)
        return store.recordings.add(recording, board=board, name=name)


def export_recording(data: Path, recording: str, form: str, file: Path) -> None:
    """Writes "csv", "parquet" or "fast.csv" of a stored recording to ``file``."""
    from calib_core import points
    from calib_core.recording import write_csv, write_parquet
    from server.store import Store

    with Store(data) as store, file.open("wb") as opened:
        readings = store.recordings.points(recording) if form == "csv" else None
        if readings is not None:
            points.write(readings, opened)
            return
        loaded = store.recordings.load(recording, kind="fast" if form == "fast.csv" else "rows")
        (write_parquet if form == "parquet" else write_csv)(loaded, opened)


def series(data: Path, recording: str, state: str | None, max_points: int) -> dict[str, list[float | None]]:
    """Columns of a stored recording, every k-th row of them, None where there is no sample."""
    from server.store import Store

    with Store(data) as store:
        loaded = store.recordings.load(recording, state=state)
    every = slice(None, None, -(-len(loaded) // max_points))
    columns = {"time_s": loaded.time_s, **loaded.columns}
    return {name: [None if x != x else x for x in values[every].tolist()] for name, values in columns.items()}


def comparison(data: Path, recording: str, axis: str, max_points: int) -> dict[str, Any]:
    """Rate and angle against the encoder, with the datasheet's parameters and with the estimated ones."""
    from calib_core import comparison
    from server.store import Store

    with Store(data) as store:
        return dict(comparison.of_session(store.recording(recording), axis, max_points=max_points))


def certify(
    data: Path, recording: str, model: str | None, spec: Mapping[str, Any] | None, models: Sequence[str] = ()
) -> dict[str, Any]:
    """``model``: a gyro model, or a saved model whose effects are taken out first; ``models``: more of these."""
    from server import certify as room
    from server.store import Store

    with Store(data) as store:
        if model is not None and model in store.models:
            models, model = [model, *models], None
        # The same models in another order give the same certificate.
        saved = sorted((room.compensated_by(store.models.get(one)) for one in dict.fromkeys(models)), key=_axis)
        gyro_model = store.gyro_models.get(model) if model else None
        return dict(room.certify(store, recording, gyro_model=gyro_model, spec=spec, compensation=saved))


def _axis(compensation: Mapping[str, Any]) -> str:
    return str(compensation["axis"])


def diagnose(
    data: Path,
    recording: str,
    axis: str | None,
    effects: Sequence[str],
    board: str | None = None,
    axes: Mapping[str, Mapping[str, Any]] = {},
) -> dict[str, Any]:
    """CONTRACT 3 of a stored recording; of points, of the first board and axis that are meant.

    ``axes``: the rig's, as the worker told them, for what to do next there.
    """
    from calib_core.sequence import Axis
    from server import diagnosis
    from server.store import Store

    with Store(data) as store:
        row = store.recordings.row(recording)
        asked = {"axis": axis, "effects": effects, "file": row["name"], "suspects": store.effects.suspects()}
        readings = store.recordings.points(recording)
        if readings is not None:
            return diagnosis.of_points(readings, **asked, board=board)[0]
        rig = {name: Axis(**facts) for name, facts in axes.items()}
        return diagnosis.of_recording(store.recording(recording), **asked, axes=rig or None, told=tell)


def example(data: Path, name: str) -> str:
    """Makes an example's recording, unless it is there; gives its id."""
    from server import examples
    from server.store import Store

    with Store(data) as store:
        return examples.made(store, name)


def save_model(data: Path, name: str, recording: str, axis: str, effects: Sequence[str], note: str) -> str:
    from server.store_models import save

    return save(data, name, recording, axis, effects, note)


def export_model(data: Path, model: str, form: str) -> str:
    """A saved model as "json", "h" or "py"."""
    from server.store import Store
    from server.store_models import compensation_of

    with Store(data) as store:
        return compensation_text(compensation_of(store.models.get(model)), form)


def compensation_text(compensation: "Compensation", form: str) -> str:
    from calib_core.compensation_c import write_c
    from calib_core.compensation_python import write_python

    if form == "json":
        return json.dumps(compensation.to_json(), indent=1, ensure_ascii=False) + "\n"
    return {"h": write_c, "py": write_python}[form](compensation)


def verify(data: Path, number: str) -> dict[str, Any]:
    from server import certify as room
    from server.store import Store

    with Store(data) as store:
        certificate = store.certificates.get(number)
        return dict(room.verify(certificate, store.recording(certificate["recording"]["id"])))


def document(data: Path, number: str, form: str, lang: str) -> bytes:
    """A certificate as "pdf", "csv" or "json"."""
    from server.documents import render
    from server.store import Store

    with Store(data) as store:
        return bytes(render(store.certificates.get(number), form, lang=lang))


def documents(data: Path, numbers: Sequence[str], lang: str) -> list[tuple[str, bytes]]:
    """All documents of some certificates, by file name."""
    from server.documents import FORMATS, render
    from server.store import Store

    with Store(data) as store:
        contents = [store.certificates.get(number) for number in numbers]
    return [(f"{content['number']}.{kind}", render(content, kind, lang)) for content in contents for kind in FORMATS]


def thesis() -> dict[str, Any]:
    from calib_core.thesis import report

    return dict(report())


def notebook(data: Path, notebook: str, lang: str) -> bytes:
    """A lab notebook as PDF."""
    from server.documents.notebook import render_notebook
    from server.store import Store

    with Store(data) as store:
        return bytes(render_notebook(store.notebooks.get(notebook), store.notebooks.lines(notebook), lang))
