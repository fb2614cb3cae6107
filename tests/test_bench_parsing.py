"""Parsing and packing keep to their limits, measured side by side."""

from calib_core.packing import pack_recording, unpack_recording
from server.bench import parsing


def test_parsing_and_packing_are_as_fast_and_as_small_as_promised() -> None:
    rows = parsing.run(quick=True)
    assert [row.name for row in rows if row.limit is not None and not row.ok] == []


def test_the_benchmark_packs_without_loss() -> None:
    recording = parsing.session(5_000)
    assert unpack_recording(pack_recording(recording)).digest() == recording.digest()
