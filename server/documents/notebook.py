"""A lab notebook as PDF: this module finds the words and the numbers, notebook.typ sets them."""

import datetime
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from server import notebook
from server.documents.pdf import inert
from server.texts import render

TEMPLATE = Path(__file__).with_name("notebook.typ")
CHANGES = ("added", "removed")


def render_notebook(head: Mapping[str, Any], lines: Sequence[Mapping[str, Any]], lang: str) -> bytes:
    """The notebook on A4 in ``lang``; its bytes depend on what stands in it alone. Takes half a second of CPU."""
    import fontpkg
    import typst

    last = datetime.datetime.fromisoformat(head["last_at"] or head["created_at"]).replace(microsecond=0)
    return typst.compile(
        str(TEMPLATE),
        font_paths=[str(fontpkg.path("Sarabun").parent)],
        ignore_system_fonts=True,
        sys_inputs={"notebook": json.dumps(page(head, lines, lang), ensure_ascii=False)},
        timestamp=last,
    )


def page(head: Mapping[str, Any], lines: Sequence[Mapping[str, Any]], lang: str) -> dict[str, Any]:
    """What stands on the pages, as strings in order: the template only places them."""

    def say(key: str, **values: object) -> str:
        return render(f"notebook.pdf.{key}", values, lang)

    opened = dict.fromkeys(line["values"]["name"] for line in lines if line["step"] == "opened")
    identity = {
        "author": head["author"],
        "recordings": ", ".join(opened),
        "begun": f"{_day(head['created_at'])} {_clock(head['created_at'])} UTC",
        "lines": str(len(lines)),
    }
    return {
        "lang": lang,
        "title": say("title"),
        "subject": inert(head["title"]) if head["title"] else "",
        "id_label": say("id"),
        "id": head["id"],
        "page": say("page", page="%1", pages="%2"),
        "identity": [[say(name), inert(value)] for name, value in identity.items()],
        "head": [say("time"), say("step"), say("what")],
        "days": list(_days(lines, lang)),
        "error": _error(lines, lang),
        "empty": "" if lines else say("empty"),
        "kept": say("kept"),
        "digest": hashlib.sha256(json.dumps([head["id"], *lines], sort_keys=True).encode()).hexdigest(),
        "signed": [say("student"), say("teacher")],
    }


def _days(lines: Sequence[Mapping[str, Any]], lang: str) -> Iterator[dict[str, Any]]:
    for day in dict.fromkeys(_day(line["at"]) for line in lines):
        rows = []
        for line in lines:
            if _day(line["at"]) == day:
                told = notebook.told(line, lang)
                own = [inert(part) for part in (told["own"] or "").splitlines() if part.strip()]
                label = render(f"notebook.step.{line['step']}", {}, lang)
                rows.append([_clock(line["at"]), label, inert(told["sentence"]) if told["sentence"] else "", own])
        yield {"day": day, "rows": rows}


def _error(lines: Sequence[Mapping[str, Any]], lang: str) -> dict[str, Any] | None:
    """The error on unseen data after each change of the model, as bars; None where nothing was changed."""
    changes = [line["values"] | {"step": line["step"]} for line in lines if line["step"] in CHANGES]
    if not changes:
        return None
    unit, first = changes[-1].get("unit", "deg/s"), changes[0]
    bars = [[render("notebook.pdf.base", {}, lang), first["before"], f"{first['before']:.3g}"]]
    for change in changes:
        label = render(f"notebook.pdf.{change['step']}", {"effects": notebook.effects(change["effects"])}, lang)
        bars.append([inert(label), change["after"], f"{change['after']:.3g}"])
    floor = changes[-1].get("floor")
    return {
        "title": render("notebook.pdf.error", {"unit": unit}, lang),
        "bars": bars,
        "longest": max(max(bar[1] for bar in bars), floor or 0.0) or 1.0,
        "floor": floor,
        "floor_label": "" if floor is None else render("notebook.pdf.floor", {"floor": f"{floor:.3g}"}, lang),
    }


def _day(at: str) -> str:
    return at[:10]


def _clock(at: str) -> str:
    return at[11:19]
