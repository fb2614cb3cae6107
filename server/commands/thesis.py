"""`gyrobench thesis`: the thesis' tables computed again from its readings, beside what it prints."""

import argparse
import json
import math
import re
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from server.outcome import columns
from server.texts import render, texts

EXAMPLE = "gyrobench thesis --json"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument("--seeds", type=_count, metavar="N", help="simulated records of 4.2 (default 20)")


def main(args: argparse.Namespace) -> int:
    from calib_core.thesis import SEEDS, report

    progress = _progress(args.lang) if sys.stderr.isatty() else None
    found = report(args.seeds or SEEDS, progress=progress)
    for one in found["disagreements"]:
        place = {"table": words("place", one["table"], args.lang)}
        one["sentence"] = render(one["code"], one["values"] | place, args.lang)
    if args.json:
        print(json.dumps(found, ensure_ascii=False))
    else:
        print("\n".join(lines(found, args.lang)))
    return 0


def lines(report: Mapping[str, Any], lang: str) -> list[str]:
    """The report as text: every table, then what disagrees, then the counts."""
    told = [render("thesis_report.head", {}, lang), ""]
    for table in report["tables"]:
        told += [_title(table, lang), *_grid(table["rows"], lang), ""]
    told += [render("thesis_report.disagreements", {"count": len(report["disagreements"])}, lang)]
    told += [f"- {one['sentence']}" for one in report["disagreements"]]
    told += ["", render("thesis_report.statistics", report["statistics"], lang)]
    return [*told, render("thesis_report.lines", report["lines"], lang)]


def _title(table: Mapping[str, Any], lang: str) -> str:
    return f"{words('place', table['table'], lang)}  " + render(table["title"]["code"], table["title"]["values"], lang)


def _grid(rows: Sequence[Mapping[str, Any]], lang: str) -> list[str]:
    """One line a set-point or name, two columns a quantity: printed and recomputed, ≠ where they differ."""
    units: dict[str, set[str]] = {}
    for row in rows:
        units.setdefault(row["quantity"], set()).add(row["unit"].removeprefix("1"))
    lined: dict[str, dict[str, str]] = {}
    for row in rows:
        # A unit that a column shares stands in its head, any other beside its value.
        unit = f" {row['unit'].removeprefix('1')}" if len(units[row["quantity"]]) > 1 else ""
        name = " ".join(part for part in (row["board"], row["axis"], words("row", row["row"], lang)) if part)
        lined.setdefault(name, {})[row["quantity"]] = (_cell(row, lang) + unit).rstrip()
    heads = {
        quantity: ", ".join(filter(None, (render(f"thesis_quantity.{quantity}", {}, lang), *of)))
        if len(of) == 1
        else render(f"thesis_quantity.{quantity}", {}, lang)
        for quantity, of in units.items()
    }
    wide = {
        q: max(columns(head), *(columns(cells.get(q, "")) for cells in lined.values())) for q, head in heads.items()
    }
    first = max(map(columns, lined))
    return [
        name + " " * (first - columns(name))
        + "".join("   " + " " * (wide[q] - columns(cells.get(q, ""))) + cells.get(q, "") for q in units)
        for name, cells in {"": heads, **lined}.items()
    ]  # fmt: skip


def words(kind: str, name: str, lang: str) -> str:
    """What the thesis' tables call a row or a place, in the reader's language; a number is its own name."""
    key = f"thesis_{kind}.{re.sub('[^a-z0-9]+', '_', name.lower())}"
    return render(key, {}, lang) if key in texts("en") else name


def _cell(row: Mapping[str, Any], lang: str) -> str:
    printed, recomputed, places = row["printed"], row["recomputed"], row["decimals"]
    if recomputed is None:
        return f"{printed:g}" if isinstance(printed, float) else words("row", str(printed), lang)
    if printed is None:
        return f"{recomputed:.{places}f}"
    # A mean that lies halfway between two printable numbers is not rounded by its last bit, but as it was printed.
    right = f"{recomputed + math.copysign(1e-9, printed - recomputed):.{places}f}"
    return f"{printed:.{places}f} {'=' if row['same'] else '≠'} {right}"


def _progress(lang: str) -> Any:
    def show(done: int, of: int) -> None:
        end = "\r" if done < of else "\r\033[K"
        print(render("thesis_report.simulating", {"done": done, "of": of}, lang), end=end, file=sys.stderr, flush=True)

    return show


def _count(word: str) -> int:
    count = int(word)
    if not 1 <= count <= 1000:
        raise ValueError
    return count
