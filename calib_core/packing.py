"""Samples as compact blobs: differences of whole steps, bytes of equal weight together, zlib (METHOD 6).

A column on a decimal grid is kept as integers and read back as ``integer / steps per unit``, the double nearest to the
decimal number, which is also what its CSV cell reads as. A column off its grid is kept as it is: always lossless.
"""

import json
import struct
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from calib_core.problem import Problem
from calib_core.recording import F64, Recording

_COLUMN = struct.Struct(
    "<BxxxIIdq"
)  # bytes a difference (0: plain doubles), samples, mask bytes, steps per unit, first
_MAGIC = b"GYR1"
_BLOB = struct.Struct("<4sII")  # magic, samples, bytes of JSON

_RESOLUTION = {"deg": 1e-4, "temperature_c": 1e-3, "supply_v": 1e-4, "counts": 1.0, "valid": 1.0}
_FINE = 1e-6


def resolution(column: str) -> float:
    """The step on which the instrument writes ``column``; 1e-6 for times, volts and whatever is not listed."""
    return _RESOLUTION.get(column, _RESOLUTION.get(column.rpartition("_")[2], _FINE))


def pack(values: F64, resolution: float) -> bytes:
    """``values`` (n,), NaN allowed, as bytes; small where they are multiples of ``resolution``, lossless anyway."""
    there = ~np.isnan(values)
    mask = b"" if there.all() else _squeeze(np.packbits(there).tobytes())
    real = values[there] if mask else values
    scale = 1.0 / resolution
    scale = float(round(scale)) if abs(scale - round(scale)) < 1e-6 * scale else scale
    with np.errstate(over="ignore"):  # infinite steps are off every grid
        steps = np.rint(real * scale)
    if not len(real) or np.abs(steps).max() >= 2**53 or not np.array_equal(steps / scale, real):
        return _COLUMN.pack(0, len(values), len(mask), scale, 0) + mask + _squeeze(_planes(real.astype("<f8")))
    whole = steps.astype(np.int64)
    change = np.diff(whole)
    # Small changes of either sign become small unsigned numbers: their high bytes are all zero.
    change = (change << 1) ^ (change >> 63)
    top = int(change.max(initial=0))
    width = next(width for width in (1, 2, 4, 8) if top < 1 << (8 * width))
    first = int(whole[0])
    body = _squeeze(_planes(change.astype(f"<u{width}")))
    return _COLUMN.pack(width, len(values), len(mask), scale, first) + mask + body


def unpack(blob: bytes) -> F64:
    """The inverse of ``pack``: (n,) float64; raises Problem ``recording.blob_corrupt``."""
    try:
        width, samples, mask_bytes, scale, first = _COLUMN.unpack_from(blob)
        mask = blob[_COLUMN.size : _COLUMN.size + mask_bytes]
        body = zlib.decompress(blob[_COLUMN.size + mask_bytes :])
        there = np.unpackbits(np.frombuffer(zlib.decompress(mask), np.uint8), count=samples) == 1 if mask else None
        if width == 0:
            real = _together(body, "<f8")
        else:
            change = _together(body, f"<u{width}").astype(np.int64 if width < 8 else np.uint64).view(np.int64)
            change = ((change >> 1) & np.int64(2**63 - 1)) ^ -(change & 1)
            whole = np.empty(len(change) + 1, np.int64)
            whole[0], whole[1:] = first, change
            real = np.cumsum(whole) / scale
        if there is None:
            if len(real) != samples:
                raise ValueError
            return real
        values = np.full(samples, np.nan)
        values[there] = real
    except (ValueError, struct.error, zlib.error):
        raise Problem("recording.blob_corrupt") from None
    return values


def pack_recording(recording: Recording) -> bytes:
    """The whole recording, header included, as one blob: columns at their resolution, segments as run lengths."""
    runs = recording.runs()
    columns = {"time_s": recording.time_s, **recording.columns}
    blobs = [pack(values, resolution(name)) for name, values in columns.items()]
    about = {
        "columns": [[name, len(blob)] for name, blob in zip(columns, blobs, strict=True)],
        "runs": [[run.name, run.stop - run.start] for run in runs],
        "header": dict(recording.header),
    }
    head = zlib.compress(json.dumps(about, ensure_ascii=False, separators=(",", ":")).encode())
    return b"".join([_BLOB.pack(_MAGIC, len(recording), len(head)), head, *blobs])


def unpack_recording(blob: bytes) -> Recording:
    """The inverse of ``pack_recording``; raises Problem ``recording.blob_corrupt``."""
    try:
        magic, samples, size = _BLOB.unpack_from(blob)
        if magic != _MAGIC:
            raise ValueError
        about = json.loads(zlib.decompress(blob[_BLOB.size : _BLOB.size + size]))
        at = _BLOB.size + size
        columns: dict[str, F64] = {}
        for name, length in about["columns"]:
            columns[name] = unpack(blob[at : at + length])
            at += length
        names: dict[str, int] = {}
        codes = [names.setdefault(name, len(names)) for name, _ in about["runs"]]
        rows = np.repeat(np.array(codes, np.int32), [length for _, length in about["runs"]])
        if {rows.size, *(values.size for values in columns.values())} != {samples}:
            raise ValueError
        return Recording(columns.pop("time_s"), columns, rows, tuple(names) or ("",), about["header"])
    except (ValueError, KeyError, TypeError, struct.error, zlib.error):
        raise Problem("recording.blob_corrupt") from None


def _planes(values: npt.NDArray[Any]) -> bytes:
    """All first bytes, then all second bytes, …: bytes of one weight resemble one another."""
    return np.ascontiguousarray(values.view(np.uint8).reshape(-1, values.itemsize).T).tobytes()


def _together(planes: bytes, dtype: str) -> npt.NDArray[Any]:
    width = np.dtype(dtype).itemsize
    return np.ascontiguousarray(np.frombuffer(planes, np.uint8).reshape(width, -1).T).view(dtype).ravel()


def _squeeze(data: bytes) -> bytes:
    """Run lengths and Huffman codes: noise has no repeats worth a search, which would take most of the time."""
    packer = zlib.compressobj(1, strategy=zlib.Z_RLE)
    return packer.compress(data) + packer.flush()
