"""`gyrobench backup`: the whole database in one file, as it is at one moment, while everything goes on."""

import argparse
from pathlib import Path

from server.cli import data_option

EXAMPLE = "gyrobench backup lab-2026-11-22.sqlite"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="where the copy goes; a file that is there is not touched")
    data_option(parser)


def main(args: argparse.Namespace) -> int:
    from server.settings import data_dir
    from server.store_copy import backup
    from server.texts import render

    file = Path(args.file)
    size = backup(data_dir(args.data), file)
    print(render("backup.done", {"file": str(file), "size_MB": size / 1e6}, args.lang))
    return 0
