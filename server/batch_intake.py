"""Files of a batch on their way in: streamed to disk, counted and measured, unpacked with care.

Three things may not happen whatever is sent: a file anywhere but under its own number, more bytes on the disk than
the limits below, and one bad file harming the others.
"""

import hashlib
import stat
import zipfile
import zlib
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from calib_core.problem import Problem
from calib_core.recording import MAX_BYTES
from server.auth import MAX_BATCH_BYTES

MOST_FILES = 10_000
LARGEST_EXPANDED = 40_000_000_000
MOST_EXPANSION = 200
"""Bytes that a zip may hold for each of its own; recordings reach 5, and files that are made to fill a disk 1000."""
FREE_EXPANSION = 10_000_000
LONGEST_FIELD = 1 << 20
PIECE = 1 << 20
FIELDS = ("spec", "gyro_model", "name")
# What systems leave in archives without being asked.
LITTER = ("__MACOSX/", ".DS_Store", "Thumbs.db", "desktop.ini")


class Intake:
    """A request's body, piece by piece: ``feed`` each, then ``finish``. All of it raises Problem.

    ``files`` are {"name", "size", "error"} in order, the n-th at ``folder/n`` (six digits, from 1) unless it has an
    error; ``fields`` are the texts beside them; ``fingerprint`` says whether two requests ask for the same.
    """

    def __init__(self, folder: Path, content_type: str) -> None:
        from python_multipart.multipart import MultipartParser, parse_options_header

        kind, options = parse_options_header(content_type)
        if kind != b"multipart/form-data" or not options.get(b"boundary"):
            raise Problem("batch.not_multipart")
        self.files: list[dict[str, Any]] = []
        self.fields: dict[str, str] = {}
        self._folder = folder
        self._seen = hashlib.sha256()
        self._part: _Part | None = None
        self._archive: Path | None = None
        self._headers: dict[bytes, bytes] = {}
        self._header = [b"", b""]
        self._ended = False
        self._options = parse_options_header
        self._parser = MultipartParser(
            options[b"boundary"],
            {
                "on_part_begin": self._headers.clear,
                "on_header_field": lambda data, start, end: self._add_header(0, data[start:end]),
                "on_header_value": lambda data, start, end: self._add_header(1, data[start:end]),
                "on_header_end": self._end_header,
                "on_headers_finished": self._begin_part,
                "on_part_data": lambda data, start, end: self._add(memoryview(data)[start:end]),
                "on_part_end": self._end_part,
                "on_end": self._end,
            },
        )

    def feed(self, piece: bytes) -> None:
        from python_multipart.exceptions import FormParserError

        try:
            self._parser.write(piece)
        except FormParserError:
            raise Problem("batch.not_multipart") from None

    def finish(self) -> None:
        """After the last piece: unpacks the archive, if there is one."""
        if not self._ended:
            raise Problem("batch.not_multipart")
        if self._archive is not None:
            if self.files:
                raise Problem("batch.files_and_archive")
            self.files = unpack(self._archive, self._folder)
            self._archive.unlink()
        if not self.files:
            raise Problem("batch.no_files")
        for name in sorted(self.fields):
            self._seen.update(f"\n{name}={self.fields[name]}".encode())

    @property
    def fingerprint(self) -> str:
        return self._seen.hexdigest()

    def close(self) -> None:
        if self._part is not None:
            self._part.close()

    # --- what the parser calls -------------------------------------------------------------------------------------
    def _add_header(self, side: int, data: bytes) -> None:
        self._header[side] += data
        if len(self._header[side]) > 4096:
            raise Problem("batch.not_multipart")

    def _end_header(self) -> None:
        self._headers[self._header[0].lower()] = self._header[1]
        self._header = [b"", b""]

    def _begin_part(self) -> None:
        _, options = self._options(self._headers.get(b"content-disposition", b""))
        field = options.get(b"name", b"").decode(errors="replace")
        name = shown(options.get(b"filename", b"").decode(errors="replace"))
        self._seen.update(f"\n{field} {name}\n".encode())
        if field == "files":
            if len(self.files) == MOST_FILES:
                raise Problem("batch.too_many", limit=MOST_FILES)
            self.files.append({"name": name, "size": 0, "error": None})
            self._part = _Part(self._folder / f"{len(self.files):06d}", MAX_BYTES, self.files[-1])
        elif field == "archive":
            if self._archive is not None:
                raise Problem("batch.one_archive")
            self._archive = self._folder / "archive"
            self._part = _Part(self._archive, MAX_BATCH_BYTES, None)
        elif field in FIELDS:
            self._part = _Part(None, LONGEST_FIELD, None)
            self._part.field = field
        else:
            raise Problem("request.unknown_field", field=field[:80], given="")

    def _add(self, data: memoryview) -> None:
        assert self._part is not None
        self._part.add(data)

    def _end_part(self) -> None:
        assert self._part is not None
        part, self._part = self._part, None
        part.close()
        if part.field:
            self.fields[part.field] = part.text()
        else:
            self._seen.update(part.digest.digest())

    def _end(self) -> None:
        self._ended = True


