"""The workbench's side of the server: recordings kept warm in the compute process, and what a page draws of them.

A fit is answered as one message of ``server.live.encode``: a JSON head and short Float64 columns.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib_core.problem import Problem
from server import diagnosis
from server.live import encode
from server.texts import render

if TYPE_CHECKING:
    from calib_core.workbench import Fitted, Workbench

Words = dict[str, Any]

WARM = 3
"""So many recordings stay ready; one of 22 000 samples takes some 40 MB."""
UNSHAPED = ("adc_quantization", "bias_random_walk", "input_loading", "mains_hum", "saturation")
"""Effects that have a test of their own and no shape that a fit could add."""
PATH_HZ = 25.0
"""Fine enough to draw a motion of 4 Hz."""
_warm: OrderedDict[tuple[Path, str, str], Workbench] = OrderedDict()


def warm(data: Path, recording: str, axis: str) -> Workbench:
    """The recording's workbench, made at the first question about it."""
    from calib_core.workbench import Workbench
    from server.store import Store

    key = (data, recording, axis)
    if key not in _warm:
        with Store(data) as store:
            loaded = store.recording(recording)
        if axis not in loaded.axes:
            raise Problem("diagnosis.no_axis", axis=axis, axes=", ".join(loaded.axes))
        _warm[key] = Workbench(loaded, axis)
        while len(_warm) > WARM:
            _warm.popitem(last=False)
    _warm.move_to_end(key)
    return _warm[key]


def signal(data: Path, recording: str, axis: str | None, points: int) -> bytes:
    """The measured output alone, for the first picture: no arithmetic beyond picking what a screen shows."""
    from calib_core.workbench import decimated
    from server.store import Store

    with Store(data) as store:
        loaded = store.recording(recording)
    named = loaded.header.get("axis", "")
    axis = axis or (named if named in loaded.axes else loaded.axes[0])
    if axis not in loaded.axes:
        raise Problem("diagnosis.no_axis", axis=axis, axes=", ".join(loaded.axes))
    gyro = loaded.gyro(axis)
    known = np.flatnonzero(np.isfinite(gyro.values))
    at = known[decimated(gyro.values[known], points)]
    head = {
        "axis": axis, "axes": list(loaded.axes), "unit": gyro.unit, "board": loaded.header.get("board", ""),
        "samples": len(known), "duration_s": loaded.duration_s, "segments": list(loaded.segment_names)[:200],
    }  # fmt: skip
    return encode(head, {"time_s": loaded.time_s[at] - loaded.time_s[known[0]], "measured": gyro.values[at]})


def fit(
    data: Path,
    recording: str,
    axis: str,
    effects: Sequence[str],
    formulas: Sequence[Mapping[str, str]],
    window: tuple[float | None, float | None],
    points: int,
    lang: str,
) -> bytes:
    """Base and effects on a recording, with everything that a page draws of it."""
    from calib_core import formula
    from calib_core.workbench import decimated, spectrum, stretches

    bench = warm(data, recording, axis)
    for own in formulas:
        bench.own(formula.from_json(own))
    fitted = bench.fit(effects)
    samples = fitted.space.design.averages.samples
    time = samples.time_s - samples.time_s[0]
    begin, end = (time[0] if window[0] is None else window[0], time[-1] if window[1] is None else window[1])
    inside = slice(int(np.searchsorted(time, begin)), max(2, int(np.searchsorted(time, end, side="right"))))
    at = inside.start + decimated(samples.output[inside], points)
    scale = abs(fitted.space.scale_factor) or 1.0
    f, density = spectrum((samples.output - fitted.modelled) / scale, samples.interval_s)
    arrays = {
        "time_s": time[at], "measured": samples.output[at], "modelled": fitted.modelled[at],
        "window_s": fitted.middle_s, "residual": fitted.residual_dps, "spread": fitted.spread_dps,
        "frequency_hz": f, "density": density,
    }  # fmt: skip
    for name, values in {"time_s": fitted.middle_s, **fitted.along}.items():
        middle, mean, sigma = stretches(values, fitted.residual_dps, fitted.spread_dps)
        order = np.argsort(values, kind="stable")
        arrays |= {f"{name}/at": values[order], f"{name}/residual": fitted.residual_dps[order]}
        arrays |= {f"{name}/middle": middle, f"{name}/mean": mean, f"{name}/sigma": sigma}
    head = {
        "axis": axis, "unit": samples.unit, "effects": list(fitted.effects),
        "whole": len(at) == inside.stop - inside.start,
        "from": float(time[0]), "to": float(time[-1]), "samples": len(time), "error": _error(fitted),
        "steps": [_error(bench.fit(fitted.effects[:k]))["held_out"] for k in range(len(fitted.effects) + 1)],
        "parameters": _parameters(fitted), "failures": _failures(fitted, lang),
        "along": [{"name": n, **diagnosis.along(n)["values"], "kind": _kind(n)} for n in ("time_s", *fitted.along)],
        "noise": _noise(fitted),
    }  # fmt: skip
    return encode(diagnosis.plain(head), arrays)


