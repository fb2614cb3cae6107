"""What is the model missing, in words: one path from a recording to CONTRACT 3's JSON.

The command, the server and the worker call ``of_recording`` (or ``of_file``) and then ``told``. The first gives
numbers, codes and values, the same in every language; the second adds their sentences.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib_core.problem import Problem
from server import untested
from server.texts import render, texts

if TYPE_CHECKING:
    from calib_core.effects import Effect
    from calib_core.points import Points
    from calib_core.recording import Recording
    from calib_core.sequence import Axis

Words = dict[str, Any]

CERTAIN, LIKELY = 1e-6, 1e-3
"""Chances that noise alone gives a finding, over all effects tried."""
ABOVE_FLOOR = 1.1
STANDS_OUT = 10.0
"""2ΔlnL by which one effect of a few stands out from noise."""
STILL = {"rate": 0.5, "acceleration": 0.5, "other_rate": 0.5}
"""Below this a covariate is said to stand still."""
KINDS = {
    "temperature_c": "temperature", "other_rate_dps": "other_rate", "_acceleration_dps2": "acceleration",
    "_rate_dps": "rate", "_position_deg": "position", "time_since_reversal_s": "since_reversal",
    "duration_s": "duration", "time_s": "time", "supply_v": "supply", "frequency_hz": "frequency",
    "set_point": "set_point",
}  # fmt: skip
"""How names of covariates end, and the texts that tell of them."""


def of_file(
    file: Path,
    *,
    axis: str | None = None,
    effects: Sequence[str] = (),
    suspects: "Mapping[str, type[Effect]] | None" = None,
) -> list[Words]:
    """The diagnosis of a recording, or of every board and axis of a file of points. Raises Problem and OSError."""
    from calib_core import points, recording

    with file.open("rb") as opened:
        try:
            found = recording.read(opened, name=file.name)
        except Problem as problem:
            if problem.code != "recording.is_points":
                raise
            opened.seek(0)
            return of_points(points.read(opened), axis=axis, effects=effects, file=file.name, suspects=suspects)
    return [of_recording(found, axis=axis, effects=effects, file=file.name, suspects=suspects)]


def of_points(
    points: "Points",
    *,
    axis: str | None = None,
    effects: Sequence[str] = (),
    file: str | None = None,
    board: str | None = None,
    suspects: "Mapping[str, type[Effect]] | None" = None,
) -> list[Words]:
    """CONTRACT 3 for each board and axis, in the order of the file; only ``board`` and ``axis`` where given."""
    from calib_core.effects import library
    from calib_core.gap_points import diagnose

    pool = dict(library() if suspects is None else suspects)
    _known(effects, pool)
    groups = dict.fromkeys(zip(points.board.tolist(), points.axis.tolist(), strict=True))
    if board is not None and board not in {b for b, _ in groups}:
        raise Problem("diagnosis.no_board", board=board, boards=", ".join(dict.fromkeys(b for b, _ in groups)))
    groups = {(b, a): None for b, a in groups if board in (None, b)}
    chosen = [(b, a) for b, a in groups if axis in (None, a)]
    if not chosen:
        raise Problem("diagnosis.no_axis", axis=axis, axes=", ".join(sorted({a for _, a in groups})))
    answers = [diagnose(points.take((points.board == b) & (points.axis == a)), effects=effects) for b, a in chosen]
    for answer in answers:
        answer["recording"]["file"] = file
        answer["user_effects"] = own_effects(pool, [*effects, *(m["effect"] for m in answer["missing"])])
    return [explained(answer) for answer in answers]


def of_recording(
    recording: "Recording",
    *,
    axis: str | None = None,
    effects: Sequence[str] = (),
    file: str | None = None,
    suspects: "Mapping[str, type[Effect]] | None" = None,
    axes: "Mapping[str, Axis] | None" = None,
    told: Callable[[str], None] = lambda _: None,
) -> Words:
    """CONTRACT 3 for one axis: the one asked for, else the one that the header names, else the first.

    ``next_experiment`` is what a rig with ``axes`` could do (None: the usual bench). ``told`` hears of each stage.
    """
    from calib_core.effects import library
    from calib_core.gap import diagnose
    from calib_core.gap_report import to_json
    from server.experiments import following

    pool = dict(library() if suspects is None else suspects)
    _known(effects, pool)
    axis = axis_of(recording, axis)
    found = diagnose(recording, axis, effects=effects, suspects=pool, told=told)
    told("motions")
    answer = to_json(found)
    answer["recording"]["file"] = file
    answer["user_effects"] = own_effects(pool, [*effects, *(m["effect"] for m in answer["missing"])])
    return explained(answer) | {"next_experiment": plain(following(found, axes))}


def axis_of(recording: "Recording", axis: str | None) -> str:
    """The axis that is meant; raises Problem where the recording has no such axis."""
    if axis is not None and axis not in recording.axes:
        raise Problem("diagnosis.no_axis", axis=axis, axes=", ".join(recording.axes))
    named = recording.header.get("axis", "")
    return axis or (named if named in recording.axes else recording.axes[0])


def own_effects(pool: "Mapping[str, type[Effect]]", names: Iterable[str]) -> list[dict[str, str]]:
    """The formulas of those of ``names`` that users made: with them the answer can be used anywhere."""
    from calib_core.formula import UserEffect, to_json

    return [to_json(effect) for name in names if issubclass(effect := pool[name], UserEffect)]


def _known(effects: Sequence[str], pool: Iterable[str]) -> None:
    for name in effects:
        if name not in pool:
            raise Problem("diagnosis.no_such_effect", given=name, allowed=", ".join(pool))


def explained(answer: Words) -> Words:
    """The answer with a code and values for everything that is to be said about its numbers."""
    tied = {name: names for names in answer["rivals"] for name in names}
    tested = sum(candidate["status"] == "tested" for candidate in answer["candidates"]) or 1
    for failure in answer["where_it_fails"]:
        failure |= failing(failure)
    for finding in answer["missing"]:
        names = tied.get(finding["effect"], [finding["effect"]])
        finding |= certainty(effect_words(names), min(1.0, finding["p"] * tested))
    if answer["error"] is not None:
        answer |= _verdict(answer, tied)
    return dict(plain(answer | {"limits": list(_limits(answer))}))


def plain(part: Any) -> Any:
    """As JSON has it: no numbers that are none."""
    if isinstance(part, Mapping):
        return {key: plain(value) for key, value in part.items()}
    if isinstance(part, list | tuple):
        return [plain(value) for value in part]
    if isinstance(part, float) and not math.isfinite(part):
        return None
    return part.item() if hasattr(part, "item") else part


def told(answer: Words, lang: str) -> Words:
    """The answer with ``sentence`` beside every code, in a language."""
    said = answer | {"sentence": render(answer["code"], answer["values"], lang)}
    for part in ("checks", "where_it_fails", "missing", "limits"):
        said[part] = [row | {"sentence": render(row["code"], row["values"], lang)} for row in answer[part]]

    def sentenced(following: Words) -> Words:
        return following | {"sentence": render(following["code"], following["values"], lang)}

    if answer["next_experiment"]:
        said["next_experiment"] = sentenced(answer["next_experiment"])
    if "experiments" in answer:
        said["experiments"] = [sentenced(done) for done in answer["experiments"]]
    return said


def _verdict(answer: Words, tied: Mapping[str, list[str]]) -> Words:
    """The code and values of the one plain sentence."""
    before, after, floor, unit = errors(answer)
    verdict = answer["verdict"]
    joint = "bracketed" if verdict == "ambiguous" and len(answer["missing"]) > 1 else "either"
    findings = [effect_words(tied.get(m["effect"], [m["effect"]]), joint) for m in answer["missing"]]
    values = {"before": before, "after": after, "floor": floor, "unit": unit, "effects": joined("both", findings)}
    values["count"] = sum(candidate["status"] == "not_excited" for candidate in answer["candidates"])
    if answer.get("reach"):
        values["count"] = len(untested.rows(answer["candidates"]))
        values["why"] = untested.reasons(answer["candidates"], answer["reach"])
    if verdict == "unknown":
        values["along"] = along(answer["unknown"]["covariate"])
        verdict = "unknown_beside" if findings else "unknown"
    elif joint == "bracketed":
        verdict = "ambiguous_several"
    elif verdict == "missing" and [m["effect"] for m in answer["missing"]] == ["saturation"]:
        verdict = "clipped"  # both errors are of what lies between the limits
    elif verdict == "adequate" and before > ABOVE_FLOOR * floor:
        verdict = "adequate_above_floor"
    elif verdict == "adequate" and values["count"]:
        verdict = "adequate_untested" if "why" in values else "adequate_partly"
    return {"code": f"diagnosis.{verdict}", "values": values}


def errors(answer: Words) -> tuple[float, float, float, str]:
    """Held-out error of the model asked for and of the one with what it lacks, the noise's part, and their unit."""
    suffix, unit = ("deg", "deg") if "held_out_rms_deg" in answer["error"] else ("dps", "deg/s")
    # With what is missing the path is known better, and so is what noise alone makes.
    floor = answer["after"].get(f"floor_rms_{suffix}", answer["error"][f"floor_rms_{suffix}"])
    found = (answer["error"][f"held_out_rms_{suffix}"], answer["after"][f"held_out_rms_{suffix}"], floor)
    before, after, floor = (rounded(x, 0.1 * floor) for x in found)
    return before, after, floor, unit


