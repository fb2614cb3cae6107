"""A certificate as PDF, CSV and JSON: the same content, the same bytes whenever it is asked for."""

import json
from collections.abc import Mapping
from typing import Any

from calib_core.certificate import TEST_DECIMALS, Field, scaled
from calib_core.problem import Problem
from server import texts

FORMATS = ("pdf", "csv", "json")


def warning_sentence(warning: Mapping[str, Any], lang: str = "en") -> str:
    """What a warning says, with the state it is about."""
    state = f"{texts.render('state.' + warning['state'], {}, lang)}: " if "state" in warning else ""
    return state + texts.render(f"warning.{warning['code']}", warning["values"], lang)


def figure_name(field: Field, lang: str = "en") -> str:
    """The name of a certified number with the test that it is from: `Rate test: Bias error`."""
    test = field.path[0] if field.path[0] in TEST_DECIMALS else None
    return (f"{texts.render(f'certificate.{test}', {}, lang)}: " if test else "") + texts.render(field.text, {}, lang)


def compensation_words(compensation: Mapping[str, Any]) -> dict[str, Any]:
    """What fills the statement of the model that a certificate's axis was compensated by: its terms, and its limits."""
    terms = [
        f"{p['name']} = {scaled(p['value'], p['standard_uncertainty'] or 0.0)} {p['unit']}".removesuffix(" 1")
        for p in compensation["parameters"]
        if "." in p["name"]
    ]
    left = [row["effect"] for row in compensation["left_out"]]
    return {
        "axis": compensation["axis"],
        "name": compensation["name"],
        "model": compensation["model"],
        "terms": "; ".join(terms) or "–",
        "left_out": {"code": "certificate.compensation.left_out", "values": {"effects": left}} if left else "",
    }


def render(content: Mapping[str, Any], kind: str, lang: str = "en") -> bytes:
    """The certificate's ``content`` as a document of one of FORMATS; ``lang`` is the PDF's. Raises Problem.

    A PDF takes about half a second of CPU: not for an event loop.
    """
    if kind == "json":
        return (json.dumps(content, ensure_ascii=False, indent=1, allow_nan=False) + "\n").encode()
    if kind == "csv":
        from server.documents.csv_table import render_csv

        return render_csv(content)
    if kind == "pdf":
        from server.documents.pdf import render_pdf

        return render_pdf(content, lang)
    raise Problem("document.format", given=kind, allowed=", ".join(FORMATS))
