"""A certificate as PDF, CSV and JSON: complete, the same bytes every time, and nobody's text is code."""

import csv
import io
import json
from typing import Any

import pytest
from pypdf import PdfReader
from sessions import BOARD, session_recording

from calib_core.certificate import FIELDS
from calib_core.problem import Problem
from server import certify, documents
from server.documents.pdf import page
from server.texts import LANGUAGES

SPEC = {
    "name": "lab 2026",
    "axes": {"x": {"bias_V": {"min": 1.2, "max": 1.3}, "rate": {"nonlinearity_pct_fs": {"max": 0}}}},
}
HOSTILE = '#panic("x") $x^2$ *b* @ref <l> \\ `r` //c [#sys] =HYPERLINK("http://x") \u202e\x07'


@pytest.fixture(scope="module")
def content() -> dict[str, Any]:
    issued = {"number": "GB-2026-00042", "issued_at": "2026-11-22T07:10:00.654321Z"}
    return {**certify.content(session_recording(), "rec1", spec=SPEC), **issued}


def text_of(pdf: bytes) -> str:
    return " ".join(" ".join(page.extract_text() for page in PdfReader(io.BytesIO(pdf)).pages).split())


def test_the_same_certificate_gives_the_same_bytes(content: dict[str, Any]) -> None:
    for kind in documents.FORMATS:
        assert documents.render(content, kind) == documents.render(json.loads(json.dumps(content)), kind)


def test_the_pdf_says_who_what_when_how_and_how_sure_on_two_pages(content: dict[str, Any]) -> None:
    pdf = documents.render(content, "pdf")
    assert len(PdfReader(io.BytesIO(pdf)).pages) == 2
    said = text_of(pdf)
    for words in (
        "Certificate of calibration", "GB-2026-00042", BOARD, "Ada", "24.5 °C", "2026-11-22 06:10 – 06:55 UTC",
        "2026-11-22 07:10 UTC", "gyrobench 0.", "standard", "Simulated bench", "Reference not calibrated",
        "Fail: 1 of 2 limits of “lab 2026”", "relate only to the item", "Decision rule", "Authorised by",
        "Rate test: Non-linearity, %FS ≤ 0", "not met",
        "End of certificate", "page 2 of 2", "3 readings at each repeat set-point instead of the 22",
    ):  # fmt: skip
        assert words in said, words
    assert content["recording"]["digest"].removeprefix("sha256:")[:32] in said
    for field in FIELDS:
        for axis in "xz":
            assert field.written(content["axes"][axis]).replace("-", "−") in said, field


@pytest.mark.parametrize("lang", LANGUAGES)
def test_a_specification_of_every_figure_still_leaves_two_pages(lang: str) -> None:
    axes: dict[str, Any] = {}
    for axis in "xz":
        for field in FIELDS:
            node = axes.setdefault(axis, {})
            for name in field.path[:-1]:
                node = node.setdefault(name, {})
            node[field.path[-1]] = {"min": -0.5, "max": 2.5}
    issued = {"number": "GB-2026-00042", "issued_at": "2026-11-22T07:10:00.654321Z"}
    spec = {"name": "everything", "axes": axes}
    whole = {**certify.content(session_recording(), "rec1", spec=spec), **issued}
    assert len(whole["judgement"]) == 2 * len(FIELDS)
    assert len(PdfReader(io.BytesIO(documents.render(whole, "pdf", lang))).pages) == 2


def test_every_word_on_the_certificate_has_a_text_in_both_languages(content: dict[str, Any]) -> None:
    def words(node: object) -> list[str]:
        children = node.values() if isinstance(node, dict) else node if isinstance(node, list) else []
        return [node] if isinstance(node, str) else [word for child in children for word in words(child)]

    for lang in LANGUAGES:
        for word in words(page(content, lang)):
            # A missing text is rendered as its dotted key; see server/texts.py.
            assert not word.startswith(("certificate.", "figure.", "warning.", "budget.", "profile.")), word
            assert ": , " not in word
            assert "{" not in word


def test_the_thai_certificate_is_set_in_thai(content: dict[str, Any]) -> None:
    pdf = documents.render(content, "pdf", "th")
    assert len(PdfReader(io.BytesIO(pdf)).pages) == 2
    said = text_of(pdf)
    assert "ไบแอส สเกลแฟกเตอร์" in said  # words without marks above: pypdf does not put those back in order
    assert "แกน x" in said


def test_text_from_people_stays_text_in_every_format(content: dict[str, Any]) -> None:
    hostile = {**content, "note": HOSTILE, "operator": HOSTILE, "board": "B" * 300}
    said = text_of(documents.render(hostile, "pdf"))
    for word in ('#panic("x")', "$x^2$", "*b*", "@ref", "<l>", "`r`", "[#sys]"):
        assert word in said
    assert "\u202e" not in said
    cells = [row["value"] for row in rows_of({**content, "note": "=1+1"}) if row["name"] == "note"]
    assert cells == ["'=1+1"]


def rows_of(content: dict[str, Any]) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(documents.render(content, "csv").decode(), newline="")))


def test_the_csv_holds_every_certified_number_and_every_reading(content: dict[str, Any]) -> None:
    rows = rows_of(content)
    results = {(row["axis"], row["name"]): row for row in rows if row["section"] == "result"}
    for axis, figures in content["axes"].items():
        for field in FIELDS:
            assert float(results[axis, ".".join(field.path)]["value"]) == field.of(figures)
    bias = results["x", "bias_V"]
    assert float(bias["standard_uncertainty"]) == content["axes"]["x"]["bias_V"]["standard_uncertainty"]
    limits = [
        (row["section"], row["name"], float(row["value"]), row["unit"]) for row in rows if "limit" in row["section"]
    ]
    assert limits == [
        ("limit met", "bias_V.value.min", 1.2, "V"),
        ("limit met", "bias_V.value.max", 1.3, "V"),
        ("limit not met", "rate.nonlinearity_pct_fs.max", 0.0, "%FS"),
    ]
    readings = [row for row in rows if row["section"] == "rate_x/repeat" and row["name"] == "gyro"]
    assert len(readings) == 6 * 3


def test_the_json_is_the_content_itself(content: dict[str, Any]) -> None:
    assert json.loads(documents.render(content, "json")) == content


def test_a_certificate_of_one_axis_or_one_state_is_a_document_too() -> None:
    recording = session_recording()
    part = recording.take(recording.where(lambda name: name in ("hold", "estimate_z", "step_z")))
    content = {**certify.content(part, "r"), "number": "GB-1", "issued_at": "2026-11-22T07:10:00Z"}
    said = text_of(documents.render(content, "pdf"))
    assert "Only these states were run: estimate_z." in said
    assert "Issued without a specification" in said
    assert documents.render(content, "csv")


def test_an_unknown_format_is_refused(content: dict[str, Any]) -> None:
    with pytest.raises(Problem, match=r"document\.format"):
        documents.render(content, "docx")
