"""Every effect can be told of in both languages: a name in words, and its card."""

import re
from xml.etree import ElementTree

from calib_core.effects import library
from server.texts import WEB, texts

CARD = ("summary", "cause", "signature", "confused_with", "excite_it")


def test_every_effect_has_a_name_in_words_and_a_card() -> None:
    missing = [f"en.json effects.{name}.name" for name in library() if f"effects.{name}.name" not in texts("en")]
    for name, effect in library().items():
        missing += [
            f"th.json effects.{name}.{part}" for part in ("name", *CARD) if f"effects.{name}.{part}" not in texts("th")
        ]
        missing += [
            f"{name}: {part} in its docstring" for part in (*CARD, "equation", "source") if part not in effect.card()
        ]
    assert missing == []


def test_no_text_tells_of_an_effect_that_is_not_there() -> None:
    told = {key.split(".")[1] for lang in ("en", "th") for key in texts(lang) if key.startswith("effects.")}
    assert told <= set(library())


def test_every_effect_has_a_drawing_that_takes_the_pages_colours() -> None:
    missing, wrong = [], []
    for name in library():
        path = WEB / "effects" / f"{name}.svg"
        if not path.is_file():
            missing.append(path.name)
            continue
        text = path.read_text(encoding="utf-8")
        root = ElementTree.fromstring(text)
        colours = set(re.findall(r'(?:fill|stroke)="([^"]+)"', text))
        own = {c for c in colours if not c.startswith(("currentColor", "none", "var(--"))}
        if len(text.encode()) > 3000 or "viewBox" not in root.attrib or own or "<script" in text:
            wrong.append(f"{path.name}: {len(text.encode())} bytes, {sorted(own)}")
    assert missing == []
    assert wrong == []
    assert {path.stem for path in (WEB / "effects").glob("*")} == set(library())
