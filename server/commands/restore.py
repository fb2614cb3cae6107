"""`gyrobench restore`: the database as a backup has it; what was there is kept beside it first."""

import argparse
from pathlib import Path

from server.cli import data_option

EXAMPLE = "gyrobench restore lab-2026-11-22.sqlite --data ./lab"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="a copy that `gyrobench backup` made")
    data_option(parser)


def main(args: argparse.Namespace) -> int:
    from server.settings import data_dir
    from server.store_copy import restore
    from server.texts import render

    kept = restore(Path(args.file), data_dir(args.data))
    print(render("restore.done", {"file": args.file}, args.lang))
    if kept is not None:
        print(render("restore.kept", {"file": str(kept)}, args.lang))
    return 0
