"""Recordings on disk, in the form that the file's name asks for."""

import gzip
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, cast

from calib_core.problem import Problem
from calib_core.recording import Recording, write_csv, write_parquet

FORMS = (".csv", ".csv.gz", ".parquet")


def form_of(path: Path) -> str:
    """The ending that says how to write ``path``; raises Problem ``recording_file.form`` for any other."""
    form = next((form for form in FORMS if path.name.endswith(form) and path.name != form), None)
    if form is None:
        raise Problem("recording_file.form", path=str(path), allowed=", ".join(FORMS))
    return form


def save(recording: Recording, path: Path) -> None:
    """Writes ``path`` whole or not at all; its directory is made where there is none."""
    form = form_of(path)
    with whole(path) as file:
        if form == ".parquet":
            write_parquet(recording, file)
        elif form == ".csv":
            write_csv(recording, file)
        else:
            # No file name and no time inside: the same recording gives the same bytes.
            with gzip.GzipFile("", "wb", 6, file, mtime=0) as packed:
                write_csv(recording, cast(BinaryIO, packed))


@contextmanager
def whole(path: Path) -> Iterator[BinaryIO]:
    """A file that is at ``path`` when the block ends, and nowhere when it fails; its directory is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            yield file
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def fast_path(path: Path) -> Path:
    """Where the 1 kHz samples go: ``run.csv.gz`` and ``run.fast.csv.gz`` (CONTRACT 1)."""
    form = form_of(path)
    return path.with_name(f"{path.name.removesuffix(form)}.fast{form}")
