"""`gyrobench verify`: a certificate is computed again from its recording."""

import argparse
import json
from pathlib import Path
from typing import Any

from calib_core.problem import Problem
from server.cli import FAILED, data_option

EXAMPLE = "gyrobench verify certificates/GB-2026-00001.json"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("files", nargs="+", metavar="FILE", help="certificates as .json")
    parser.add_argument("--recording", metavar="FILE", help="the recording, where the store does not have it")
    parser.add_argument("--json", action="store_true", help="one JSON object a file on stdout")
    data_option(parser)


def main(args: argparse.Namespace) -> int:
    from server.store import Store
    from server.texts import render

    valid = True
    with Store(args.data) as store:
        for file in args.files:
            found = {"file": file, **_verify(store, Path(file), args.recording)}
            valid &= found["valid"]
            if args.json:
                print(json.dumps(found, ensure_ascii=False))
            else:
                print(render(f"verify.{found['code']}", found, args.lang))
                for difference in found["differences"]:
                    print("  " + render("verify.difference", difference | _apart(**difference), args.lang))
                versions = found.get("software", {})
                if found["differences"] and versions["certified"] != versions["computed"]:
                    print("  " + render("verify.other_version", versions, args.lang))
    return 0 if valid else FAILED


def _apart(certified: Any, computed: Any, **_: str) -> dict[str, Any]:
    """Two numbers with as many digits as tell them apart."""
    if isinstance(certified, float) and isinstance(computed, float):
        for digits in range(6, 18):
            written = {"certified": f"{certified:.{digits}g}", "computed": f"{computed:.{digits}g}"}
            if written["certified"] != written["computed"]:
                return written
    return {}


def _verify(store: Any, file: Path, recording_file: str | None) -> dict[str, Any]:
    """What a certificate's file is worth; raises Problem where it is not one."""
    from calib_core.recording import read
    from server.certify import FORMAT, verify

    try:
        certificate = json.loads(file.read_text(encoding="utf-8"))
    except ValueError:
        certificate = None
    if not isinstance(certificate, dict) or certificate.get("format") != FORMAT:
        raise Problem("verify.not_a_certificate", path=str(file))
    number = str(certificate.get("number"))
    try:
        if recording_file:
            with Path(recording_file).open("rb") as opened:
                recording = read(opened, name=recording_file)
        else:
            recording = store.recording(certificate["recording"]["id"])
        found = verify(certificate, recording)
    except Problem as problem:
        if problem.code != "recording.not_found":
            raise
        return {"number": number, "valid": False, "code": "no_recording", "digest_ok": None, "differences": []}
    code = "valid" if found["valid"] else "changed" if found["digest_ok"] else "other_recording"
    return {"number": number, "code": code, **found}
