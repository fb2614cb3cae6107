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
from server import diagnosis, untested, workbench_points
from server.compute import tell
from server.live import encode
from server.texts import render, texts

if TYPE_CHECKING:
    from calib_core.noise_fit import NoiseFit
    from calib_core.points import Points
    from calib_core.workbench import Model, Workbench

Words = dict[str, Any]

WARM = 3
"""So many recordings stay ready; one of 22 000 samples takes some 40 MB."""
STILL_DPS, MOVED = 0.5, 0.05
"""An axis that turned faster in less than this share of the time went to its zero, and stood still."""
NAMED = 3
"""So many effects that could not be tested are named in a headline; of more their number is told."""
SURE = ("certain", "likely", "probable")
PATH_HZ = 25.0
"""Fine enough to draw a motion of 4 Hz."""
_warm: OrderedDict[tuple[Path, str, str, int], Workbench] = OrderedDict()


def warm(data: Path, recording: str, axis: str) -> Workbench:
    """The recording's workbench, made at the first question about it."""
    from calib_core.workbench import Workbench
    from server.store import Store

    with Store(data) as store:
        # A run that is still on has more samples each time.
        key = (data, recording, axis, store.recordings.row(recording)["samples"])
        loaded = None if key in _warm else store.recording(recording)
    if loaded is not None:
        if axis not in loaded.axes:
            raise Problem("diagnosis.no_axis", axis=axis, axes=", ".join(loaded.axes))
        _warm[key] = Workbench(loaded, axis)
        while len(_warm) > WARM:
            _warm.popitem(last=False)
    _warm.move_to_end(key)
    return _warm[key]


def signal(data: Path, recording: str, axis: str | None, board: str, points: int) -> bytes:
    """The measured output alone, for the first picture: no arithmetic beyond picking what a screen shows."""
    from calib_core.pictures import decimated
    from server.store import Store

    with Store(data) as store:
        readings = store.recordings.points(recording)
        loaded = store.recording(recording) if readings is None else None
    if readings is not None:
        return workbench_points.signal(readings, axis, board)
    assert loaded is not None
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
    board: str,
    lang: str,
    noise: NoiseFit | None = None,
) -> bytes:
    """Base and effects on a recording, with everything that a page draws of it; ``noise``: what a search found."""
    from calib_core import formula
    from calib_core.gap_error import varies
    from calib_core.pictures import decimated, spectrum, stretches

    readings = _readings(data, recording)
    if readings is not None:
        return workbench_points.fit(readings, axis, board, effects, formulas, lang)
    bench = warm(data, recording, axis)
    if noise is not None:
        bench.settle(noise)
    for own in formulas:
        bench.own(formula.from_json(own))
    model = bench.fit(effects)
    fitted, samples = model.fitted, model.space.design.averages.samples
    time = samples.time_s - samples.time_s[0]
    begin, end = (time[0] if window[0] is None else window[0], time[-1] if window[1] is None else window[1])
    inside = slice(int(np.searchsorted(time, begin)), max(2, int(np.searchsorted(time, end, side="right"))))
    at = inside.start + decimated(samples.output[inside], points)
    scale = abs(model.space.scale_factor) or 1.0
    f, density = spectrum((samples.output - model.output) / scale, samples.interval_s)
    arrays = {
        "time_s": time[at], "measured": samples.output[at], "modelled": model.output[at],
        "window_s": fitted.middle_s, "residual": fitted.residual_dps, "spread": fitted.spread_dps,
        "frequency_hz": f, "density": density,
    }  # fmt: skip
    along = {name: values for name, values in fitted.along.items() if varies(name, values)}
    for name, values in along.items():
        middle, mean, sigma = stretches(values, fitted.residual_dps, fitted.spread_dps)
        order = np.argsort(values, kind="stable")
        arrays |= {f"{name}/at": values[order], f"{name}/residual": fitted.residual_dps[order]}
        arrays |= {f"{name}/middle": middle, f"{name}/mean": mean, f"{name}/sigma": sigma}
    white = fitted.explanation.space.noise.noise.white
    head = {
        "axis": axis, "unit": samples.unit, "effects": list(model.effects), "samples": len(time),
        "whole": len(at) == inside.stop - inside.start, "error": _error(model), "possible": bench.effects,
        "steps": [_error(bench.fit(model.effects[:k]))["held_out"] for k in range(len(model.effects) + 1)],
        "parameters": model.parameters, "failures": _failures(model, lang),
        "along": [diagnosis.placed(n) for n in along],
        "white_density": white / scale * float(np.sqrt(2.0 * samples.interval_s)),
    }  # fmt: skip
    return encode(diagnosis.plain(head), arrays)


