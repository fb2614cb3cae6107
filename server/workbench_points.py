"""The workbench on independent readings (``gyro-points 1``): the same messages, with the reference in time's place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from calib_core.problem import Problem
from server import diagnosis
from server.live import encode

if TYPE_CHECKING:
    from calib_core.points import Points

Words = dict[str, Any]


def _of(points: Points, axis: str | None, board: str) -> tuple[Points, list[list[str]]]:
    """The readings of one board and axis, the first where not said which, and every pair that there is."""
    pairs = [list(pair) for pair in dict.fromkeys(zip(points.board.tolist(), points.axis.tolist(), strict=True))]
    chosen = next((pair for pair in pairs if board in ("", pair[0]) and axis in (None, pair[1])), None)
    if chosen is None:
        raise Problem("diagnosis.no_axis", axis=axis or "", axes=", ".join(" ".join(pair) for pair in pairs))
    return points.take((points.board == chosen[0]) & (points.axis == chosen[1])), pairs


def signal(points: Points, axis: str | None, board: str) -> bytes:
    """Every reading against its reference."""
    own, pairs = _of(points, axis, board)
    order = np.argsort(own.reference, kind="stable")
    head = {
        "points": own.kind, "axis": str(own.axis[0]), "axes": pairs,
        "unit": "deg" if own.kind == "position" else "deg/s", "board": str(own.board[0]),
        "samples": len(own), "duration_s": 0.0,
    }  # fmt: skip
    return encode(head, {"time_s": own.reference[order], "measured": own.gyro[order]})


def fit(
    points: Points, axis: str, board: str, effects: Sequence[str], formulas: Sequence[Mapping[str, str]], lang: str
) -> bytes:
    """Offset, gain and effects on the readings, as ``server.workbench.fit`` answers."""
    from calib_core import formula, gap_points
    from calib_core.effects import library
    from calib_core.pictures import stretches

    own, _ = _of(points, axis, board)
    readings = gap_points.Readings(own)
    pool = library() | {one["name"]: formula.from_json(one) for one in formulas}
    columns = {column.name: column for column in readings.columns(pool)}
    missing = next((name for name in effects if name not in columns), None)
    if missing is not None:
        raise Problem("diagnosis.effect_not_possible", effect=missing)
    chosen = [columns[name] for name in dict.fromkeys(effects)]
    answer = diagnosis.told(
        diagnosis.explained(gap_points.diagnose(own, effects=[c.name for c in chosen], suspects=pool)), lang
    )
    residual, order = readings.fit(chosen).residual, np.argsort(readings.reference, kind="stable")
    reference, left = readings.reference[order], residual[order]
    spread = np.full(len(left), readings.scatter())
    arrays = {
        "time_s": reference, "measured": readings.gyro[order], "modelled": (readings.gyro - residual)[order],
        "window_s": reference, "residual": left, "spread": spread, "frequency_hz": np.empty(0), "density": np.empty(0),
    }  # fmt: skip
    name = f"{readings.axis}_{'position_deg' if readings.angles else 'rate_dps'}"
    along = {name: reference} | ({"duration_s": readings.duration_s[order]} if readings.angles else {})
    for covariate, values in along.items():
        middle, mean, sigma = stretches(values, left, spread)
        by = np.argsort(values, kind="stable")
        arrays |= {f"{covariate}/at": values[by], f"{covariate}/residual": left[by]}
        arrays |= {f"{covariate}/middle": middle, f"{covariate}/mean": mean, f"{covariate}/sigma": sigma}
    head = {
        "points": own.kind, "axis": readings.axis, "unit": readings.unit, "effects": [c.name for c in chosen],
        "samples": len(own), "whole": True, "parameters": answer["model"]["parameters"],
        "error": {
            "held_out": readings.held_out(chosen), "floor": readings.scatter(), "blocks": gap_points.BLOCKS,
            "unit": readings.unit,
        },
        "steps": [readings.held_out(chosen[:k]) for k in range(len(chosen) + 1)],
        "failures": answer["where_it_fails"], "along": [diagnosis.placed(n) for n in along], "white_density": 0.0,
    }  # fmt: skip
    return encode(diagnosis.plain(head), arrays)


def suspects(
    points: Points, axis: str, board: str, effects: Sequence[str], lang: str
) -> tuple[Words, float, tuple[str, ...]]:
    """The diagnosis told, the |z| that noise alone reaches, and the effects that a reading can show."""
    from calib_core import gap_points
    from calib_core.effects import library

    own, _ = _of(points, axis, board)
    readings = gap_points.Readings(own)
    columns = readings.columns(library())
    chosen = [column for column in columns if column.name in effects]
    asked = [column.name for column in chosen]
    answer = diagnosis.told(diagnosis.explained(gap_points.diagnose(own, effects=asked)), lang)
    free = [column for column in columns if column.name not in asked]
    threshold = gap_points.null_tail(readings.own(free, chosen), np.random.default_rng(0))
    return answer, threshold, tuple(column.name for column in columns)