def failing(failure: Mapping[str, Any]) -> Words:
    suffix = "deg" if "residual_deg" in failure else "dps"
    residual, z = failure[f"residual_{suffix}"], failure["z"]
    low, high = failure["from"], failure["to"]
    finest = (high - low) / 5.0
    ends = {"from": rounded(low, finest), "to": rounded(high, finest)}
    place = placed(failure["covariate"])
    kind = place.pop("kind")
    if max(abs(low), abs(high)) < STILL.get(kind, 0.0):
        kind = "other_still" if kind == "other_rate" else "still"
    elif low == high and kind in ("rate", "position"):
        kind = f"{kind}_at"
    where = {"code": f"diagnosis.where.{kind}", "values": ends | place}
    size = rounded(float(f"{abs(residual):.2g}"), abs(residual / z) if z else 0.0)
    side = "reads_low" if residual > 0.0 else "reads_high"
    unit = "deg" if suffix == "deg" else "deg/s"
    return {"code": f"diagnosis.{side}", "values": {"size": size, "unit": unit, "where": where}}


def certainty(effect: Words, chance: float) -> Words:
    word = "certain" if chance < CERTAIN else "likely" if chance < LIKELY else "probable"
    values = {"effect": effect} | ({"odds": _round_number(1.0 / chance)} if word == "likely" else {})
    return {"code": f"diagnosis.finding.{word}", "values": values}


