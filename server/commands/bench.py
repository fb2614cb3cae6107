"""`gyrobench bench`: the project's benchmarks, ratios side by side."""

import argparse
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from calib_core.problem import Problem
from server.bench import SUBJECTS, Row, run, table

EXAMPLE = "gyrobench bench core --json"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", nargs="?", metavar="NAME", help=f"{', '.join(SUBJECTS)} (default: all of them)")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions and seeds")
    parser.add_argument("--soak", action="store_true", help="bus: ten minutes of the emulated bench instead")
    parser.add_argument("--group", help="gap: one group of the campaign only")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="with --group: begin with its case number N")
    parser.add_argument("--count", type=int, metavar="N", help="with --group: so many of its cases")
    parser.add_argument(
        "--keep", type=Path, metavar="FILE", help="with --group: keep outcomes there and go on with them"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object instead of tables")


def main(args: argparse.Namespace) -> int:
    # Small products on shared cores: a second BLAS thread costs more than it brings (METHOD 3). Before numpy comes in.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if args.soak and args.name != "bus":
        raise Problem("bench.soak")
    if args.group and args.name != "gap":
        raise Problem("bench.slice")
    measured: dict[str, list[Row]] = {}
    for name in [args.name] if args.name else SUBJECTS:
        measured[name] = rows = []
        for row in _soak() if args.soak else _group(args) if args.group else run(name, quick=args.quick):
            rows.append(row)
            if sys.stderr.isatty():
                print(f"\r\033[K{name}: {row.name}", end="", file=sys.stderr, flush=True)
        if sys.stderr.isatty():
            print("\r\033[K", end="", file=sys.stderr, flush=True)
        if not args.json:
            print(f"{name}\n{table(rows)}", flush=True)
    if args.json:
        print(json.dumps({name: [row.to_json() for row in rows] for name, rows in measured.items()}))
    return 0


def _soak() -> list[Row]:
    from server.bench.bus_daq import soak

    return soak()


def _group(args: argparse.Namespace) -> Iterator[Row]:
    from server.bench.gap import part

    return part(args.group, args.first, args.count, args.keep)
