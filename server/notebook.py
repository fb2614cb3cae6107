"""What a lab notebook's lines say: sentences from the steps' values, in either language."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from calib_core.problem import Problem
from server import diagnosis, experiments
from server.texts import render, texts

Words = dict[str, Any]

DEEPEST = 10
OWN_WORDS = {"guessed": "why", "note": "text", "submitted": "reasoning"}
"""Where a step keeps what the student wrote."""


def told(line: Mapping[str, Any], lang: str) -> Words:
    """A stored line with its ``sentence``, and ``own``: the student's own words, None where there are none."""
    step, values = line["step"], line["values"]
    case, filled = _said(step, values)
    sentence = render(f"notebook.line.{case}", filled, lang) if case else ""
    own = values.get(OWN_WORDS.get(step, ""), "").strip() or None
    return {**line, "sentence": sentence, "own": own}


def _said(step: str, values: Mapping[str, Any]) -> tuple[str, Words]:
    """Which sentence, and with what."""
    words = {**values}
    for name in ("before", "after", "floor"):
        if words.get(name) is not None:
            words[name] = diagnosis.rounded(words[name], 0.0)
    if step == "guessed":
        if not values.get("effects"):
            return "guessed_none", words
        words["effects"] = effects(values["effects"])
        if values.get("covariate"):
            return "guessed_along", words | {"along": diagnosis.along(values["covariate"])}
    elif step == "seen":
        words["effect"] = diagnosis.effect_word(values["effect"])
        return ("seen" if values.get("two_delta_lnL") is not None else "seen_untested"), words
    elif step in ("added", "removed"):
        words["effects"] = effects(values["effects"])
        return (step if values.get("floor") is None else f"{step}_floor"), words
    elif step == "experiment":
        words["motion"] = experiments.motion_words(values["motion"])
    elif step == "verdict":
        words = {"said": {"code": values["code"], "values": values["values"]}}
    elif step == "submitted":
        words["answer"] = answer(values["findings"])
        return ("submitted" if values["findings"] else "submitted_none"), words
    elif step == "note":
        return "", words
    return step, words


def effects(names: Sequence[str]) -> Any:
    """Names of effects in words, the last after "and"."""
    return diagnosis.effect_words(names, "both")


def answer(findings: Sequence[Sequence[str]]) -> Any:
    """A student's findings in words: a tie's names joined by "or", findings by commas."""
    return [diagnosis.effect_words(names, "either") for names in findings]


def checked_verdict(code: str, values: Mapping[str, Any]) -> None:
    """Raises Problem for a code that is none of a diagnosis' sentences, or for values nested too deep to be said."""
    if not code.startswith("diagnosis.") or code not in texts("en") or _depth(values) > DEEPEST:
        raise Problem("notebook.verdict", given=code)


def _depth(node: object) -> int:
    """How deep, found without recursion: a body may nest deeper than Python's stack."""
    depth, level = 0, [node]
    while level and depth <= DEEPEST:
        depth += 1
        level = [child for one in level for child in _children(one)]
    return depth


def _children(node: object) -> Iterator[object]:
    if isinstance(node, Mapping):
        yield from node.values()
    elif isinstance(node, list | tuple):
        yield from node