def _limits(answer: Words) -> Iterator[Words]:
    """What this recording leaves open."""

    def limit(case: str, **values: object) -> Words:
        return {"code": f"diagnosis.limit.{case}", "values": values}

    for names in answer["rivals"]:
        yield limit("rivals", rivals=effect_words(names, "both"))
    for one, other in answer["rival_sets"]:
        yield limit("rival_sets", one=effect_words(one, "both"), other=effect_words(other, "both"))
    if answer["unknown"]:
        yield limit("unknown")
    if answer["code"] == "diagnosis.adequate_above_floor":
        yield limit("above_floor")
    timed = answer["recording"]["duration_s"] is not None
    if not timed:
        if "bias_step" in [m["effect"] for m in answer["missing"]]:
            yield limit("moved")
        names = [m["effect"] for m in answer["missing"] if m["two_delta_lnL_by_set_point"] < STANDS_OUT]
        if names:
            yield limit("common_error", effects=effect_words(names, "both"))
        yield limit("reference")
        yield limit("no_time")
    for status in ("not_excited", "no_data") if timed else ("not_excited",):
        names = [c["effect"] for c in untested.rows(answer["candidates"]) if c["status"] == status]
        if names:
            yield limit(status, effects=[effect_word(name) for name in names])


def cards(lang: str) -> list[Words]:
    """The effect library in a language, in alphabetical order; what has no text there is in the effect's own words."""
    from calib_core.effects import library

    return [card(effect, lang) for effect in library().values()]


OWN = ("summary", "cause", "signature", "confused_with", "excite_it", "source")


def card(effect: "type[Effect]", lang: str) -> Words:
    """Name, place, parameters and physics card of an effect."""
    known = texts(lang)
    told = {key: known.get(f"effects.{effect.name}.{key}", text) for key, text in effect.card().items()}
    parameters = [
        {"name": name, "unit": p.unit, "typical": p.typical, "bounds": p.bounds, "grid": list(p.grid)}
        for name, p in effect.parameters().items()
    ]
    title = known.get(f"effects.{effect.name}.name", effect.name)
    place = {"name": effect.name, "title": title, "stage": effect.stage.value, "needs": list(effect.needs)}
    return {**told, **place, "parameters": parameters, "own": False}


def own_card(row: Mapping[str, Any], lang: str) -> Words:
    """The card of a user's own effect, as the store has it; its fields are the formula and what follows from that."""
    from calib_core.formula import from_json

    effect = from_json(row)
    said = {key: render(f"effects_own.{key}", {"names": list(effect.formula.names)}, lang) for key in OWN}
    kept = {key: row[key] for key in ("formula", "acts", "note", "created_at")}
    return card(effect, lang) | said | ({"summary": row["note"]} if row["note"] else {}) | kept | {"own": True}


# --- words -------------------------------------------------------------------------------------------------------
def effect_word(name: str) -> object:
    """An effect's name in words; a user's own effect has only its own."""
    key = f"effects.{name}.name"
    return {"code": key, "values": {}} if key in texts("en") else name


def effect_words(names: Sequence[str], joint: str = "either") -> Any:
    """Names in words, the last after "or" (``either``) or "and" (``both``)."""
    return joined(joint, [effect_word(name) for name in names])


def joined(joint: str, words: Sequence[object]) -> Any:
    """Words in a row, the last after what ``joint`` says: "either", "both", "bracketed"."""
    if len(words) < 2:
        return list(words)
    if joint == "either" and len(words) > 2:
        joint = "one_of"
    return {"code": f"diagnosis.{joint}", "values": {"some": list(words[:-1]), "last": words[-1]}}


def along(covariate: str) -> Words:
    """A covariate in words."""
    place = placed(covariate)
    return {"code": f"diagnosis.along.{place.pop('kind')}", "values": place}


def placed(name: str) -> Words:
    """Its kind, which a text is named after, and what the text is filled with."""
    kind = next((kind for ending, kind in KINDS.items() if name.endswith(ending)), "other")
    return {"kind": kind, "axis": name[0], "covariate": name}


def rounded(value: float, uncertainty: float) -> float:
    """``value`` to the first digit of its uncertainty, or to the second where that begins with 1 or 2."""
    if not (uncertainty > 0.0 and math.isfinite(value)):
        return float(f"{value:.3g}")
    return round(value, -math.floor(math.log10(uncertainty / 3.0))) + 0.0


def _round_number(value: float) -> int:
    return int(float(f"{value:.0e}"))
