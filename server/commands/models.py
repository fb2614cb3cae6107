"""`gyrobench models`: saved models; one is fitted to a stored recording and kept, or forgotten."""

import argparse
import json
from collections.abc import Iterator
from typing import Any

from calib_core.problem import Problem
from server.cli import data_option
from server.texts import render

EXAMPLE = """gyrobench models --board LPY-1
  gyrobench models --save 'bent x' --recording 4f2a9c01d7e3 --axis x --effects scale_factor_cubic,time_offset"""


def add(parser: argparse.ArgumentParser) -> None:
    one = parser.add_mutually_exclusive_group()
    one.add_argument("--save", metavar="NAME", help="fit base and effects to --recording, and keep it as NAME")
    one.add_argument("--remove", metavar="ID", help="forget a model; certificates that carry it stay as they are")
    parser.add_argument("--recording", metavar="ID", help="a stored recording; without --save: only its models")
    parser.add_argument("--axis", choices=("x", "y", "z"), default="x", help="with --save: the gyro axis (default x)")
    parser.add_argument("--effects", default="", metavar="A,B", help="with --save: of the library or your own")
    parser.add_argument("--note", default="", help="with --save: what it is for")
    parser.add_argument("--board", default="", metavar="ID", help="only models of this board")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    data_option(parser)


def main(args: argparse.Namespace) -> int:
    from server.settings import data_dir
    from server.store import Store

    if args.save:
        from server.compute import save_model

        if not args.recording:
            raise Problem("cli.required", command="gyrobench models --save", name="--recording")
        effects = [name.strip() for name in args.effects.split(",") if name.strip()]
        save_model(data_dir(args.data), args.save, args.recording, args.axis, effects, args.note)
    models: list[dict[str, Any]] = []
    with Store(args.data) as store:
        if args.remove:
            store.models.delete(args.remove)
        cursor = None
        while True:
            page, cursor = store.models.find(board=args.board, recording=args.recording or "", cursor=cursor)
            models += page
            if cursor is None:
                break
    if args.json:
        print(json.dumps({"models": models}, ensure_ascii=False))
    else:
        print("\n".join(lines(models, args.lang)) or render("model.none", {}, args.lang))
    return 0


def lines(models: list[dict[str, Any]], lang: str) -> Iterator[str]:
    """A line each: id, name, board and axis, effects, error on data not seen."""
    for row in models:
        error = {"error": row["error"]["held_out_rms_dps"], "error_unit": "deg/s"}
        yield render("model.line", {**row, **error, "effects": ", ".join(row["effects"]) or "–"}, lang)