def searched(data: Path, recording: str, axis: str) -> Words:
    """What a search of the library says of the base: the diagnosis, the |z| that noise alone reaches, the effects that
    a model of this recording can have, and the noise (NoiseFit; None where nothing could be tested)."""
    from calib_core.gap import diagnose
    from calib_core.gap_report import to_json
    from calib_core.workbench import BY_THEMSELVES
    from server.store import Store

    with Store(data) as store:
        loaded = store.recording(recording)
    found = diagnose(loaded, diagnosis.axis_of(loaded, axis), told=tell)
    possible = (*found.search.suspects, *BY_THEMSELVES) if found.search else ()
    threshold, noise = (found.search.threshold, found.search.space.noise) if found.search else (float("inf"), None)
    answer = diagnosis.explained(to_json(found))
    return {"diagnosis": answer, "threshold": threshold, "possible": possible, "noise": noise}


def suspects(
    data: Path,
    recording: str,
    axis: str,
    effects: Sequence[str],
    board: str,
    lang: str,
    found: Words | None = None,
) -> Words:
    """The verdict on the base, and every effect of the library with its evidence beside ``effects``.

    ``found``: what ``searched`` gave, where it was asked before.
    """
    readings = _readings(data, recording)
    if readings is not None:
        answer, threshold, possible = workbench_points.suspects(readings, axis, board, effects, lang)
        rows = {row["effect"]: {**row, "z": _z(row)} for row in answer["candidates"]}
        return _listed(answer, rows, answer["rivals"], threshold, effects, possible, lang)
    found = found or searched(data, recording, axis)
    answer, threshold = diagnosis.told(found["diagnosis"], lang), found["threshold"]
    rows = {row["effect"]: {**row, "z": _z(row)} for row in answer["candidates"]}
    ties = _beside(warm(data, recording, axis), effects, rows, threshold) if effects else _found(answer, rows)
    return _listed(answer, rows, ties, threshold, effects, found["possible"], lang)


def _listed(
    answer: Words,
    rows: dict[str, Words],
    ties: Sequence[Sequence[str]],
    threshold: float,
    effects: Sequence[str],
    possible: Sequence[str],
    lang: str,
) -> Words:
    """The verdict and the rows, the surest first, each with its sentence."""
    for name in effects:
        rows.setdefault(name, {"effect": name, "status": "tested", "two_delta_lnL": None, "p": None, "z": None})
    tested = sum(row["status"] == "tested" for row in rows.values())
    for name, row in rows.items():
        row["tie"] = next((k for k, names in enumerate(ties) if name in names), None)
        row["in_model"], row["can_be_added"] = name in effects, name in possible
        row |= _evidence(row, threshold, tested, answer.get("reach"))
        if row["tie"] is not None and row["word"] in SURE:
            # Sure is that one of them is there, not which.
            row |= {"code": "workbench.evidence.tied", "values": {}}
        row["sentence"] = render(row["code"], row["values"], lang)
        row["title"] = texts(lang).get(f"effects.{name}.name", name)
    place = {name: k for k, name in enumerate(effects)}  # the model's own in the order in which they came
    order = sorted(
        rows.values(),
        key=lambda r: (place.get(r["effect"], len(place)), r["status"] != "tested", -(r["z"] or 0.0), r["effect"]),
    )
    left, headline = _untested_said(answer, lang), _headline(answer, lang)
    if effects:
        answer = answer | _beside_said(order, lang)
        headline = answer["sentence"] if answer["values"] else ""
    verdict = {key: answer[key] for key in ("verdict", "sentence", "code", "values", "checks", "limits", "unknown")}
    return dict(
        diagnosis.plain({**verdict, "threshold": threshold, "headline": headline, "untested": left, "suspects": order})
    )


def _headline(answer: Words, lang: str) -> str:
    """What is missing, in so few words that it can stand in large letters; empty where nothing is."""
    code = "workbench.headline." + answer["code"].removeprefix("diagnosis.").replace("clipped", "missing")
    return render(code, answer["values"], lang) if code in texts("en") else ""


def _untested_said(answer: Words, lang: str) -> str:
    """What this recording could not test, and why; empty where it could test everything."""
    values = {name: answer["values"].get(name) for name in ("count", "why")}
    if not values["why"]:
        return ""
    names = [row["effect"] for row in untested.rows(answer["candidates"])]
    values["effects"] = diagnosis.effect_words(names, "both")
    return render("workbench.untested" if len(names) > NAMED else "workbench.untested_named", values, lang)


def _beside_said(order: Sequence[Words], lang: str) -> Words:
    """What is to be said of a model with effects: whether anything stands out beside it."""
    names = [row["effect"] for row in order if row["word"] in SURE]
    code = "workbench.beside.something" if names else "workbench.beside.nothing"
    values = {"effects": diagnosis.effect_words(names[:3])} if names else {}
    return {"code": code, "values": values, "sentence": render(code, values, lang)}


def _found(answer: Words, rows: dict[str, Words]) -> list[list[str]]:
    """Puts what the diagnosis found, and what would serve in its place, into the rows; gives the ties."""
    for found in answer["missing"]:
        evidence = {"two_delta_lnL": found["two_delta_lnL"], "p": found["p"], "status": "tested"}
        names = next((tie for tie in answer["rivals"] if found["effect"] in tie), [found["effect"]])
        for name in names:
            rows[name] |= evidence | {"z": _z(evidence)}
    return [names for names in answer["rivals"] if len(names) > 1]


