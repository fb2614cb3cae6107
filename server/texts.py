"""Sentences in English and Thai, from the pages' own texts (web/i18n)."""

import json
import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

from calib_core.problem import Problem

WEB = Path(__file__).resolve().parents[1] / "web"
LANGUAGES = ("en", "th")
_PLACEHOLDER = re.compile(r"\{(\w+)(?::(\d+))?\}")


@cache
def texts(lang: str) -> Mapping[str, str]:
    """Every text of a language under its dotted key."""
    tree = json.loads((WEB / "i18n" / f"{lang}.json").read_text(encoding="utf-8"))
    return dict(_flat("", tree))


def _flat(prefix: str, node: object) -> Iterable[tuple[str, str]]:
    if isinstance(node, dict):
        for key, child in node.items():
            yield from _flat(f"{prefix}{key}.", child)
    else:
        yield prefix[:-1], str(node)


def render(code: str, values: Mapping[str, object], lang: str = "en") -> str:
    """The sentence of a code in a language; a code is a whole key, or one under ``error`` or ``warning``.

    ``{name}`` takes a value as it is, ``{name:3}`` with three decimals. A text that is missing in the language is
    given in English, and one that is missing altogether as its code and values: a report never fails over a word.
    """
    for language in (lang, "en"):
        for key in (code, f"error.{code}", f"warning.{code}"):
            template = texts(language if language in LANGUAGES else "en").get(key)
            if template is not None:
                return _PLACEHOLDER.sub(lambda found: _fill(found, values, lang), template)
    return f"{code}: " + ", ".join(f"{name} = {value}" for name, value in values.items())


def _fill(found: re.Match[str], values: Mapping[str, object], lang: str) -> str:
    name, decimals = found.groups()
    if name not in values:
        return found.group()
    return _word(values[name], decimals, lang)


def _word(value: object, decimals: str | None, lang: str) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_word(item, decimals, lang) for item in value)
    if isinstance(value, Mapping) and "code" in value:
        return render(value["code"], value.get("values", {}), lang)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return (
            f"{value:.{decimals}f}"
            if decimals is not None
            else f"{value:.6g}"
            if isinstance(value, float)
            else str(value)
        )
    return str(value)


def sentence(problem: Problem, lang: str = "en") -> str:
    return render(f"error.{problem.code}", problem.values, lang)


def negotiate(accept_language: str | None) -> str:
    """The better of our languages for an Accept-Language header; English where neither is asked for."""
    best, best_quality = "en", 0.0
    for part in (accept_language or "").split(","):
        tag, _, parameters = part.strip().partition(";")
        lang = tag.strip().lower().split("-")[0]
        try:
            quality = float(parameters.strip().removeprefix("q=")) if parameters else 1.0
        except ValueError:
            continue
        if lang in LANGUAGES and quality > best_quality:
            best, best_quality = lang, quality
    return best