class _Part:
    """One part of the body, on disk where ``path`` says; a file over its limit becomes its own error."""

    def __init__(self, path: Path | None, limit: int, file: dict[str, Any] | None) -> None:
        self._path, self._limit, self._told = path, limit, file
        self._out: IO[bytes] | None = path.open("xb") if path is not None else None
        self._kept = bytearray()
        self._size = 0
        self.field = ""
        self.digest = hashlib.sha256()

    def add(self, data: memoryview) -> None:
        self._size += len(data)
        self.digest.update(data)
        if self._told is not None:
            self._told["size"] = self._size
        if self._size > self._limit:
            self._refuse()
        elif self._out is None:
            self._kept += data
        else:
            self._out.write(data)

    def _refuse(self) -> None:
        if self._told is None:
            raise Problem("request.too_large")
        if self._told["error"] is None:
            self.close()
            assert self._path is not None
            self._path.unlink()
            self._told["error"] = too_large()

    def text(self) -> str:
        return self._kept.decode(errors="replace").strip()

    def close(self) -> None:
        if self._out is not None:
            self._out.close()


def too_large() -> dict[str, Any]:
    return {"code": "recording.too_large", "values": {"limit_MB": MAX_BYTES / 1e6}}


def shown(name: str) -> str:
    """A file's name as people read it: no folder of the sender's disk, nothing that is not printed."""
    return printable(name.replace("\\", "/").rsplit("/", 1)[-1]) or "recording"


def printable(text: str) -> str:
    return "".join(letter for letter in text if letter.isprintable())[:200]


# --- archives ------------------------------------------------------------------------------------------------------
def unpack(archive: Path, folder: Path) -> list[dict[str, Any]]:
    """The files of a zip as ``folder/000001`` and so on: {"name", "size", "error"} each.

    Raises Problem, before anything is unpacked where that can be known, for a member that names a place outside the
    archive, a link, a password, or more than the limits.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            members = [member for member in opened.infolist() if not _is_litter(member)]
            for member in members:
                _check(member)
            if len(members) > MOST_FILES:
                raise Problem("batch.too_many", limit=MOST_FILES)
            left = min(LARGEST_EXPANDED, MOST_EXPANSION * archive.stat().st_size + FREE_EXPANSION)
            if sum(member.file_size for member in members) > left:
                raise Problem("batch.expands", limit_MB=left / 1e6)
            files = []
            for n, member in enumerate(members, 1):
                files.append(_take(opened, member, folder / f"{n:06d}", left))
                left -= files[-1]["size"]
            return files
    except Problem:
        raise
    except (zipfile.BadZipFile, NotImplementedError, EOFError, ValueError) as error:
        raise Problem("batch.bad_archive", reason=str(error)[:200]) from None


def _is_litter(member: zipfile.ZipInfo) -> bool:
    name = member.filename
    return member.is_dir() or name.startswith(LITTER[0]) or name.rsplit("/", 1)[-1] in LITTER


def _check(member: zipfile.ZipInfo) -> None:
    # What the archive says, before zipfile cut it short.
    name = member.orig_filename.replace("\\", "/")
    if name.startswith("/") or ".." in name.split("/") or ":" in name.split("/")[0] or "\0" in name:
        raise Problem("batch.path_outside", member=printable(name))
    mode = member.external_attr >> 16
    if mode and not stat.S_ISREG(mode) and stat.S_IFMT(mode):
        raise Problem("batch.not_a_file", member=printable(name))
    if member.flag_bits & 0x1:
        raise Problem("batch.password", member=printable(name))


def _take(opened: zipfile.ZipFile, member: zipfile.ZipInfo, path: Path, left: int) -> dict[str, Any]:
    """One member to ``path``, counted as it comes: what its header says of its size may be a lie."""
    file: dict[str, Any] = {"name": shown(member.filename), "size": 0, "error": None}
    if member.file_size > MAX_BYTES:
        return {**file, "error": too_large()}
    try:
        with opened.open(member) as packed, path.open("xb") as out:
            while piece := packed.read(PIECE):
                file["size"] += len(piece)
                if file["size"] > left:
                    raise Problem("batch.expands", limit_MB=left / 1e6)
                out.write(piece)
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        with suppress(OSError):
            path.unlink()
        file["error"] = {"code": "batch.bad_member", "values": {"reason": str(error)[:200]}}
    return file
