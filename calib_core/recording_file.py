"""Recordings from and to bytes: CSV and gzipped CSV here, Parquet next door.

pyarrow reads the good file fast; whatever it refuses is read again row by row in Python, which is slow, forgiving
about spaces, and knows the line of the first thing that is wrong.
"""

import csv
import gzip
import io
import re
import zlib
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import BinaryIO

import numpy as np

from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.recording_check import check, check_names, is_known, listed

FORMAT = "gyro-recording 1"
_LINE = re.compile(rb"[^\r\n]*(?:\r\n|\r|\n)?")
_BLOCK_BYTES = 1 << 19


@dataclass(frozen=True)
class TextTable:
    """A CSV text taken apart: ``# key: value`` lines, column names, and where the rows begin."""

    header: dict[str, str]
    names: list[str]
    raw: bytes
    start: int  # of the rows in raw
    line: int  # of the first row, from 1


def read_any(data: bytes | BinaryIO, *, mapping: Mapping[str, str], max_bytes: int) -> Recording:
    """See ``recording.read``."""
    raw = load(data, max_bytes)
    if raw[:4] == b"PAR1":
        from calib_core import recording_parquet

        return recording_parquet.read(raw, mapping=mapping, max_bytes=max_bytes)
    table = split(raw)
    names = rename(table.names, mapping)
    refuse_other_formats(table.header, names)
    check_names(names, table.line - 1)
    recording = _fast(table, names) or _slow(table, names)
    try:
        _refuse_cut_off(table, recording)
        return check(recording)
    except Problem as problem:
        if "line" not in problem.values:
            raise
        row = int(str(problem.values["line"])) - 1
        line = next(islice(rows(table), row, None))[0]
        raise Problem(problem.code, **{**problem.values, "line": line}) from None


def load(data: bytes | BinaryIO, max_bytes: int) -> bytes:
    """All of ``data``, unpacked if it is gzip; raises Problem when it is empty, too large, truncated or corrupt."""
    raw = data if isinstance(data, bytes) else data.read(max_bytes + 1)
    if raw[:2] == b"\x1f\x8b" and len(raw) <= max_bytes:
        raw = _gunzip(raw, max_bytes)
    if len(raw) > max_bytes:
        raise Problem("recording.too_large", limit_MB=max_bytes / 1e6)
    if not raw:
        raise Problem("recording.empty_file")
    return raw


def _gunzip(packed: bytes, max_bytes: int) -> bytes:
    """At most ``max_bytes`` + 1 bytes, so that a small file cannot fill the memory."""
    try:
        return gzip.GzipFile(fileobj=io.BytesIO(packed)).read(max_bytes + 1)
    except EOFError:
        raise Problem("recording.gzip_truncated") from None
    except (OSError, zlib.error):
        raise Problem("recording.gzip_corrupt") from None


def split(raw: bytes) -> TextTable:
    """Header, names and body of a CSV text; raises Problem when it is not text or has no line of names."""
    if raw[:4] in (b"PK\x03\x04", b"\xd0\xcf\x11\xe0") or raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise Problem("recording.not_text", line=1)
    at = 3 if raw[:3] == b"\xef\xbb\xbf" else 0
    header: dict[str, str] = {}
    line = 0
    while at < len(raw):
        found = _LINE.match(raw, at)
        assert found is not None
        at, line = found.end(), line + 1
        text = _text(found.group(), line).strip()
        if text.startswith(("#", '"#')):
            _add_header(header, text, line)
        elif text.strip(", \t"):
            if "," not in text and (";" in text or "\t" in text):
                raise Problem("recording.not_commas", line=line, separator=";" if ";" in text else "TAB")
            return TextTable(header, [cell.strip() for cell in _cells(text, line)], raw, at, line + 1)
    raise Problem("recording.no_rows")


def _text(data: bytes, line: int) -> str:
    try:
        text = data.decode()
    except UnicodeDecodeError:
        raise Problem("recording.not_text", line=line) from None
    if "\0" in text:
        raise Problem("recording.not_text", line=line)
    return text


def _cells(text: str, line: int) -> list[str]:
    try:
        return next(csv.reader([text]))
    except csv.Error:
        raise Problem("recording.broken_row", line=line) from None


def _add_header(header: dict[str, str], text: str, line: int) -> None:
    """``# key: value``; a spreadsheet quotes such a line and fills it up with commas. Repeated keys are joined."""
    text = _cells(text, line)[0] if text.startswith('"') else text.rstrip(",")
    key, colon, value = (part.strip() for part in text.lstrip("#").partition(":"))
    if not colon:
        key, value = "comment", key
    if value or (colon and key):
        header[key] = f"{header[key]}; {value}" if key in header else value


def rename(names: Sequence[str], mapping: Mapping[str, str]) -> list[str]:
    """The columns under our names; raises Problem where the mapping names a column that is not there."""
    for foreign in mapping:
        if foreign not in names:
            raise Problem("recording.no_such_column", column=foreign, columns=listed(names))
    return [mapping.get(name, name) for name in names]


def refuse_other_formats(header: Mapping[str, str], names: Sequence[str]) -> None:
    """Refuse what says, or looks as if, it is something else than ``gyro-recording 1``."""
    kind = header.get("format", FORMAT)
    if kind.startswith("gyro-points") or ("time_s" not in names and "set_point" in names):
        raise Problem("recording.is_points")
    if kind != FORMAT:
        raise Problem("recording.unknown_format", format=kind[:40], known=FORMAT)