def _beside(bench: Workbench, effects: Sequence[str], rows: dict[str, Words], threshold: float) -> list[list[str]]:
    """Puts the evidence beside a model into the rows; gives the one tie of the best, if there is any."""
    from calib_core.gap import p_value
    from calib_core.gap_search import RIVAL, asked

    ranked, fitted = bench.ranked(effects), bench.fit(effects).fitted
    # What the search would ask of one more effect, for the form of those in the model is never quite right.
    needed = asked(fitted.explanation.space, fitted.two_delta_lnL, fitted.explanation.chi2)
    for name, row in rows.items():
        if name in ranked and not (row["status"] == "not_excited" and ranked[name][1] < threshold):
            gain, z = ranked[name]
            row |= {"two_delta_lnL": gain, "z": z, "p": p_value(z), "status": "tested"}
            if z >= threshold and gain < needed:
                row["word"] = "form"
        elif name in bench.effects and row["status"] == "tested" and row["p"] is not None:
            # Its column is a mixture of those in the model.
            row |= {"two_delta_lnL": None, "z": None, "p": None, "status": "not_excited", "word": "spanned"}
    sure = [row for row in rows.values() if row["effect"] in ranked and row.get("word") != "form"]
    over = [row for row in sure if (row["z"] or 0.0) >= threshold]
    best = max((row["two_delta_lnL"] for row in over), default=0.0)
    tied = [row["effect"] for row in over if best - row["two_delta_lnL"] < RIVAL]
    return [tied] if len(tied) > 1 else []


def _readings(data: Path, recording: str) -> Points | None:
    from server.store import Store

    with Store(data) as store:
        return store.recordings.points(recording)


def path(motion: Sequence[Mapping[str, Any]]) -> Words:
    """Times and commanded angles of the axes that a motion moves; the first axis alone where none does."""
    from calib_core.excitation import Excitation, commanded, steps

    planned = steps([Excitation.from_json(one) for one in motion], "path")
    angles = commanded(planned, PATH_HZ)
    moved = [axis for axis, values in angles.items() if np.ptp(values) > 0.0] or [motion[0]["axis"]]
    time = np.arange(len(next(iter(angles.values())))) / PATH_HZ
    return {"time_s": time.tolist(), "angle_deg": {axis: np.round(angles[axis], 3).tolist() for axis in moved}}


def _z(evidence: Mapping[str, Any]) -> float | None:
    """The |z| of a chance, by the gain where the chance is too small to be told from nought."""
    from scipy.special import ndtri

    if evidence["status"] != "tested":
        return None
    if evidence["p"] is None or evidence["p"] < 1e-250:
        return float(np.sqrt(max(evidence["two_delta_lnL"] or 0.0, 0.0)))
    return float(-ndtri(evidence["p"] / 2.0))


def _evidence(row: Mapping[str, Any], threshold: float, tested: int, reach: Mapping[str, Any] | None = None) -> Words:
    """A word for how sure it is, and the code and values of its sentence."""
    from calib_core.gap import BY_ITSELF

    apart = row["effect"] in BY_ITSELF
    if row["in_model"]:
        word = "in_model"
    elif row["status"] != "tested":
        word = row.get("word", row["status"])
        if reach and word in ("not_excited", "no_data") and row["effect"] not in untested.NEVER:
            values = {"why": untested.why(row, reach)}
            return {"word": word, "code": "workbench.evidence.untested", "values": values}
    elif row.get("word") == "form":
        word = "form"
    elif apart and not row["two_delta_lnL"]:
        return {"word": "nothing", "code": "workbench.evidence.by_itself", "values": {}}
    elif apart or row["z"] >= threshold:
        chance = 0.0 if row["p"] is None else min(1.0, row["p"] * tested)
        found = diagnosis.certainty(diagnosis.effect_words([row["effect"]]), chance)
        return {"word": found["code"].rpartition(".")[2], **found}
    else:
        word = "nothing"
    return {"word": word, "code": f"workbench.evidence.{word}", "values": {}}


def _error(model: Model) -> Words:
    error = model.fitted.error
    floor = {"floor": error.floor_rms_dps, "block_s": error.block_s, "blocks": error.blocks}
    return {"held_out": error.held_out_rms_dps, **floor, "unit": "deg/s"}


def _failures(model: Model, lang: str) -> list[Words]:
    """The worst stretch of each covariate that fails, worst first."""
    from calib_core.gap_report import FAILING

    found = []
    other = model.fitted.along.get("other_rate_dps")
    still = other is not None and float(np.mean(np.abs(other) > STILL_DPS)) < MOVED
    for f in model.fitted.failures():
        if abs(f.z) >= FAILING and not (still and f.covariate == "other_rate_dps"):
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
