"""`gyrobench import`: recordings, foreign columns renamed, into the store or into a file of our own form."""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from calib_core.problem import Problem
from calib_core.recording import Recording, read
from server.cli import data_option
from server.recording_files import form_of, save
from server.texts import render

EXAMPLE = "gyrobench import imu.csv --map t=time_s --map gyro_x=x_gyro_dps --header reference=stationary --board IMU-1"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("files", nargs="+", metavar="FILE", help="recordings: .csv, .csv.gz or .parquet")
    parser.add_argument(
        "--map", action="append", default=[], metavar="THEIRS=OURS", help="renames a column; may be given several times"
    )
    parser.add_argument(
        "--header", action="append", default=[], metavar="KEY=VALUE", help="a header line, such as reference=stationary"
    )
    parser.add_argument("--board", metavar="ID", help="the board it is of (default: what the file says, else unknown)")
    parser.add_argument("--out", metavar="FILE", help="write this .csv, .csv.gz or .parquet instead of the store")
    parser.add_argument("--json", action="store_true", help="one JSON object a file on stdout")
    data_option(parser)


def main(args: argparse.Namespace) -> int:
    mapping, header = _pairs("--map", args.map), _pairs("--header", args.header)
    if args.board:
        header["board"] = args.board
    if args.out and len(args.files) > 1:
        raise Problem("import.one_file", files=len(args.files))
    if args.out:
        form_of(Path(args.out))
    for file in map(Path, args.files):
        try:
            with file.open("rb") as opened:
                recording = read(opened, name=file.name, mapping=mapping)
        except Problem as problem:
            reason = {"code": problem.code, "values": problem.values}
            raise Problem("import.refused", file=str(file), reason=reason) from None
        recording = replace(recording, header={**recording.header, **header})
        board = recording.header.get("board") or "unknown"
        if args.out:
            save(recording, Path(args.out))
            kept = args.out
        else:
            kept = _store(args.data, recording, board, file.name)
        told = {
            "file": str(file), "recording": kept, "board": board, "samples": len(recording),
            "duration_s": recording.duration_s, "axes": list(recording.axes), "digest": recording.digest(),
            "left_out": recording.header.get("left_out", ""),
        }  # fmt: skip
        if args.json:
            print(json.dumps(told, ensure_ascii=False))
        else:
            print(render("import.done", told, args.lang))
            if told["left_out"]:
                print(render("import.left_out", told, args.lang))
    return 0


def _store(data: str | None, recording: Recording, board: str, name: str) -> str:
    """The id under which the store keeps it."""
    from server.store import Store

    with Store(data) as store:
        store.boards.ensure(board, gyro_model="LPY503AL-OUT")
        return store.recordings.add(recording, board=board, name=name)


def _pairs(option: str, given: Sequence[str]) -> dict[str, str]:
    """``KEY=VALUE`` words as a dictionary; raises Problem ``import.pair``."""
    pairs = {}
    for word in given:
        key, equals, value = (part.strip() for part in word.partition("="))
        if not (key and equals and value):
            raise Problem("import.pair", option=option, given=word)
        pairs[key] = value
    return pairs
