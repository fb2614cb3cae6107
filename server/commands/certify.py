"""`gyrobench certify`: recordings of whole sessions become certificates, on the path that a run takes too."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from calib_core.problem import Problem
from server.cli import FAILED, data_option, os_problem

EXAMPLE = "gyrobench certify LPY-1.csv.gz --spec lab.json --out certificates"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("files", nargs="+", metavar="FILE", help="recordings: .csv, .csv.gz or .parquet")
    parser.add_argument("--out", required=True, metavar="DIR", help="where the documents go")
    parser.add_argument("--spec", metavar="FILE", help="limits as JSON; without them the verdict is `issued`")
    parser.add_argument(
        "--gyro-model", metavar="ID", help="datasheet (default: what the recording says, else LPY503AL-OUT)"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object a file on stdout")
    data_option(parser)


def main(args: argparse.Namespace) -> int:
    from server import outcome
    from server.store import Store

    spec = outcome.read_spec(args.spec)
    out = Path(args.out)
    verdicts = []
    with Store(args.data) as store:
        model = store.gyro_models.get(args.gyro_model) if args.gyro_model else None
        for file in args.files:
            try:
                found = outcome.certified(_certify(store, Path(file), model, spec), out, args.lang, file=file)
            except Problem as problem:
                found = outcome.failed(problem, args.lang, file=file)
            except OSError as error:
                found = outcome.failed(os_problem(error), args.lang, file=file)
            outcome.tell(found, args.lang, as_json=args.json)
            verdicts.append(found["verdict"])
    return FAILED if {"fail", "error"} & set(verdicts) else 0


def _certify(store: Any, file: Path, model: Any, spec: Any) -> dict[str, Any]:
    """The issued certificate of one file. Nothing of it is kept where it cannot be certified."""
    from calib_core.recording import read
    from server.certify import content

    with file.open("rb") as opened:
        recording = read(opened, name=file.name)
    board = recording.header.get("board") or file.name.split(".")[0]
    recording = replace(recording, header={**recording.header, "board": board})
    found = content(recording, "", gyro_model=model, spec=spec)
    store.boards.ensure(board, gyro_model=model.id if model else "LPY503AL-OUT")
    # The same file again is the same recording, and so the same certificate.
    facts = (found["recording"]["digest"], recording.header)
    same = (row["id"] for row in store.recordings.find(board=board)[0] if (row["digest"], row["header"]) == facts)
    found["recording"]["id"] = next(same, None) or store.recordings.add(recording, board=board, name=file.name)
    return dict(store.issue_certificate(found))
