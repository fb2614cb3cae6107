"""The project's benchmarks: figures beside what they have to reach, mostly as ratios to what users would use otherwise.

A subject is a list of modules here, each with ``run(*, quick: bool) -> list[Row]``.
"""

import importlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from calib_core.problem import Problem

SUBJECTS: dict[str, tuple[str, ...]] = {
    "core": ("core", "boards", "parsing", "calibration", "startup"),
    "bus": ("bus", "bus_daq"),
    "batch": ("batch", "batch_store", "batch_fleet"),
    "live": ("live",),
    "coverage": ("coverage",),
    "workbench": ("workbench",),
    "gap": ("gap", "gap_experiment", "gap_real", "gap_cost", "gap_peers"),
}


@dataclass(frozen=True)
class Row:
    """One figure. ``ours`` and ``theirs`` are the two sides of a ratio, in words; no limit: shown as it is."""

    name: str
    figure: float
    unit: str
    limit: float | None = None
    at_least: bool = False
    ours: str = ""
    theirs: str = ""

    @property
    def ok(self) -> bool:
        if self.limit is None:
            return True
        return bool(self.figure >= self.limit if self.at_least else self.figure <= self.limit)

    @property
    def ratio(self) -> float | None:
        """How many times better than its limit."""
        if self.limit is None:
            return None
        best, worst = (self.figure, self.limit) if self.at_least else (self.limit, self.figure)
        return float(best / worst) if worst else None

    def to_json(self) -> dict[str, object]:
        return {
            "name": self.name, "figure": float(self.figure), "unit": self.unit, "limit": self.limit,
            "at_least": self.at_least, "ratio": self.ratio, "ok": self.ok, "ours": self.ours, "theirs": self.theirs,
        }  # fmt: skip


def run(subject: str, *, quick: bool = False) -> Iterator[Row]:
    """The rows of a subject, module by module. Raises Problem bench.unknown."""
    if subject not in SUBJECTS:
        raise Problem("bench.unknown", given=subject, allowed=", ".join(SUBJECTS))
    for module in SUBJECTS[subject]:
        yield from importlib.import_module(f"server.bench.{module}").run(quick=quick)


def table(rows: Sequence[Row]) -> str:
    """The rows under one another: name, figure, limit, verdict; then the two sides of each ratio."""
    cells = [
        (
            row.name,
            f"{row.figure:.4g} {row.unit}".rstrip(),
            "" if row.limit is None else f"{'≥' if row.at_least else '≤'} {row.limit:g}",
            "" if row.limit is None else "ok" if row.ok else "MISSED",
            " against ".join(filter(None, (row.ours, row.theirs))),
        )
        for row in rows
    ]
    widths = [max((len(cell[k]) for cell in cells), default=0) for k in range(4)]
    return "\n".join(
        f"{c[0]:<{widths[0]}}  {c[1]:>{widths[1]}}  {c[2]:>{widths[2]}}  {c[3]:<{widths[3]}}  {c[4]}".rstrip()
        for c in cells
    )


def fastest(*works: Callable[[], object], rounds: int) -> list[float]:
    """CPU seconds of each work, the least of ``rounds`` taken in turns, so that a busy moment meets all of them."""
    best = [float("inf")] * len(works)
    for _ in range(rounds):
        for k, work in enumerate(works):
            start = time.process_time()
            work()
            best[k] = min(best[k], time.process_time() - start)
    return best


def per_sample(seconds: float) -> str:
    return f"{seconds * 1e9:.3g} ns" if seconds < 1e-6 else f"{seconds * 1e6:.3g} µs"
