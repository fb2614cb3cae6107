"""Recordings as Parquet: the same columns and names as the CSV, the header in the schema's metadata."""

import io
import json
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np

from calib_core.problem import Problem
from calib_core.recording import I32, Recording
from calib_core.recording_check import check, check_names, is_known
from calib_core.recording_file import FORMAT, refuse_other_formats, rename, with_left_out

_HEADER_KEY = b"gyro-recording"


def read(raw: bytes, *, mapping: Mapping[str, str], max_bytes: int) -> Recording:
    """See ``recording.read``; columns that are neither numbers nor ``segment`` are left out unless they are known."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    # One value, repeated, takes next to nothing in the file: numbers are counted first, texts stay in their dictionary.
    try:
        about = pq.ParquetFile(io.BytesIO(raw))
        cells = about.metadata.num_rows * about.metadata.num_columns
        texts = [field.name for field in about.schema_arrow if pa.types.is_string(field.type)]
        file = pq.ParquetFile(io.BytesIO(raw), read_dictionary=texts)
        table = file.read(use_threads=False) if 8 * cells <= max_bytes else None
    except (pa.ArrowException, OSError, ValueError):
        raise Problem("recording.parquet_corrupt") from None
    if table is None:
        raise Problem("recording.too_large", limit_MB=max_bytes / 1e6)
    header: Mapping[str, str] = _header(table.schema.metadata or {})
    names = rename(table.column_names, mapping)
    refuse_other_formats(header, names)
    check_names(names)
    numbers = {}
    codes: I32 = np.zeros(len(table), np.int32)
    segments: tuple[str, ...] = ("",)
    for name, column in zip(names, table.columns, strict=True):
        if name == "segment":
            codes, segments = _segments(column)
        elif pa.types.is_floating(column.type) or pa.types.is_integer(column.type) or pa.types.is_boolean(column.type):
            numbers[name] = column.cast(pa.float64(), safe=False).to_numpy() + 0.0
        elif is_known(name):
            raise Problem("recording.not_a_number", line=1, column=name, cell=str(column.type))
    header = with_left_out(header, [name for name in names if name not in numbers and name != "segment"])
    return check(Recording(numbers.pop("time_s"), numbers, codes, segments, header))


def _segments(column: Any) -> tuple[I32, tuple[str, ...]]:
    """Codes (n,) and names of a chunked column of text; an empty cell is the name ""."""
    import pyarrow as pa

    try:
        column = column.cast(pa.dictionary(pa.int32(), pa.string())).unify_dictionaries().combine_chunks()
    except pa.ArrowException:
        raise Problem("recording.segment_not_text", column="segment", type=str(column.type)) from None
    names = tuple(column.dictionary.to_pylist())
    if column.null_count == 0:
        return column.indices.to_numpy(), names or ("",)
    return column.indices.fill_null(len(names)).to_numpy(), (*names, "")


def _header(metadata: Mapping[bytes, bytes]) -> dict[str, str]:
    try:
        entries = json.loads(metadata.get(_HEADER_KEY, b"{}"))
    except ValueError:
        return {}
    return {str(key): str(value) for key, value in entries.items()} if isinstance(entries, dict) else {}


def write(recording: Recording, file: BinaryIO) -> None:
    """See ``recording.write_parquet``."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {
        name: pa.array(values, from_pandas=True)
        for name, values in [("time_s", recording.time_s), *recording.columns.items()]
    }
    if recording.where(bool).any():
        columns["segment"] = pa.DictionaryArray.from_arrays(
            pa.array(recording.segment_codes, pa.int32()), pa.array(recording.segment_names, pa.string())
        )
    header = {"format": FORMAT, **recording.header}
    metadata = {_HEADER_KEY: json.dumps(header, ensure_ascii=False)}
    sink = io.BytesIO()
    pq.write_table(pa.table(columns, metadata=metadata), sink, compression="zstd")
    file.write(sink.getvalue())
