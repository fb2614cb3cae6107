"""Every sentence exists in both languages, fills its placeholders, and is found in the language asked for."""

import ast
import json
import re
from typing import Any

import pytest
from shared import ROOT

from calib_core.problem import Problem
from server import texts

PLACEHOLDER = re.compile(r"\{(\w+)(?::\d+)?\}")
SOURCES = sorted([*ROOT.glob("calib_core/**/*.py"), *ROOT.glob("server/**/*.py")])


def test_both_languages_have_the_same_texts_with_the_same_placeholders() -> None:
    """Except the cards of effects, whose English is in the effects' own files (test_effect_texts.py)."""
    english, thai = texts.texts("en"), texts.texts("th")
    cards = {key for key in thai if key.startswith("effects.") and not key.endswith(".name")}
    assert set(english) == set(thai) - cards
    for key, text in english.items():
        assert set(PLACEHOLDER.findall(text)) == set(PLACEHOLDER.findall(thai[key])), key
        assert text.strip()
        assert thai[key].strip()


def test_thai_sentences_are_thai() -> None:
    errors = {key: text for key, text in texts.texts("th").items() if key.startswith(("error.", "warning."))}
    words = {key: PLACEHOLDER.sub("", text) for key, text in errors.items()}
    assert [key for key, text in words.items() if re.search("[A-Za-z]", text) and not re.search("[ก-๙]", text)] == []


def codes_raised() -> dict[str, set[str]]:
    """Every literal code that a Problem or a child of it is made with, and where."""
    found: dict[str, set[str]] = {}
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.args:
                first = node.args[0]
                named = node.func.id.endswith(("Problem", "DeviceError"))
                if named and isinstance(first, ast.Constant) and isinstance(first.value, str):
                    found.setdefault(first.value, set()).add(f"{path.relative_to(ROOT)}:{node.lineno}")
    return found


def test_every_refusal_has_its_sentence() -> None:
    raised = codes_raised()
    assert len(raised) > 50
    missing = {code: where for code, where in raised.items() if f"error.{code}" not in texts.texts("en")}
    assert missing == {}


def test_every_complaint_about_a_field_has_its_sentence() -> None:
    from server.problems import FIELD_TEXTS, TYPE_TEXTS

    for name in {*FIELD_TEXTS.values(), *TYPE_TEXTS.values(), "unacceptable"}:
        assert f"error.request.{name}" in texts.texts("en")


@pytest.mark.parametrize(
    ("header", "lang"),
    [
        (None, "en"),
        ("th", "th"),
        ("th-TH,th;q=0.9,en;q=0.8", "th"),
        ("en;q=0.4, th;q=0.5", "th"),
        ("de, fr;q=0.9", "en"),
        ("th;q=nonsense", "en"),
        ("th;q=0", "en"),
    ],
)
def test_the_language_is_negotiated(header: str | None, lang: str) -> None:
    assert texts.negotiate(header) == lang


def test_values_are_filled_as_they_should_be_read(monkeypatch: pytest.MonkeyPatch) -> None:
    told: dict[str, Any] = {"a.b": "{n:2} of {x}, {list}, {inner}, {missing}", "inner": "<{n}>"}
    monkeypatch.setattr(texts, "texts", lambda _: told)
    values = {"n": 1.239, "x": 7, "list": ["p", 2.5], "inner": {"code": "inner", "values": {"n": 3}}}
    assert texts.render("a.b", values) == "1.24 of 7, p, 2.5, <3>, {missing}"
    assert texts.render("no.text", {"n": 1}) == "no.text: n = 1"


def test_a_problem_keeps_its_code_and_values_between_processes() -> None:
    import pickle

    again = pickle.loads(pickle.dumps(Problem("recording.not_found", recording="x")))
    assert (again.code, again.values) == ("recording.not_found", {"recording": "x"})
    assert texts.sentence(again, "en") != texts.sentence(again, "th")


def test_texts_are_sorted_so_that_two_hands_do_not_collide() -> None:
    for lang in texts.LANGUAGES:
        raw = (texts.WEB / "i18n" / f"{lang}.json").read_text(encoding="utf-8")
        assert raw == json.dumps(json.loads(raw), ensure_ascii=False, indent=1, sort_keys=True) + "\n"