def suspects(data: Path, recording: str, axis: str, effects: Sequence[str], lang: str) -> Words:
    """The verdict on the base, and every effect of the library with its evidence beside ``effects``."""
    from calib_core.gap import p_value
    from calib_core.gap_report import to_json

    bench = warm(data, recording, axis)
    answer = diagnosis.told(diagnosis.explained(to_json(bench.diagnosis)), lang)
    rows = {c["effect"]: _row(c) for c in answer["candidates"]}
    tested = sum(row["status"] == "tested" for row in rows.values()) or 1
    if effects:
        ranked = bench.ranked(effects)
        for name, row in rows.items():
            if name in ranked:
                gain, z = ranked[name]
                row |= {"two_delta_lnL": gain, "z": z, "p": p_value(z), "status": "tested"}
            elif name in bench.effects and name not in effects:
                row |= {"two_delta_lnL": None, "z": None, "p": None, "status": "not_excited"}
        over = [row for row in rows.values() if (row["z"] or 0.0) >= bench.threshold and row["effect"] not in effects]
        best = max((row["two_delta_lnL"] for row in over), default=0.0)
        ties = [[row["effect"] for row in over if best - row["two_delta_lnL"] < 6.0]] if len(over) > 1 else []
    else:
        for found in answer["missing"]:
            rows[found["effect"]] |= {"two_delta_lnL": found["two_delta_lnL"], "p": found["p"], "status": "tested"}
            rows[found["effect"]]["z"] = _z(found["p"], found["two_delta_lnL"])
        ties = answer["rivals"]
        for names in ties:
            first = rows[names[0]]
            for name in names[1:]:
                rows[name] |= {key: first[key] for key in ("two_delta_lnL", "z", "p")} | {"status": "tested"}
    for name, row in rows.items():
        row["tie"] = next((k for k, names in enumerate(ties) if name in names and len(names) > 1), None)
        row["in_model"] = name in effects
        row["can_be_added"] = name in bench.effects
        row |= _evidence(row, bench.threshold, tested)
        row["sentence"] = render(row["code"], row["values"], lang)
        row["title"] = render(f"effects.{name}.name", {}, lang)
    order = sorted(rows.values(), key=lambda r: (r["status"] != "tested", -(r["z"] or 0.0), r["effect"]))
    verdict = {key: answer[key] for key in ("verdict", "sentence", "code", "values", "checks", "limits", "unknown")}
    return dict(diagnosis.plain({**verdict, "threshold": bench.threshold, "suspects": order}))


def path(motion: Sequence[Mapping[str, Any]]) -> Words:
    """Times and commanded angles of the axes that a motion moves; the first axis alone where none does."""
    from calib_core.excitation import Excitation, commanded, steps

    planned = steps([Excitation.from_json(one) for one in motion], "path")
    angles = commanded(planned, PATH_HZ)
    moved = [axis for axis, values in angles.items() if np.ptp(values) > 0.0] or [motion[0]["axis"]]
    time = np.arange(len(next(iter(angles.values())))) / PATH_HZ
    return {"time_s": time.tolist(), "angle_deg": {axis: np.round(angles[axis], 3).tolist() for axis in moved}}


def _row(candidate: Mapping[str, Any]) -> Words:
    z = _z(candidate["p"], candidate["two_delta_lnL"]) if candidate["status"] == "tested" else None
    return {**candidate, "z": z}


def _z(p: float | None, gain: float | None) -> float:
    """The |z| of a chance, by the gain where the chance is too small to be told from nought."""
    from scipy.special import ndtri

    if p is None or p < 1e-250:
        return float(np.sqrt(max(gain or 0.0, 0.0)))
    return float(-ndtri(p / 2.0))


def _evidence(row: Mapping[str, Any], threshold: float, tested: int) -> Words:
    name = row["effect"]
    if row["in_model"]:
        return {"word": "in_model", "code": "workbench.evidence.in_model", "values": {}}
    if row["status"] != "tested":
        return {"word": row["status"], "code": f"workbench.evidence.{row['status']}", "values": {}}
    if name in UNSHAPED and not row["two_delta_lnL"]:
        return {"word": "nothing", "code": "workbench.evidence.by_itself", "values": {}}
    if (row["z"] or 0.0) < threshold and name not in UNSHAPED:
        return {"word": "nothing", "code": "workbench.evidence.nothing", "values": {}}
    chance = 0.0 if row["p"] is None else min(1.0, row["p"] * tested)
    found = diagnosis.certainty(diagnosis.effect_words([name]), chance)
    return {"word": found["code"].rpartition(".")[2], **found}


def _kind(name: str) -> str:
    return next((kind for ending, kind in diagnosis.KINDS.items() if name.endswith(ending)), "other")


def _noise(fitted: Fitted) -> Words:
    noise, scale = fitted.space.noise.noise, abs(fitted.space.scale_factor) or 1.0
    white = noise.white / scale
    interval = fitted.space.design.averages.samples.interval_s
    correlated = {"ar1_dps": noise.ar1 / scale, "correlation_time_s": noise.correlation_time_s}
    return {"white_dps": white, "density": white * float(np.sqrt(2.0 * interval)), **correlated}


def _error(fitted: Fitted) -> Words:
    error = fitted.error
    floor = {"floor": error.floor_rms_dps, "block_s": error.block_s, "blocks": error.blocks}
    return {"held_out": error.held_out_rms_dps, **floor, "unit": "deg/s"}


def _parameters(fitted: Fitted) -> list[Words]:
    from calib_core.gap_report import parameters

    return parameters(fitted.explanation)


def _failures(fitted: Fitted, lang: str) -> list[Words]:
    """The worst stretch of each covariate that fails, worst first."""
    from calib_core.gap_report import FAILING

    found = []
    for f in fitted.failures():
        if abs(f.z) >= FAILING:
            told: Words = {
                "covariate": f.covariate,
                "from": f.low,
                "to": f.high,
                "residual_dps": f.residual_dps,
                "z": f.z,
            }
            told |= diagnosis.failing(told)
            found.append(told | {"sentence": render(told["code"], told["values"], lang)})
    return found
