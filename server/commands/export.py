"""`gyrobench export`: recordings as CSV or Parquet; the model of a recording as JSON, C or Python that compensates."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib_core.problem import Problem
from calib_core.recording import Recording, read
from server.cli import data_option
from server.recording_files import FORMS, fast_path, save, whole
from server.texts import render

if TYPE_CHECKING:
    from calib_core.compensation import Compensation

EXAMPLE = "gyrobench export 4f2a9c01d7e3 --out LPY-1.csv.gz"
CODE = (".json", ".h", ".py")


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help="a stored recording's or model's id, a recording's file, or the JSON of diagnose or export",
    )
    parser.add_argument(
        "--out",
        required=True,
        metavar="FILE",
        help="a recording as .csv, .csv.gz or .parquet (samples at 1 kHz, where there are any, go beside it as "
        "FILE.fast.csv), or its model as .json, .h (C99) or .py",
    )
    parser.add_argument("--axis", choices=("x", "y", "z"), help="of a model: the gyro axis (default: as diagnose)")
    parser.add_argument(
        "--effects", metavar="A,B", help="of a model: fit these and no others (default: what diagnose finds missing)"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    data_option(parser)


def main(args: argparse.Namespace) -> int:
    out = Path(args.out)
    ending = next((e for e in (*FORMS, *CODE) if out.name.endswith(e) and out.name != e), None)
    if ending is None:
        raise Problem("recording_file.form", path=str(out), allowed=", ".join((*FORMS, *CODE)))
    if ending in CODE:
        return _model(args, out, ending)
    recording, fast = _load(args.source, args.data)
    files = {out: recording} | ({fast_path(out): fast} if fast else {})
    for path, content in files.items():
        save(content, path)
    told = {"files": [str(path) for path in files], "samples": len(recording), "digest": recording.digest()}
    print(json.dumps(told) if args.json else render("export.done", told, args.lang))
    return 0


def _model(args: argparse.Namespace, out: Path, ending: str) -> int:
    from calib_core.compensation_body import inputs
    from server.compute import compensation_text

    compensation = _compensation(args)
    tree = compensation.to_json()
    text = compensation_text(compensation, ending[1:])
    with whole(out) as file:
        file.write(text.encode())
    if args.json:
        print(json.dumps(tree | {"files": [str(out)]}))
        return 0
    undone = compensation.undone or {"code": "export.no_effects"}
    told = {"file": str(out), "axis": compensation.axis, "inputs": inputs(compensation), "effects": undone}
    print(render("export.compensation", told, args.lang))
    if compensation.delay_s:
        print(render("export.delay", {"delay_s": compensation.delay_s}, args.lang))
    for name, reason in compensation.left_out:
        left = {"effect": name, "reason": {"code": f"export.reason.{reason}"}}
        print(render("export.left_out", left, args.lang))
    return 0


def _compensation(args: argparse.Namespace) -> "Compensation":
    """From the JSON of a diagnosis or of an earlier export, or a saved model; else the recording is diagnosed here."""
    from calib_core.compensation import FORMAT, Compensation

    if args.source.endswith(".json") and Path(args.source).is_file():
        text = Path(args.source).read_bytes()
        tree = _tree(text)
        if "after" in tree:
            return Compensation.of_diagnosis(tree, as_asked=args.effects is not None)
        return Compensation.from_json(tree or {"format": f"not {FORMAT}"})
    from server.diagnosis import of_recording
    from server.store_effects import suspects_of
    from server.store_models import saved_in

    saved = None if Path(args.source).is_file() else saved_in(args.data, args.source)
    if saved is not None:
        return saved

    recording, _ = _load(args.source, args.data)
    effects = [name.strip() for name in (args.effects or "").split(",") if name.strip()]
    suspects = suspects_of(args.data)
    answer = of_recording(recording, axis=args.axis, effects=effects, file=Path(args.source).name, suspects=suspects)
    answer["recording"]["digest"] = recording.digest()
    return Compensation.of_diagnosis(answer, as_asked=args.effects is not None)


def _tree(text: bytes) -> dict[str, Any]:
    try:
        tree = json.loads(text)
    except ValueError:
        return {}
    return tree if isinstance(tree, dict) else {}


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
