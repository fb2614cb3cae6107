"""`gyrobench export`: a stored recording, or a file in another form, as CSV, gzipped CSV or Parquet."""

import argparse
import json
from pathlib import Path

from calib_core.problem import Problem
from calib_core.recording import Recording, read
from server.cli import data_option
from server.recording_files import fast_path, form_of, save
from server.texts import render

EXAMPLE = "gyrobench export 4f2a9c01d7e3 --out LPY-1.csv.gz"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", metavar="RECORDING", help="a stored recording's id, or a file to convert")
    parser.add_argument(
        "--out",
        required=True,
        metavar="FILE",
        help="a .csv, .csv.gz or .parquet; samples at 1 kHz, where there are any, go beside it as FILE.fast.csv",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    data_option(parser)


def main(args: argparse.Namespace) -> int:
    out = Path(args.out)
    form_of(out)
    recording, fast = _load(args.recording, args.data)
    files = {out: recording} | ({fast_path(out): fast} if fast else {})
    for path, content in files.items():
        save(content, path)
    told = {"files": [str(path) for path in files], "samples": len(recording), "digest": recording.digest()}
    print(json.dumps(told) if args.json else render("export.done", told, args.lang))
    return 0


def _load(name: str, data: str | None) -> tuple[Recording, Recording | None]:
    """The recording of a file or of the store, and its 1 kHz samples where the store has them."""
    if Path(name).is_file():
        with Path(name).open("rb") as opened:
            return read(opened, name=name), None
    from server.store import Store

    with Store(data) as store:
        recording = store.recording(name)
        try:
            return recording, store.recordings.load(name, kind="fast")
        except Problem as problem:
            if problem.code != "recording.empty":
                raise
            return recording, None
