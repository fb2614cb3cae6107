"""What `calibrate` and `certify` say of a board: CONTRACT 3's object, a page for the terminal, and the documents."""

import json
import sys
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calib_core.certificate import FIELDS
from calib_core.problem import Problem
from server import documents
from server.texts import render, sentence

Outcome = dict[str, Any]


def read_spec(path: str | None) -> dict[str, Any] | None:
    """The specification in a JSON file, checked. Raises Problem."""
    if path is None:
        return None
    from calib_core.certificate import limits

    try:
        spec: dict[str, Any] = json.loads(Path(path).read_text(encoding="utf-8"))
    except UnicodeDecodeError:
        raise Problem("spec.not_text", path=path) from None
    except json.JSONDecodeError as error:
        raise Problem("spec.not_json", path=path, reason=error.msg, line=error.lineno) from None
    limits(spec)
    return spec


def certified(
    content: Mapping[str, Any],
    out: Path,
    lang: str,
    *,
    file: str | None = None,
    rendered: Mapping[str, bytes] | None = None,
) -> Outcome:
    """The outcome of an issued certificate, whose documents it writes into ``out`` (None: rendered here)."""
    return {
        "file": file,
        "board": content["board"],
        "certificate": content["number"],
        "verdict": content["verdict"],
        "error": None,
        "axes": content["axes"],
        "warnings": [
            {**warning, "sentence": documents.warning_sentence(warning, lang)} for warning in content["warnings"]
        ],
        "documents": write_documents(content, out, lang, rendered),
        "recording": content["recording"]["id"],
    }


def failed(problem: Problem, lang: str, *, board: str | None = None, file: str | None = None) -> Outcome:
    """The outcome where there is no certificate, with the reason as a sentence."""
    return {
        "file": file,
        "board": board,
        "certificate": None,
        "verdict": "error",
        "error": sentence(problem, lang),
        "code": problem.code,
        "values": json.loads(json.dumps(problem.values, default=str)),
        "axes": {},
        "warnings": [],
        "documents": {},
    }


def write_documents(
    content: Mapping[str, Any], out: Path, lang: str, rendered: Mapping[str, bytes] | None = None
) -> dict[str, str]:
    """One file a format, named after the certificate; each is whole or absent."""
    out.mkdir(parents=True, exist_ok=True)
    written = {}
    for kind in documents.FORMATS:
        path = out / f"{content['number']}.{kind}"
        part = path.with_name(f".{path.name}.part")
        try:
            part.write_bytes(rendered[kind] if rendered else documents.render(content, kind, lang))
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
        written[kind] = str(path)
    return written


def tell(outcome: Outcome, lang: str, *, as_json: bool) -> None:
    """One line of JSON, or lines for people; an error goes to stderr, where it is read in either case."""
    if as_json:
        print(json.dumps(outcome, ensure_ascii=False, allow_nan=False), flush=True)
    elif outcome["error"] is None:
        print("\n".join(_lines(outcome, lang)), flush=True)
    if outcome["error"] is not None:
        named = outcome["file"] is None or outcome["error"].startswith(outcome["file"])
        print(outcome["error"] if named else f"{outcome['file']}: {outcome['error']}", file=sys.stderr, flush=True)


def _lines(outcome: Outcome, lang: str) -> list[str]:
    axes = outcome["axes"]
    rows = [("", "", *(render("certificate.axis", {"axis": axis}, lang) for axis in axes))]
    for field in FIELDS:
        if any(field.of(figures) is not None for figures in axes.values()):
            written = (field.written(figures) for figures in axes.values())
            rows.append((documents.figure_name(field, lang), field.unit, *written))
    widths = [max(map(columns, column)) for column in zip(*rows, strict=True)]
    verdict = render(f"outcome.{outcome['verdict']}", {}, lang)
    lines = [render("outcome.board", {**outcome, "verdict": verdict}, lang), ""]
    for label, unit, *values in rows:
        right = "  ".join(
            " " * (width - columns(value)) + value for value, width in zip(values, widths[2:], strict=True)
        )
        lines.append(f"  {label}{' ' * (widths[0] - columns(label))}  {right}  {unit}".rstrip())
    lines += [f"  ! {warning['sentence']}" for warning in outcome["warnings"]]
    return [*lines, "", *(f"  {path}" for path in outcome["documents"].values())]


def columns(text: str) -> int:
    """Columns on a terminal: Thai vowels and tone marks stand above or below their letter."""
    return sum(unicodedata.category(letter) != "Mn" for letter in text)
