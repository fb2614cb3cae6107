"""Searches of many people at once: long ones leave room for short ones, and who asks the same shares the answer."""

import asyncio
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from server.compute import tell
from server.searches import LONG, Searches


@pytest.fixture
def searches() -> Iterator[Searches]:
    searches = Searches()
    yield searches
    searches.close()


def waits_for(file: Path, limit_s: float = 30.0) -> int:
    tell("searching")
    limit = time.monotonic() + limit_s
    while not file.exists():
        assert time.monotonic() < limit, "nobody came"
        time.sleep(0.01)
    return os.getpid()


def touches(file: Path) -> int:
    with file.open("a", encoding="utf-8") as written:
        written.write("x")
    return os.getpid()


async def stage(searches: Searches, recording: str, wanted: str) -> None:
    while searches.progress(recording, "x")[0] != wanted:
        await asyncio.sleep(0.01)


def test_a_short_search_does_not_wait_for_long_ones_and_all_are_told_how_far_theirs_is(
    searches: Searches, tmp_path: Path
) -> None:
    gate = tmp_path / "gate"

    async def go() -> None:
        long = [
            asyncio.create_task(searches.run((name, "x"), LONG + 1, waits_for, gate)) for name in ("first", "second")
        ]
        await asyncio.wait_for(stage(searches, "first", "searching"), 30.0)
        assert searches.progress("second", "x")[0] == "queued"
        assert searches.progress("other", "x") == (None, 0.0)
        # Behind the long ones this would never run, and they would wait for ever.
        short = await asyncio.wait_for(searches.run(("short", "x"), 100, touches, gate), 30.0)
        first, second = await asyncio.wait_for(asyncio.gather(*long), 30.0)
        assert short != first
        assert searches.progress("second", "x")[0] is None
        assert os.getpid() not in (first, second, short)

    asyncio.run(go())


def test_the_same_question_is_searched_once_and_its_verdict_kept(searches: Searches, tmp_path: Path) -> None:
    file = tmp_path / "asked"

    async def go() -> None:
        async def ask(keep: bool = True) -> int:
            return await searches.run(("one", "x"), 100, touches, file, keep=keep)

        answers = await asyncio.gather(ask(), ask(), ask())
        assert len(set(answers)) == 1
        assert await ask() == answers[0]

    asyncio.run(go())
    assert file.read_text(encoding="utf-8") == "x"
