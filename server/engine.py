"""The engine: a plan and a rig become a run, which is a generator of documents.

`start, descriptor, (state, rows*, state_end)*, stop`, each with the run's id, a sequence number and the wall time.
Raw facts only: fits are made from what was stored. However it ends – done, stopped, a fault, the consumer closing the
generator – the rig is left safe.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from calib_core import sequence
from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.sequence import Plan, State
from server.devices import DeviceError
from server.devices.rig import ROW_S, Rig

F64 = NDArray[np.float64]
log = logging.getLogger(__name__)

BLOCK_WALL_S = 0.05
LONGEST_BLOCK_S = 2.0


class Abort(Protocol):
    """What `threading.Event` and `multiprocessing.Event` are."""

    def is_set(self) -> bool: ...
    def wait(self, timeout: float | None = None) -> bool: ...


class Pacer:
    """Lets bench time go `speed` times as fast as the clock; infinity waits for nothing, as does hardware at 1."""

    def __init__(self, speed: float = np.inf, clock: Callable[[], float] = time.monotonic) -> None:
        if not speed > 0.0:
            raise Problem("rig.speed", given=speed)
        self.speed, self._clock = speed, clock
        self._due_s = clock()

    @property
    def block_s(self) -> float:
        """Bench time of one block: about 50 ms of wall time, in whole rows."""
        seconds = min(BLOCK_WALL_S * self.speed, LONGEST_BLOCK_S)
        return max(1, round(seconds / ROW_S)) * ROW_S

    def wait(self, bench_s: float, abort: Abort) -> None:
        """Wait until `bench_s` more of bench time may have passed, or abort."""
        if np.isinf(self.speed):
            return
        now = self._clock()
        # What a slow consumer lost is caught up, but never more than one block of it.
        self._due_s = max(self._due_s + bench_s / self.speed, now - BLOCK_WALL_S)
        if self._due_s > now:
            abort.wait(self._due_s - now)


@dataclass(frozen=True, kw_only=True)
class Document:
    """What all documents say: which run, the how-manieth, and when (Unix time)."""

    run: str
    seq: int
    time: float


@dataclass(frozen=True, kw_only=True)
class Start(Document):
    plan: Mapping[str, Any]  # Plan.to_json()
    seed: int
    duration_s: float


@dataclass(frozen=True, kw_only=True)
class Descriptor(Document):
    """What the rows will look like and what a recording's header has to keep."""

    columns: tuple[str, ...]
    rate_hz: float
    header: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class StateBegin(Document):
    state: str
    index: int
    axis: str
    kind: str
    readings: int
    duration_s: float


@dataclass(frozen=True)
class Progress:
    """`done` of `of` test readings of this state, fractions of its and the run's bench time, bench seconds left."""

    done: int
    of: int
    state_fraction: float
    run_fraction: float
    seconds_left: float


@dataclass(frozen=True, kw_only=True)
class Rows(Document):
    """A block of rows of one segment: columns (n,) as in a recording, `time_s` among them; `fast` at 1 kHz, or None."""

    state: str
    segment: str
    columns: Mapping[str, F64]
    progress: Progress
    fast: Mapping[str, F64] | None = None


@dataclass(frozen=True, kw_only=True)
class StateEnd(Document):
    state: str
    index: int


@dataclass(frozen=True, kw_only=True)
class Stop(Document):
    """`status`: finished, stopped or failed; `code` and `values` name the sentence that says why."""

    status: str
    code: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)


class Aborted(Exception):
    """The operator stopped the run."""


def run(
    plan: Plan,
    rig: Rig,
    *,
    run_id: str = "",
    board: str = "",
    header: Mapping[str, str] | None = None,
    abort: Abort | None = None,
    pace: Pacer | None = None,
    clock: Callable[[], float] = time.time,
) -> Iterator[Document]:
    """Run the plan. `header` is added to the recording's; `clock` gives the documents' times.

    The whole plan is checked against the rig before the first document: `Problem` is raised, nothing has moved.
    After that a failure ends the run with a `Stop` that says what happened, and is not raised.
    """
    sequence.check(plan, rig.axes)
    return _run(plan, rig, run_id, board, header or {}, abort or threading.Event(), pace or Pacer(), clock)


