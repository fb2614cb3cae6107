"""`gyrobench diagnose`: compares the model with recordings and names what is missing."""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from calib_core.problem import Problem
from server.cli import data_option
from server.recording_files import form_of, save
from server.texts import render

EXAMPLE = """gyrobench diagnose LPY-1.csv.gz --axis x
  gyrobench diagnose calib_core/thesis/data/rate.csv --json
  gyrobench diagnose LPY-1.csv.gz --rig 'twin:?seed=1' --out both.csv.gz"""


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("files", nargs="+", metavar="FILE", help="recordings (.csv, .csv.gz, .parquet), or points")
    parser.add_argument(
        "--axis", choices=("x", "y", "z"), help="the gyro axis (default: the recording's own, or first)"
    )
    parser.add_argument("--effects", type=_names, default=(), metavar="A,B", help="effects that the model already has")
    parser.add_argument(
        "--rig", metavar="URL", help="does there what would settle the diagnosis (the same board has to be on it)"
    )
    parser.add_argument(
        "--experiments", type=int, default=1, metavar="N", help="with --rig: at most so many motions (default 1)"
    )
    parser.add_argument("--out", metavar="FILE", help="with --rig: all data together, as .csv, .csv.gz or .parquet")
    parser.add_argument("--json", action="store_true", help="one JSON object an input on stdout")
    data_option(parser)


def main(args: argparse.Namespace) -> int:
    from server import diagnosis

    if args.rig is None and args.out:
        raise Problem("diagnosis.out_without_rig")
    if args.rig is not None and len(args.files) > 1:
        raise Problem("diagnosis.one_file", files=len(args.files))
    if args.out:
        form_of(Path(args.out))
    for file in args.files:
        if sys.stderr.isatty():
            print(f"\r\033[K{file} …", end="", file=sys.stderr, flush=True)
        answers = [diagnosis.told(answer, args.lang) for answer in _of(Path(file), args)]
        if sys.stderr.isatty():
            print("\r\033[K", end="", file=sys.stderr, flush=True)
        for answer in answers:
            print(json.dumps(answer, ensure_ascii=False) if args.json else "\n".join(lines(answer, args.lang)))
    return 0


def _of(file: Path, args: argparse.Namespace) -> list[dict[str, Any]]:
    from server import diagnosis
    from server.store_effects import address_of, suspects_of

    suspects = suspects_of(args.data)
    if args.rig is None:
        return diagnosis.of_file(file, axis=args.axis, effects=args.effects, suspects=suspects)
    from calib_core.recording import read
    from server import experiments
    from server.devices import open_rig

    with file.open("rb") as opened:
        hand = read(opened, name=file.name)
    axis = diagnosis.axis_of(hand, args.axis)
    with closing(open_rig(address_of(args.rig, args.data))) as rig:
        rig.open()
        answer, both = experiments.run(hand, axis, rig, effects=args.effects, suspects=suspects, most=args.experiments)
    if args.out:
        save(both, Path(args.out))
    answer["recording"]["file"] = file.name
    return [answer]


def lines(answer: dict[str, Any], lang: str) -> Iterator[str]:
    """The answer as text: the verdict, where the model fails, evidence, limits, errors, parameters."""

    def head(name: str, body: Sequence[str]) -> Iterator[str]:
        if body:
            yield from ("", render(f"diagnosis.head.{name}", {}, lang), *(f"  {line}" for line in body))

    record = answer["recording"]
    what = "title" if record["duration_s"] is not None else "title_points"
    values = {"duration": record["duration_s"], **record, "axis": answer["axis"]}
    yield render(f"diagnosis.{what}", values, lang)
    yield f"{render('diagnosis.word.' + answer['verdict'], {}, lang)}  {answer['sentence']}"
    for done in answer.get("experiments", ()):
        yield render("diagnosis.done", {"sentence": done["sentence"]}, lang)
    yield from head("checks", [check["sentence"] for check in answer["checks"] if not check["ok"]])
    yield from head("fails", [failure["sentence"] for failure in answer["where_it_fails"]])
    yield from head("evidence", [finding["sentence"] for finding in answer["missing"]])
    yield from head("limits", [limit["sentence"] for limit in answer["limits"]])
    if answer["next_experiment"] and "sentence" in answer["next_experiment"]:
        yield from head("next", [answer["next_experiment"]["sentence"]])
    if answer["error"] is not None:
        yield from head("error", _errors(answer, lang))
        found = [*answer["after"]["parameters"], *(p for m in answer["missing"] for p in m["parameters"])]
        yield from head("parameters", _parameters(list({p["name"]: p for p in found}.values()), lang))
    yield ""


def _errors(answer: dict[str, Any], lang: str) -> list[str]:
    from server.diagnosis import errors

    before, after, floor, unit = errors(answer)
    told = {"model": before, "after": after, "floor": floor}
    if not answer["missing"]:
        del told["after"]
    names = {key: render(f"diagnosis.error.{key}", {}, lang) for key in told}
    width = max(map(len, names.values()))
    return [f"{names[key]:<{width}}  {value:g} {unit}" for key, value in told.items()]


def _parameters(parameters: Sequence[Mapping[str, Any]], lang: str) -> list[str]:
    from calib_core.certificate import scaled

    def name(full: str) -> str:
        plain = next((key for key in ("bias", "scale_factor") if full.startswith(f"{key}_") and "." not in full), "")
        return render(f"diagnosis.{plain}", {}, lang) if plain else full

    rows = [(name(p["name"]), scaled(p["value"], p["standard_uncertainty"] or 0.0), p["unit"]) for p in parameters]
    width = max(len(word) for word, _, _ in rows)
    return [f"{word:<{width}}  {value} {'' if unit == '1' else unit}".rstrip() for word, value, unit in rows]


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())