def _fast(table: TextTable, names: Sequence[str]) -> Recording | None:
    """The recording by pyarrow, on one thread; None where it refuses a cell or a row."""
    import pyarrow as pa
    import pyarrow.csv as pa_csv

    types = {name: pa.float64() for name in names}
    if "segment" in types:
        types["segment"] = pa.dictionary(pa.int32(), pa.string())
    try:
        columns = pa_csv.read_csv(
            pa.BufferReader(pa.py_buffer(table.raw).slice(table.start)),
            read_options=pa_csv.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES, column_names=list(names)),
            # Looking for quotation marks takes a tenth of the time, so it is done once, over the whole text.
            parse_options=pa_csv.ParseOptions(quote_char='"' if b'"' in table.raw else False),
            convert_options=pa_csv.ConvertOptions(
                column_types=types, null_values=["", "nan", "NaN"], strings_can_be_null=False
            ),
        )
    except pa.ArrowInvalid:
        return None
    # Adding zero turns -0.0 into 0.0: one number, one spelling, one digest.
    numbers = {name: columns.column(name).to_numpy() + 0.0 for name in names if name != "segment"}
    codes, segments = np.zeros(len(columns), np.int32), ("",)
    if "segment" in types:
        chunks = columns.column("segment").unify_dictionaries().chunks
        codes = np.concatenate([chunk.indices.to_numpy(zero_copy_only=False) for chunk in chunks])
        segments = tuple(chunks[0].dictionary.to_pylist())
    return Recording(numbers.pop("time_s"), numbers, codes, segments, table.header)


def rows(table: TextTable) -> Iterator[tuple[int, list[str]]]:
    """Each row that is not blank with the line it begins on; raises Problem where the text breaks off."""
    reader = csv.reader(
        _text(piece.group(), i) for i, piece in enumerate(_LINE.finditer(table.raw, table.start), table.line)
    )
    while True:
        line = table.line + reader.line_num
        try:
            cells = next(reader)
        except StopIteration:
            return
        except csv.Error:
            raise Problem("recording.broken_row", line=line) from None
        if not any(cell.strip() for cell in cells) and len(cells) < 2:
            continue
        if len(cells) != len(table.names):
            raise Problem("recording.cells", line=line, cells=len(cells), needed=len(table.names))
        yield line, cells


def _slow(table: TextTable, names: Sequence[str]) -> Recording:
    """The recording row by row; raises Problem at the first bad cell.

    A foreign column of text that nobody asked for is left out, and the header says so.
    """
    numbers = {name: array("d") for name in names}
    segments: dict[str, int] = {}
    codes = array("i")
    for line, cells in rows(table):
        for name, cell in zip(names, cells, strict=True):
            if name == "segment":
                codes.append(segments.setdefault(cell, len(segments)))
            elif name in numbers:
                value = number(cell)
                if value is not None:
                    numbers[name].append(value)
                elif is_known(name):
                    raise Problem("recording.not_a_number", line=line, column=name, cell=cell[:40])
                else:
                    del numbers[name]
    header = with_left_out(table.header, [name for name in names if name not in numbers])
    numbers.pop("segment", None)
    columns = {name: np.frombuffer(values, np.float64) + 0.0 for name, values in numbers.items()}
    time_s = columns.pop("time_s")
    return Recording(
        time_s,
        columns,
        np.array(codes if codes else np.zeros(len(time_s)), np.int32),
        tuple(segments) or ("",),
        header,
    )


def with_left_out(header: Mapping[str, str], names: Sequence[str]) -> Mapping[str, str]:
    """The header with a line that names the columns left out, if there are any."""
    return {**header, "left_out": listed(names)} if names else header


def _refuse_cut_off(table: TextTable, recording: Recording) -> None:
    """A last row without its line's end, whose segment is the beginning of the one before, is half a row."""
    if table.raw.endswith((b"\n", b"\r")) or len(recording) < 2:
        return
    before, last = (recording.segment_names[code] for code in recording.segment_codes[-2:])
    if last != before and before.startswith(last):
        raise Problem("recording.cut_off", line=len(recording), column="segment")


def number(cell: str) -> float | None:
    """The cell's number, NaN for an empty one, None for text."""
    cell = cell.strip()
    if not cell:
        return np.nan
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None


def write(recording: Recording, file: BinaryIO) -> None:
    """See ``recording.write_csv``."""
    import pyarrow as pa
    import pyarrow.csv as pa_csv

    names = ["time_s", *recording.columns]
    columns = [pa.array(values, from_pandas=True) for values in (recording.time_s, *recording.columns.values())]
    quoting = "none"
    used = {run.name for run in recording.runs()}
    if used - {""}:
        names.append("segment")
        columns.append(pa.array(recording.segment_names, pa.string()).take(pa.array(recording.segment_codes)))
        if any(set(',"') & set(name) for name in used):
            quoting = "needed"
    file.write(header_lines(FORMAT, recording.header))
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerow(names)
    file.write(text.getvalue().encode())
    sink = pa.BufferOutputStream()
    options = pa_csv.WriteOptions(include_header=False, quoting_style=quoting)
    pa_csv.write_csv(pa.Table.from_arrays(columns, names), sink, options)
    file.write(sink.getvalue())


def header_lines(kind: str, header: Mapping[str, str]) -> bytes:
    """``# key: value`` lines, the format first; control characters, which would break a line, become spaces."""
    entries = {"format": kind, **{key: value for key, value in header.items() if key != "format"}}
    lines = [re.sub(r"[\x00-\x1f\x7f]+", " ", f"# {key}: {value}") for key, value in entries.items()]
    return "".join(line.rstrip() + "\n" for line in lines).encode()