def _run(
    plan: Plan,
    rig: Rig,
    run_id: str,
    board: str,
    header: Mapping[str, str],
    abort: Abort,
    pace: Pacer,
    clock: Callable[[], float],
) -> Iterator[Document]:
    seq = -1

    def stamp() -> dict[str, Any]:
        nonlocal seq
        seq += 1
        return {"run": run_id, "seq": seq, "time": clock()}

    outcome: dict[str, Any] = {"status": "finished"}
    try:
        yield Start(**stamp(), plan=plan.to_json(), seed=plan.seed, duration_s=plan.duration_s)
        rig.mount(board)
        rig.begin()
        yield Descriptor(**stamp(), columns=rig.columns, rate_hz=1.0 / ROW_S, header=_header(plan, rig, board, header))
        done_s = 0.0
        for index, state in enumerate(plan.states):
            yield StateBegin(
                **stamp(), state=state.name, index=index, axis=state.axis, kind=state.kind, readings=state.readings,
                duration_s=state.duration_s,
            )  # fmt: skip
            for segment, columns, fast, in_state_s, readings in _state(state, rig, abort, pace):
                progress = Progress(
                    done=readings,
                    of=state.readings,
                    state_fraction=in_state_s / state.duration_s,
                    run_fraction=(done_s + in_state_s) / plan.duration_s,
                    seconds_left=plan.duration_s - done_s - in_state_s,
                )
                yield Rows(**stamp(), state=state.name, segment=segment, columns=columns, progress=progress, fast=fast)
            done_s += state.duration_s
            yield StateEnd(**stamp(), state=state.name, index=index)
    except Aborted:
        outcome = {"status": "stopped", "code": "run.stopped"}
    except Problem as problem:
        outcome = {"status": "failed", "code": problem.code, "values": problem.values}
    except Exception as error:
        log.exception("run %s failed", run_id)
        outcome = {"status": "failed", "code": "internal",
                   "values": {"kind": type(error).__name__, "detail": str(error)}}  # fmt: skip
    finally:
        try:
            rig.safe()
        except DeviceError as fault:
            log.exception("run %s: the rig could not be made safe", run_id)
            outcome = {"status": "failed", "code": "rig.not_safe", "values": {"reason": fault.code}}
    yield Stop(**stamp(), **outcome)


_Part = tuple[str, Mapping[str, F64], Mapping[str, F64] | None, float, int]


def _state(state: State, rig: Rig, abort: Abort, pace: Pacer) -> Iterator[_Part]:
    """Blocks of one state: segment, columns, fast samples where they are kept, bench time and readings so far."""
    in_state_s, readings = 0.0, 0
    for step in state.steps:
        rig.start(step.motions)
        left_s = step.duration_s
        while left_s > ROW_S / 2:
            if abort.is_set():
                raise Aborted
            seconds = min(pace.block_s, left_s)
            block = rig.read(seconds)
            left_s -= seconds
            in_state_s += seconds
            if left_s <= ROW_S / 2 and "/" in step.segment:
                readings += 1
            yield step.segment, block.columns, block.fast if step.keep_fast else None, in_state_s, readings
            pace.wait(seconds, abort)


def _header(plan: Plan, rig: Rig, board: str, more: Mapping[str, str]) -> dict[str, str]:
    return {
        "format": "gyro-recording 1",
        "board": board,
        "sensor": plan.gyro_model.name,
        "reference": "encoder",
        "profile": plan.profile,
        "seed": str(plan.seed),
        "readings": str(plan.readings),
        "states": ",".join(state.name for state in plan.states),
        **rig.header,
        **more,
    }


def record(plan: Plan, rig: Rig, **options: Any) -> Recording:
    """The whole run as one Recording, without a store; options as for `run`. Raises the failure that ended it."""
    header: Mapping[str, str] = {}
    blocks: list[Rows] = []
    for document in run(plan, rig, **options):
        if isinstance(document, Descriptor):
            header = document.header
        elif isinstance(document, Rows):
            blocks.append(document)
        elif isinstance(document, Stop) and document.status != "finished":
            raise Problem(document.code, **document.values)
    codes: dict[str, int] = {}
    counts = [len(block.columns["time_s"]) for block in blocks]
    of_block = [codes.setdefault(block.segment, len(codes)) for block in blocks]
    columns = {name: np.concatenate([block.columns[name] for block in blocks]) for name in blocks[0].columns}
    return Recording(columns.pop("time_s"), columns, np.repeat(of_block, counts).astype(np.int32), tuple(codes), header)
