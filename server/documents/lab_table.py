"""Results of a blind exercise as CSV: one row a student."""

import csv
import io
from collections.abc import Iterable, Mapping
from typing import Any

from server.documents.csv_table import FORMULA

COLUMNS = (
    "name", "submitted_at", "answer", "confidence_pct", "score", "right", "ties", "too_wide", "wrong", "missing",
    "instrument_verdict", "instrument_found", "truth", "runs", "bench_s", "reasoning",
)  # fmt: skip


def render_results(hidden: Mapping[str, Any], students: Iterable[Mapping[str, Any]]) -> bytes:
    """``students`` as `server.api.lab` shows them to the teacher; a tie is written a|b, findings are joined by +."""
    file = io.StringIO(newline="")
    table = csv.DictWriter(file, COLUMNS, restval="", lineterminator="\r\n")
    table.writeheader()
    truth = "+".join(one["effect"] for one in hidden["effects"]) or "none"
    for student in students:
        answer, graded, said = student["answer"], student["grade"], student["diagnosis"]
        row: dict[str, Any] = {
            "name": student["name"],
            "runs": student["runs"],
            "bench_s": f"{student['measured_s']:.0f}",
        }
        if answer is not None:
            marks = [mark["mark"] for mark in graded["marks"]]
            row |= {
                "submitted_at": student["submitted_at"],
                "answer": "+".join("|".join(names) for names in answer["findings"]) or "none",
                "confidence_pct": answer["confidence"],
                "reasoning": " ".join(answer["reasoning"].split()),
                "score": graded["score"],
                "missing": "+".join(graded["missing"]),
                **{name: marks.count(mark) for name, mark in COUNTED.items()},
            }
        if said is not None and "message" not in said:
            row["instrument_verdict"] = said["verdict"]
            row["instrument_found"] = "+".join(found["effect"] for found in said["missing"])
        table.writerow({name: _text(value) for name, value in (row | {"truth": truth}).items()})
    return b"\xef\xbb\xbf" + file.getvalue().encode()  # spreadsheets take Thai for Latin without the mark


COUNTED = {"right": "right", "ties": "tie", "too_wide": "too_wide", "wrong": "wrong"}


def _text(value: object) -> object:
    return f"'{value}" if isinstance(value, str) and value.startswith(FORMULA) else value
