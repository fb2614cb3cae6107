"""What a Recording is: columns, readings of the encoder, segments, digest, pieces put together."""

import numpy as np
import pytest
from recordings import csv_bytes, csv_lines

from calib_core.problem import Problem
from calib_core.recording import Recording, Segment, format_segment, parse_segment, read


def table(**columns: list[float]) -> Recording:
    time_s = np.array(columns.pop("time_s", [0.0, 1.0, 2.0]))
    arrays = {name: np.array(values, float) for name, values in columns.items()}
    return Recording(time_s, arrays, np.zeros(len(time_s), np.int32), ("",))


def test_a_recording_knows_its_axes_and_their_units() -> None:
    r = table(z_gyro_counts=[1, 2, 3], x_gyro_v=[1, 2, 3])
    assert r.axes == ("x", "z")
    assert (r.gyro("x").unit, r.gyro("z").unit) == ("V", "counts")
    with pytest.raises(Problem) as refused:
        r.gyro("y")
    assert (refused.value.code, refused.value.values) == ("recording.no_gyro_axis", {"axis": "y", "axes": "x, z"})


def test_rows_that_are_not_valid_take_part_in_nothing() -> None:
    r = table(x_gyro_dps=[1, 2, 3], x_position_deg=[4, 5, 6], x_rate_dps=[7, 8, 9], valid=[1, 0, 1])
    assert r.valid.tolist() == [True, False, True]
    np.testing.assert_array_equal(r.gyro("x").values, [1, np.nan, 3])
    assert [part.tolist() for part in r.position("x")] == [[0, 2], [4, 6]]
    np.testing.assert_array_equal(r.reference_rate("x"), [7, np.nan, 9])


def test_encoder_readings_come_at_their_own_time_and_only_once() -> None:
    nan = np.nan
    r = table(x_gyro_v=[1, 1, 1], x_position_deg=[5, nan, 7], x_position_time_s=[0.004, nan, nan])
    assert [part.tolist() for part in r.position("x")] == [[0.004, 2.0], [5, 7]]
    assert [len(part) for part in r.position("z")] == [0, 0]


def test_a_channel_that_is_sampled_later_says_so() -> None:
    lines = csv_lines()
    delayed = read(csv_bytes([lines[0], "# x_gyro_delay_s: 0.0001", *lines[1:]]))
    assert delayed.gyro("x").delay_s == 1e-4
    assert read(csv_bytes(lines)).gyro("x").delay_s == 0


def test_a_stationary_record_has_zero_as_its_reference() -> None:
    lines = csv_lines()
    still = read(csv_bytes([lines[0], "# reference: stationary", *lines[1:]]))
    assert still.stationary
    assert not still.reference_rate("x").any()
    assert read(csv_bytes(lines)).reference_rate("x") is None


@pytest.mark.parametrize(
    ("name", "segment"),
    [
        ("rate_x/linearity/+60/2", Segment("rate", "x", "linearity", 60.0, 2)),
        ("rate_x/repeat/-100/17", Segment("rate", "x", "repeat", -100.0, 17)),
        ("position_z/repeat/+30/22", Segment("position", "z", "repeat", 30.0, 22)),
        ("position_x/linearity/-12.5/1", Segment("position", "x", "linearity", -12.5, 1)),
        ("rate_x/linearity/+1000000/1", Segment("rate", "x", "linearity", 1e6, 1)),
    ],
)
def test_a_name_with_slashes_is_a_test_reading(name: str, segment: Segment) -> None:
    assert parse_segment(name) == segment
    assert format_segment(segment) == name


@pytest.mark.parametrize(
    "name",
    ["", "rate_x:+60", "estimate_x", "step_x", "experiment/7/hold", "rate_x/linearity/1e2/1", "rate_x/other/+1/1"],
)
def test_every_other_name_is_free_text(name: str) -> None:
    assert parse_segment(name) is None


def test_runs_are_the_stretches_of_one_segment() -> None:
    codes = np.array([0, 0, 1, 0, 0], np.int32)
    r = Recording(np.arange(5.0), {"x_gyro_v": np.arange(5.0)}, codes, ("hold", "move"))
    assert [(run.name, run.start, run.stop) for run in r.runs()] == [("hold", 0, 2), ("move", 2, 3), ("hold", 3, 5)]
    assert r.where(lambda name: name == "hold").tolist() == [True, True, False, True, True]
    held = r.take(r.where(lambda name: name == "hold"))
    assert held.columns["x_gyro_v"].tolist() == [0, 1, 3, 4]
    assert [run.rows for run in held.runs()] == [slice(0, 4)]
    assert r.take(slice(0, 0)).runs() == []


def test_the_digest_is_of_the_content_alone() -> None:
    r = table(x_gyro_v=[1, np.nan, 3], x_position_deg=[4, 5, 6])
    other_order = table(x_position_deg=[4, 5, 6], x_gyro_v=[1, np.nan, 3])
    assert r.digest() == other_order.digest()
    headed = Recording(r.time_s, r.columns, r.segment_codes, ("", "never used"), {"operator": "N"})
    assert headed.digest() == r.digest()
    for changed in (
        table(x_gyro_v=[1, np.nan, 3.000000001], x_position_deg=[4, 5, 6]),
        table(x_gyro_v=[1, 0, 3], x_position_deg=[4, 5, 6]),
        table(x_gyro_v=[1, np.nan, 3], z_position_deg=[4, 5, 6]),
        Recording(r.time_s, r.columns, np.array([0, 0, 1], np.int32), ("", "move")),
        r.take(slice(0, 2)),
    ):
        assert changed.digest() != r.digest()


def test_parts_are_joined_in_the_order_of_time() -> None:
    late = Recording(np.array([2.0, 3.0]), {"x_gyro_v": np.array([3.0, 4.0])}, np.zeros(2, np.int32), ("hold",))
    early = Recording(
        np.array([0.0, 1.0]),
        {"x_gyro_v": np.array([1.0, 2.0]), "valid": np.array([1.0, 0.0])},
        np.array([1, 0], np.int32),
        ("hold", "move"),
        {"board": "B"},
    )
    whole = Recording.join([late, early])
    assert whole.columns["x_gyro_v"].tolist() == [1, 2, 3, 4]
    assert whole.valid.tolist() == [True, False, True, True]
    assert [run.name for run in whole.runs()] == ["move", "hold"]
    assert whole.header == {"board": "B"}
    with pytest.raises(Problem) as refused:
        Recording.join([early, early])
    assert refused.value.code == "recording.time_not_increasing"
