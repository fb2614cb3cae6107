"""Every word of the pages is in both languages, and each page module keeps to what it may know."""

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest
from shared import ROOT

WEB = ROOT / "web"
SOURCES = sorted([*WEB.glob("*.html"), *WEB.glob("js/**/*.js")])
HTML = re.compile(r'data-t(?:-[a-z-]+)?="([^"]+)"')
PLAIN = re.compile(r"""\bt\(\s*["']([\w.]+)["']""")
# t(`chart.${key}`), and names that are handed on to t: empty("boards.empty", …), field("rig-port", port, "rig.port").
BUILT = re.compile(r"\bt\(\s*`([\w.]*\.)?([\w]*)\$\{")
HANDED = re.compile(r'"((?:boards|certificates|rig|figure)\.\w+)"')
PLACEHOLDER = re.compile(r"\{(\w+)(?::\d+)?\}")


def flat(node: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, child in node.items():
        if isinstance(child, dict):
            yield from flat(child, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", child


@pytest.fixture(scope="module")
def texts() -> dict[str, dict[str, str]]:
    return {
        language: dict(flat(json.loads((WEB / "i18n" / f"{language}.json").read_text(encoding="utf-8"))))
        for language in ("en", "th")
    }


def test_english_and_thai_have_the_same_texts(texts: dict[str, dict[str, str]]) -> None:
    # The English of an effect's card is in the effect's own file.
    cards = {key for key in texts["th"] if key.startswith("effects.") and not key.endswith(".name")}
    assert sorted(texts["en"]) == sorted(set(texts["th"]) - cards)
    empty = [f"{language}: {key}" for language, all_ in texts.items() for key, text in all_.items() if not text.strip()]
    assert not empty


def test_both_languages_of_a_text_are_filled_with_the_same_values(texts: dict[str, dict[str, str]]) -> None:
    names = {lang: {key: set(PLACEHOLDER.findall(text)) for key, text in all_.items()} for lang, all_ in texts.items()}
    assert {key: names["th"][key] for key in names["en"] if names["th"].get(key) != names["en"][key]} == {}


def test_every_text_a_page_asks_for_exists(texts: dict[str, dict[str, str]]) -> None:
    known = texts["en"]
    missing = []
    for path in SOURCES:
        source = path.read_text(encoding="utf-8")
        for key in [
            *HTML.findall(source),
            *PLAIN.findall(source),
            *(HANDED.findall(source) if path.suffix == ".js" else []),
        ]:
            if key not in known:
                missing.append(f"{path.relative_to(ROOT)}: {key}")
        for group, start in BUILT.findall(source):
            if group and not any(key.startswith(group + start) for key in known):
                missing.append(f"{path.relative_to(ROOT)}: {group}{start}…")
    assert not missing, "\n".join(missing)


@pytest.mark.parametrize(
    ("word", "module", "what"),
    [("/api/v1", "api.js", "addresses of the server"), ("uPlot", "chart.js", "the chart library")],
)
def test_one_module_knows(word: str, module: str, what: str) -> None:
    knowing = [path.name for path in WEB.glob("js/**/*.js") if word in path.read_text(encoding="utf-8")]
    assert knowing == [module], f"only js/{module} may know {what}; ask it instead"


def test_pages_bring_everything_themselves() -> None:
    """No script or style inside a page (the policy that the server sends forbids it), and nothing from elsewhere."""
    for page in WEB.glob("*.html"):
        source = page.read_text(encoding="utf-8")
        assert not re.search(r"<script(?![^>]*\bsrc=)|<style|\sstyle=|\son\w+=|https?://", source), page.name
        for address in re.findall(r'(?:src|href)="/((?:css|js|img|i18n)/[^"]+)"', source):
            assert (WEB / address).is_file(), f"{page.name} names {address}"
