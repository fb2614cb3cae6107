"""Packed samples: small, without loss, and refused when damaged."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from recordings import csv_bytes, csv_lines

from calib_core.packing import pack, pack_recording, unpack, unpack_recording
from calib_core.problem import Problem
from calib_core.recording import Recording, read

NUMBERS = st.one_of(st.floats(allow_infinity=True, allow_nan=True), st.integers(-(10**9), 10**9).map(lambda k: k / 1e6))


@settings(max_examples=200, deadline=None)
@example([1.7e308, float("inf"), -0.5], 1e-6)
@given(st.lists(NUMBERS, max_size=60), st.sampled_from([1e-6, 1e-4, 1e-3, 1.0, 0.25, 0.3]))
def test_packing_loses_nothing(values: list[float], resolution: float) -> None:
    array = np.array(values, float)
    np.testing.assert_array_equal(unpack(pack(array, resolution)), array)


@pytest.mark.parametrize("widest", [100, 30_000, 10**6, 2**51])
def test_differences_of_every_size_fit(widest: int) -> None:
    steps = np.random.default_rng(3).integers(-widest, widest, 500)
    steps[3], steps[4] = -widest, widest
    array = steps / 1e3
    np.testing.assert_array_equal(unpack(pack(array, 1e-3)), array)


def test_numbers_on_the_grid_are_small_and_others_are_not() -> None:
    rng = np.random.default_rng(5)
    volts = np.round(1.25 + 0.0012 * rng.standard_normal(20_000), 6)
    assert len(pack(volts, 1e-6)) < 2 * len(volts)
    assert len(pack(volts + 1e-9, 1e-6)) > 4 * len(volts)
    np.testing.assert_array_equal(unpack(pack(volts + 1e-9, 1e-6)), volts + 1e-9)


def test_missing_samples_cost_next_to_nothing() -> None:
    sparse = np.full(20_000, np.nan)
    sparse[::1000] = 1.0
    assert len(pack(sparse, 1e-4)) < 500
    assert len(pack(np.full(20_000, np.nan), 1e-4)) < 200


def test_segments_are_kept_as_run_lengths() -> None:
    n = 20_000
    codes = (np.arange(n) // 5000).astype(np.int32)
    names = ("hold", "rate_x/linearity/+60/1", "หมุน", "")
    recording = Recording(np.arange(n) / 100, {"x_gyro_v": np.ones(n)}, codes, names, {"board": "B", "note": "ก"})
    blob = pack_recording(recording)
    assert len(blob) < 1000
    back = unpack_recording(blob)
    assert back.digest() == recording.digest()
    assert (back.segment_names, back.header) == (names, recording.header)


def test_no_rows_can_be_packed_too() -> None:
    empty = read(csv_bytes(csv_lines())).take(slice(0, 0))
    assert len(unpack_recording(pack_recording(empty))) == 0


@pytest.mark.parametrize("cut", [0, 3, 20, 200, -1])
def test_a_damaged_blob_is_refused(cut: int) -> None:
    blob = pack_recording(read(csv_bytes(csv_lines())))
    for data in (blob[:cut], b"JUNK" + blob[4:], blob[: len(blob) // 2] + b"\0" * (len(blob) - len(blob) // 2)):
        with pytest.raises(Problem) as refused:
            unpack_recording(data)
        assert refused.value.code == "recording.blob_corrupt"
