"""The workbench: how long an effect takes to be added, and what its page weighs."""

import gzip
import re
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from calib_core.effects import library
from server.bench import Row

WEB = Path(__file__).resolve().parents[2] / "web"
IMPORTED = re.compile(r'from "(\.[^"]+)"')
LINKED = re.compile(r'(?:href|src)="(/(?:css|js)/[^"]+)"')


def run(*, quick: bool = False) -> list[Row]:
    return [*_adding(quick), *_weight()]


def _adding(quick: bool) -> Iterator[Row]:
    """Every effect that the record has data for, added alone to the base; with the message that the page gets."""
    from calib_core.problem import Problem
    from server import examples, workbench
    from server.live import decode
    from server.store import Store

    warm_air = examples.EXAMPLES["warm_air"]
    example = replace(warm_air, name="bench", motion=(*warm_air.motion, examples.SLOW))
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder)
        with Store(data) as store:
            recording = store.recordings.add(examples.record(example), board="", name="bench")

        def fit(*effects: str) -> tuple[float, float, int]:
            wall, cpu = time.perf_counter(), time.process_time()
            answer = workbench.fit(data, recording, example.axis, effects, (), (None, None), 4000, "", "en")
            return time.process_time() - cpu, time.perf_counter() - wall, int(decode(answer)[0]["samples"])

        first, _, samples = fit()
        took = []
        for name in list(library())[: 6 if quick else None]:
            try:
                took.append(fit(name)[:2])
            except Problem:
                continue  # it has no data here, or no shape
    cpu, wall = (sorted(1e3 * one[k] for one in took) for k in (0, 1))
    told = f"{len(took)} effects, {samples} samples, message included; median {cpu[len(cpu) // 2]:.0f} ms"
    yield Row("workbench: add an effect, slowest, CPU", cpu[-1], "ms", 300.0, ours=told)
    yield Row(
        "workbench: the same by the clock on the wall", wall[-1], "ms", ours=f"median {wall[len(wall) // 2]:.0f} ms"
    )
    yield Row("workbench: first fit, CPU", first, "s")


def _weight() -> Iterator[Row]:
    """All that the page loads but its data, as it travels."""
    from server.app import vendored

    page = WEB / "workbench.html"
    files = {page, *(WEB / path[1:] for path in LINKED.findall(page.read_text(encoding="utf-8")))}
    waiting = [path for path in files if path.suffix == ".js"]
    while waiting:
        path = waiting.pop()
        for name in IMPORTED.findall(path.read_text(encoding="utf-8")):
            found = (path.parent / name).resolve()
            if found not in files:
                files.add(found)
                waiting.append(found)
    parts = vendored()
    plain = sum(parts[name].stat().st_size for name in ("uplot.iife.min.js", "uplot.min.css"))
    for lang, font in (("en", 0), ("th", parts["sarabun.ttf"].stat().st_size)):
        every = [*files, WEB / "i18n" / f"{lang}.json"]
        size = plain + font + sum(len(gzip.compress(path.read_bytes(), 6)) for path in every)
        yield Row(f"workbench: page without data, {lang}", size / 1000.0, "KB", 300.0, ours=f"{len(every) + 2} files")
