"""The engine: a plan and a rig become a run, which is a generator of documents.

`start, descriptor, (state, rows*, state_end)*, stop`, each with the run's id, a sequence number and the wall time.
Raw facts only: fits are made from what was stored. However it ends – done, stopped, a fault, the consumer closing the
generator – the rig is left safe.
"""

import itertools
import json
import logging
import math
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from calib_core import sequence
from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.sequence import Plan, State
from server import __version__
from server.devices.rehearsal import rehearse
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
    """Lets bench time go at most `speed` times as fast as the clock; infinity never waits, hardware paces itself."""

    def __init__(self, speed: float = math.inf, clock: Callable[[], float] = time.monotonic) -> None:
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
        if math.isinf(self.speed):
            return
        now = self._clock()
        # What a slow consumer lost is caught up, but never more than one block of it.
        self._due_s = max(self._due_s + bench_s / self.speed, now - BLOCK_WALL_S)
        if self._due_s > now:
            abort.wait(self._due_s - now)


@dataclass(frozen=True, kw_only=True)
class Document:
    """What all documents say: which run, its number in the run from 0, and when (Unix time)."""

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


Documents = Generator[Document, None, None]


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
) -> Documents:
    """Run the plan. `header` is added to the recording's; `clock` gives the documents' times.

    Without `pace` a simulated rig runs as fast as it can, a real one at its own time, which is the only one it has.
    The whole plan is checked against the rig before anything else: `Problem` is raised and nothing has moved.
    After that a failure ends the run with a `Stop` that says what happened, and is not raised.
    """
    if pace is None:
        pace = Pacer(math.inf if rig.simulated else 1.0)
    if pace.speed != 1.0 and not rig.simulated:
        raise Problem("rig.speed_fixed", given=pace.speed)
    sequence.check(plan, rig.axes)
    return _run(plan, rig, run_id, board, header or {}, abort or threading.Event(), pace, clock)


def _run(
    plan: Plan,
    rig: Rig,
    run_id: str,
    board: str,
    header: Mapping[str, str],
    abort: Abort,
    pace: Pacer,
    clock: Callable[[], float],
) -> Documents:
    numbers = itertools.count()

    def stamp() -> dict[str, Any]:
        return {"run": run_id, "seq": next(numbers), "time": clock()}

    stopped: dict[str, Any] = {"status": "stopped", "code": "run.stopped"}
    outcome: dict[str, Any] = {"status": "finished"}
    try:
        yield Start(**stamp(), plan=plan.to_json(), seed=plan.seed, duration_s=plan.duration_s)
        rig.mount(board, plan.gyro_model)
        rehearse(rig, board, plan.gyro_model, abort)
        rig.begin()
        sequence.check(plan, rig.axes)  # again: an open rig knows its supply and so its top speed
        described = {**_header(plan, board), **rig.header, **header}
        yield Descriptor(**stamp(), columns=rig.columns, rate_hz=1.0 / ROW_S, header=described)
        before_s = 0.0
        for index, state in enumerate(plan.states):
            yield StateBegin(
                **stamp(), state=state.name, index=index, axis=state.axis, kind=state.kind, readings=state.readings,
                duration_s=state.duration_s,
            )  # fmt: skip
            done, done_s, segment = 0, 0.0, "rest"
            for step in state.steps:
                yield from (  # on a busy computer the end of a stroke comes late: it belongs to its stroke
                    Rows(**stamp(), state=state.name, segment=segment, columns=block.columns,
                         progress=_progress(plan, state, before_s, done_s, done))
                    for block in rig.waiting()
                )  # fmt: skip
                segment = step.segment
                if abort.is_set():
                    raise Aborted
                rig.heat(step.heater)
                rig.start(step.motions)
                for seconds in _blocks(step.duration_s, pace.block_s):
                    if abort.is_set():
                        raise Aborted
                    block = rig.read(seconds)
                    done_s += seconds
                    yield Rows(
                        **stamp(), state=state.name, segment=step.segment, columns=block.columns,
                        progress=_progress(plan, state, before_s, done_s, done),
                        fast=block.fast if step.keep_fast else None,
                    )  # fmt: skip
                    pace.wait(seconds, abort)
                done += "/" in step.segment
            before_s += state.duration_s
            yield StateEnd(**stamp(), state=state.name, index=index)
    except Aborted:
        outcome = stopped
    except Problem as problem:
        # An emergency stop takes the devices away from under a read: that is no fault of theirs.
        outcome = stopped if abort.is_set() else _failed(problem.code, **problem.values)
    except Exception as error:
        log.exception("run %s failed", run_id)
        outcome = _failed("internal", kind=type(error).__name__, detail=str(error))
    finally:
        # Also when the consumer closes the generator; then nothing may be yielded any more.
        try:
            rig.safe()
        except Exception as error:
            log.exception("run %s: the rig could not be made safe", run_id)
            if outcome["status"] != "failed":  # else the fault that ended the run says what to do
                outcome = _failed("rig.not_safe", reason=str(error))
    yield Stop(**stamp(), **outcome)


def _failed(code: str, /, **values: object) -> dict[str, Any]:
    return {"status": "failed", "code": code, "values": values}


def _blocks(duration_s: float, block_s: float) -> Iterator[float]:
    """A step's duration in blocks of whole rows, the last one shorter."""
    rows, of_block = round(duration_s / ROW_S), round(block_s / ROW_S)
    for first in range(0, rows, of_block):
        yield min(of_block, rows - first) * ROW_S


def _progress(plan: Plan, state: State, before_s: float, done_s: float, readings: int) -> Progress:
    return Progress(
        done=readings,
        of=state.readings,
        state_fraction=done_s / state.duration_s,
        run_fraction=(before_s + done_s) / plan.duration_s,
        seconds_left=max(0.0, plan.duration_s - before_s - done_s),
    )


def _header(plan: Plan, board: str) -> dict[str, str]:
    asked = plan.to_json()
    return {
        "format": "gyro-recording 1",
        "board": board,
        "sensor": plan.gyro_model.name,
        "reference": "encoder",
        "profile": plan.profile,
        "seed": str(plan.seed),
        "readings": str(plan.readings),
        "states": ",".join(asked["states"]),
        "ranges": json.dumps(asked["ranges"]),
        "gyro_model": json.dumps(asked["gyro_model"], ensure_ascii=False),
        "software": f"gyrobench {__version__}",
    }


def record(plan: Plan, rig: Rig, **options: Any) -> Recording:
    """The whole run as one Recording, without a store; options as for `run`. Raises the failure that ended it."""
    header: Mapping[str, str] = {}
    blocks: list[Rows] = []
    for document in run(plan, rig, **options):
        match document:
            case Descriptor():
                header = document.header
            case Rows():
                blocks.append(document)
            case Stop() if document.status != "finished":
                raise Problem(document.code, **document.values)
    names: dict[str, int] = {}
    codes = [names.setdefault(block.segment, len(names)) for block in blocks]
    lengths = [len(block.columns["time_s"]) for block in blocks]
    columns = {name: np.concatenate([block.columns[name] for block in blocks]) for name in blocks[0].columns}
    return Recording(columns.pop("time_s"), columns, np.repeat(codes, lengths).astype(np.int32), tuple(names), header)
