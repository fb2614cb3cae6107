"""Searches of the effect library for everybody: seconds for a short record, much longer for a whole session.

Two processes, of which long searches take one at most, so that nobody waits for another's session; whoever asks for
what is being searched shares the answer; and all can be told how far it is.
"""

import asyncio
import itertools
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar

from server.compute import SLOTS, Compute

T = TypeVar("T")

PROCESSES = 2
LONG = 60_000
"""Samples from which a search is long; that of a session of 45 minutes takes 0.8 GB while it lasts."""
KEPT = 64
"""So many verdicts are kept: the next student who opens an example need not wait."""
Key = tuple[object, ...]


@dataclass
class Job:
    slot: int
    asked: float
    began: float | None = None
    """None while it waits for others."""
    answer: "asyncio.Task[Any] | None" = None


class Searches:
    def __init__(self) -> None:
        self._compute = Compute(PROCESSES, niceness=5)
        self._places, self._long = asyncio.Semaphore(PROCESSES), asyncio.Semaphore(1)
        self._slots = itertools.cycle(range(SLOTS))
        self._jobs: dict[Key, Job] = {}
        self._kept: OrderedDict[Key, Any] = OrderedDict()

    async def run(self, key: Key, samples: int, work: Callable[..., T], *arguments: object, keep: bool = False) -> T:
        """``work`` on a recording of ``samples``; ``key`` begins with recording and axis and says what is asked.

        With ``keep`` the answer is there for those who ask later: it must depend on the key alone.
        """
        kept: T | None = self.known(key)
        if kept is not None:
            return kept
        if key not in self._jobs:
            job = self._jobs[key] = Job(next(self._slots), time.monotonic())
            job.answer = asyncio.create_task(self._do(key, job, samples, work, *arguments))
        task = self._jobs[key].answer
        assert task is not None
        # One who leaves takes the answer from nobody.
        answer: T = await asyncio.shield(task)
        if keep:
            self._kept[key] = answer
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        return answer

    def known(self, key: Key) -> Any:
        """The answer that is kept; None where there is none."""
        if key in self._kept:
            self._kept.move_to_end(key)
        return self._kept.get(key)

    async def _do(self, key: Key, job: Job, samples: int, work: Callable[..., T], *arguments: object) -> T:
        try:
            async with self._long if samples > LONG else nullcontext(), self._places:
                job.began = time.monotonic()
                return await self._compute.run(work, *arguments, slot=job.slot)
        finally:
            del self._jobs[key]

    def progress(self, recording: str, axis: str) -> tuple[str | None, float]:
        """The stage of the search that goes on for an axis, None where there is none, and since when, in seconds."""
        for key, job in self._jobs.items():
            if key[:2] == (recording, axis):
                stage = "queued" if job.began is None else self._compute.stage(job.slot)
                return stage, time.monotonic() - job.asked
        return None, 0.0

    def close(self) -> None:
        self._compute.close()
