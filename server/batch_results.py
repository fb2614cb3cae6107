"""What a batch came to, as files: one table of all boards, and a zip with every document."""

import csv
import io
import zipfile
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping
from typing import Any

from calib_core.certificate import FIELDS
from server.documents.csv_table import FORMULA
from server.store import Store
from server.texts import render

PAGE = 200
AT_ONCE = 8
"""Certificates whose documents are made in one go: half a second of work."""


def rows(store: Store, batch: str) -> Iterator[dict[str, Any]]:
    """All files of a batch, in the order in which they were sent."""
    found: list[dict[str, Any]] = []
    cursor: str | None = "0"
    while cursor is not None:
        page, cursor = store.batches.files(batch, limit=PAGE, cursor=cursor)
        found += page
    yield from sorted(found, key=lambda row: row["position"])


def table(files: Iterable[Mapping[str, Any]], lang: str) -> bytes:
    """One line a file: what became of it, and every certified number of each axis (bare, in FIELDS' own units)."""
    text = io.StringIO(newline="")
    columns = [(axis, field) for axis in ("x", "z") for field in FIELDS]
    names = ["position", "file", "status", "board", "certificate", "verdict", "reason"]
    sheet = csv.writer(text, lineterminator="\r\n")
    sheet.writerow(names + [".".join([axis, *field.path]) for axis, field in columns])
    for file in files:
        said = [file["position"], file["name"], file["status"], file["board"], file["certificate"], file["verdict"]]
        axes = file["axes"] or {}
        numbers = [field.of(axes.get(axis, {})) for axis, field in columns]
        sheet.writerow([*map(_text, [*said, reason(file, lang)]), *("" if n is None else n for n in numbers)])
    return text.getvalue().encode("utf-8-sig")


def reason(file: Mapping[str, Any], lang: str) -> str:
    """Why a file has no certificate, as a sentence; empty where it has one."""
    error = file["error"]
    return "" if error is None else render(f"error.{error['code']}", {**error["values"], "file": file["name"]}, lang)


async def archive(
    files: list[dict[str, Any]], lang: str, documents: Any
) -> AsyncIterator[bytes]:  # documents(numbers) -> [(name, bytes)], awaited
    """A zip as it grows: ``results.csv``, then the documents of each certificate."""
    piece = _Piece()
    with zipfile.ZipFile(piece, "w") as packed:
        packed.writestr("results.csv", table(files, lang), zipfile.ZIP_DEFLATED)
        numbers = list(dict.fromkeys(file["certificate"] for file in files if file["certificate"]))
        for start in range(0, len(numbers), AT_ONCE):
            for name, content in await documents(numbers[start : start + AT_ONCE]):
                kind = zipfile.ZIP_STORED if name.endswith(".pdf") else zipfile.ZIP_DEFLATED
                packed.writestr(name, content, kind, 1)
                yield piece.taken()
    yield piece.taken()


class _Piece(io.RawIOBase):
    """What zipfile has written since it was last taken."""

    def __init__(self) -> None:
        self._written = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._written += data
        return len(data)

    def taken(self) -> bytes:
        taken, self._written = bytes(self._written), bytearray()
        return taken


def _text(value: object) -> object:
    return f"'{value}" if isinstance(value, str) and value.startswith(FORMULA) else "" if value is None else value
