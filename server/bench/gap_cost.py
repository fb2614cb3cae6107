"""What a diagnosis costs: CPU seconds and memory, and how both grow."""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from server.bench import Row, fastest
from server.bench.gap_campaign import as_recording
from server.bench.gap_records import Record, record

MEGABYTE = 1 << 20
ALLOWED = 3 << 30
"""Address space of the process that takes 10⁶ samples: a diagnosis that wants more must not take the machine along."""


def run(*, quick: bool) -> Iterator[Row]:
    """The limits of issue 4, on this machine, in CPU time of the process itself."""
    rounds = 1 if quick else 3
    healthy, two = record(1, {}), record(2, {"bias_temperature": 1.0, "scale_factor_asymmetry": 1.0})
    for name, made, limit in (("nothing missing", healthy, 1.0), ("two effects", two, 3.0))[: 1 if quick else None]:
        seconds, said = _diagnosed(made, rounds)
        told = f"{len(made.segments)} samples, {said['verdict']}: {len(said['missing'])} named"
        yield Row(f"whole library, {name}", seconds, "s", limit, ours=told)
    if not quick:
        yield Row("one effect added by hand", _by_hand(two, rounds), "s", 0.3)
        yield from _large()
        yield from _scored(100_000)


def _scored(samples: int) -> Iterator[Row]:
    """Blocked cross-validation of every single and pair of thirty columns, fold by fold, beside scikit-learn's."""
    from calib_core.gap_gram import Bank, Folds, Gram

    rng = np.random.default_rng(1)
    columns = rng.standard_normal((samples, 32))
    columns[:, 1] = 1.0
    columns[:, 0] += columns[:, 2:6].sum(axis=1)
    time_s = np.asarray(np.arange(samples) * 0.01, np.float64)
    singles, pairs = np.arange(2, 32)[:, None], np.array(list(combinations(range(2, 32), 2)))
    found: dict[str, float] = {}

    def ours() -> None:
        gram = Gram(Bank(Folds.of(time_s), columns).parts, np.zeros(1))
        found["ours"] = float(np.concatenate([gram.scores(singles), gram.scores(pairs)]).min())

    def theirs() -> None:
        from sklearn.linear_model import LinearRegression
        from sklearn.model_selection import GroupKFold, cross_val_score

        folds = Folds.of(time_s)
        groups, parts = folds.of_time(time_s), GroupKFold(len(folds))
        score = cross_val_score(
            LinearRegression(), columns[:, pairs[0]], columns[:, 0], groups=groups, cv=parts,
            scoring="neg_mean_squared_error",
        )  # fmt: skip
        found["theirs"] = float(score.mean())

    models = len(singles) + len(pairs)
    try:
        theirs()
    except ImportError:
        yield Row("score of a single model", float("nan"), "", ours="not installed: uv sync --group bench")
        return
    own, other = fastest(ours, theirs, rounds=3)
    told = f"{own * 1e3:.3g} ms for {models} models, {samples} rows"
    ratio = other / (own / models)
    limit = None if samples < 100_000 else 1500.0
    yield Row(
        "score of a single model, times faster", ratio, "1", limit, True, told, f"scikit-learn {other * 1e3:.3g} ms"
    )


def _diagnosed(made: Record, rounds: int) -> tuple[float, dict[str, Any]]:
    from server.diagnosis import of_recording

    recording, said = as_recording(made), {}
    if rounds > 1:
        of_recording(recording)  # imports and caches are paid once

    def work() -> None:
        said.update(of_recording(recording))

    return fastest(work, rounds=rounds)[0], said


def _by_hand(made: Record, rounds: int) -> float:
    """A diagnosis is there; one named effect goes into its model, with parameters and error on unseen data."""
    from calib_core.effects import library
    from calib_core.gap import diagnose
    from calib_core.gap_error import Explanation
    from calib_core.gap_report import parameters

    said = diagnose(as_recording(made), "x")
    assert said.search is not None
    space = said.search.space

    def work() -> None:
        explained = Explanation(space, [space.term(library()["scale_factor_asymmetry"])])
        explained.error()
        parameters(explained)

    return fastest(work, rounds=rounds)[0]


def _large() -> Iterator[Row]:
    """10⁶ samples in a process of their own, beside a quarter of them."""
    small, large = (_in_own_process(n) for n in (250_000, 1_000_000))
    yield Row("10⁶ samples", large["cpu_s"], "s", 30.0, ours=f"{large['samples']} samples, {large['verdict']}")
    yield Row(
        "10⁶ samples, memory", large["peak_MB"], "MB", 1024.0, ours=f"{large['before_MB']:.0f} MB before it starts"
    )
    growth = (large["cpu_s"] / small["cpu_s"]) / (large["samples"] / small["samples"])
    told = f"{small['cpu_s']:.1f} s for {small['samples']}"
    yield Row("time of a sample among 10⁶ beside one among 2.5·10⁵", growth, "1", 1.2, ours=told)


def _in_own_process(samples: int) -> dict[str, Any]:
    """Peak memory is known only for a whole process; the recording is made in another."""
    with tempfile.TemporaryDirectory(prefix="gyrobench-") as folder:
        file = Path(folder, "long.npz")
        np.savez(file, **_long(samples))  # type: ignore[arg-type]
        done = subprocess.run(
            [sys.executable, "-m", "server.bench.gap_cost", str(file)],
            capture_output=True, text=True, cwd=Path(__file__).resolve().parents[2],
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
    nothing = {"cpu_s": math.inf, "peak_MB": math.inf, "before_MB": 0.0, "samples": samples}
    last = (done.stderr.strip().splitlines() or [""])[-1]
    return dict(json.loads(done.stdout)) if done.returncode == 0 else nothing | {"verdict": f"failed: {last}"}


def _long(samples: int) -> dict[str, np.ndarray[Any, Any]]:
    """Columns of many records of one healthy board, one after the other, each with a motion of its own."""
    parts: list[dict[str, np.ndarray[Any, Any]]] = []
    total, end = 0, 0.0
    while total < samples:
        part = record(1000 + len(parts), {}, plan="second", board=(1.25, 0.0059)).columns
        part = part | {"time_s": part["time_s"] + end}
        end = float(part["time_s"][-1]) + 0.01
        total += len(part["time_s"])
        parts.append(part)
    return {name: np.concatenate([part[name] for part in parts])[:samples] for name in parts[0]}


def _main(file: str) -> None:
    import resource

    from calib_core.recording import Recording
    from server.diagnosis import of_recording

    def peak_MB() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / MEGABYTE

    resource.setrlimit(resource.RLIMIT_AS, (ALLOWED, ALLOWED))
    with np.load(file) as stored:
        columns = {name: stored[name] for name in stored}
    time_s = columns.pop("time_s")
    recording = Recording(time_s, columns, np.zeros(len(time_s), np.int32), ("",), {"axis": "x"})
    before, start = peak_MB(), time.process_time()
    said = of_recording(recording)
    found = {"cpu_s": time.process_time() - start, "peak_MB": peak_MB(), "before_MB": before}
    print(json.dumps(found | {"samples": len(time_s), "verdict": said["verdict"]}))


if __name__ == "__main__":
    _main(sys.argv[1])
