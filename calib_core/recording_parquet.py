"""Recordings as Parquet: the same columns and names as the CSV, the header in the schema's metadata."""

import io
import json
from collections.abc import Mapping
from typing import BinaryIO

import numpy as np

from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.recording_check import check, check_names, is_known
from calib_core.recording_file import FORMAT, refuse_other_formats, rename

_HEADER_KEY = b"gyro-recording"


def read(raw: bytes, *, mapping: Mapping[str, str], max_bytes: int) -> Recording:
    """See ``recording.read``; columns that are neither numbers nor ``segment`` are left out unless they are known."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(io.BytesIO(raw))
        # A repeated value takes next to nothing in the file and eight bytes in memory.
        if 8 * file.metadata.num_rows * file.metadata.num_columns > max_bytes:
            raise Problem("recording.too_large", limit_MB=max_bytes / 1e6)
        table = file.read(use_threads=False)
    except (pa.ArrowException, OSError):
        raise Problem("recording.parquet_corrupt") from None
    header = _header(table.schema.metadata or {})
    names = rename(table.column_names, mapping)
    refuse_other_formats(header, names, "")
    check_names(names)
    numbers = {}
    codes, segments = np.zeros(len(table), np.int32), ("",)
    for name, column in zip(names, table.columns, strict=True):
        if name == "segment":
            try:
                text = column.cast(pa.string()).fill_null("").combine_chunks().dictionary_encode()
            except pa.ArrowException:
                raise Problem("recording.not_a_number", line=1, column=name, cell=str(column.type)) from None
            codes, segments = text.indices.to_numpy(), tuple(text.dictionary.to_pylist()) or ("",)
        elif pa.types.is_floating(column.type) or pa.types.is_integer(column.type) or pa.types.is_boolean(column.type):
            numbers[name] = column.cast(pa.float64(), safe=False).to_numpy() + 0.0
        elif is_known(name):
            raise Problem("recording.not_a_number", line=1, column=name, cell=str(column.type))
    return check(Recording(numbers.pop("time_s"), numbers, codes, segments, header))


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
