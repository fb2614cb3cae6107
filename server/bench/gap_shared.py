"""The worked recordings of ../shared/hidden_effects with their truth, where they are at hand."""

import json
from collections.abc import Iterator
from pathlib import Path

from server.bench import Row

FOLDER = Path(__file__).resolve().parents[3] / "shared"


def hidden_effects() -> Iterator[Row]:
    """How many of them are named as they are: exactly, or in the declared tie where METHOD expects one."""
    from calib_core.recording import read
    from server.diagnosis import of_recording

    folder = FOLDER / "hidden_effects"
    if not folder.is_dir():
        yield Row("hidden_effects: named as they are", float("nan"), "", ours="../shared/hidden_effects is not here")
        return
    lines = (folder / "truth.jsonl").read_text(encoding="utf-8").splitlines()
    wrong, truths = [], [json.loads(line) for line in lines]
    for truth in truths:
        with (folder / f"{truth['id']}.csv.gz").open("rb") as opened:
            said = of_recording(read(opened), axis=truth["axis"])
        found = {finding["effect"] for finding in said["missing"]}
        tied = {name for names in said["rivals"] for name in names}
        if truth["id"] == "unknown":
            right = said["verdict"] == "unknown" and not found
        elif not truth["effects"]:
            right = said["verdict"] == "adequate"
        else:
            right = set(truth["effects"]) <= found | tied and len(found) == len(truth["effects"])
        if not right:
            wrong.append(f"{truth['id']} -> {said['verdict']} {sorted(found)} {sorted(tied)}")
    n = len(truths)
    told = f"{n - len(wrong)}/{n}; {'; '.join(wrong)}" if wrong else f"{n}/{n}"
    yield Row("hidden_effects: named as they are", 100.0 * (n - len(wrong)) / n, "%", 100.0, True, told)
