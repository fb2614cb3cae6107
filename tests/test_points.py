"""``gyro-points 1``: single readings in and out."""

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib_core import points
from calib_core.points import COLUMNS, Points
from calib_core.problem import Problem
from server.texts import LANGUAGES, sentence

BOTH_AXES = """# format: gyro-points 1
board,axis,test,set_point,x_rate_dps,x_gyro_dps,z_rate_dps,z_gyro_dps,reading,duration_s
1,x,linearity,10,11.073,11.9685,,,1,1.8
2,z,repeat,-20,,,-20.5279,-21.25,7,
"""


def written(table: Points) -> bytes:
    file = io.BytesIO()
    points.write(table, file)
    return file.getvalue()


def test_readings_of_several_boards_and_axes_share_a_table() -> None:
    table = points.read(BOTH_AXES.encode())
    assert (len(table), table.kind) == (2, "rate")
    assert table.board.tolist() == ["1", "2"]
    assert table.axis.tolist() == ["x", "z"]
    assert table.test.tolist() == ["linearity", "repeat"]
    assert table.reference.tolist() == [11.073, -20.5279]
    assert table.gyro.tolist() == [11.9685, -21.25]
    assert table.reading.tolist() == [1, 7]
    np.testing.assert_array_equal(table.duration_s, [1.8, np.nan])
    assert written(table).decode() == BOTH_AXES
    assert table.take(table.axis == "z").set_point.tolist() == [-20]


def test_one_axis_needs_no_axis_column_and_readings_can_be_counted() -> None:
    text = b"# board: LPY-1\nset_point,z_position_deg,z_gyro_deg\n30,29.6,31.9\n30,29.6,32.6\n60,59.1,60\n"
    table = points.read(text)
    assert (table.kind, table.axis.tolist(), table.board.tolist()) == ("position", ["z"] * 3, ["LPY-1"] * 3)
    assert table.reading.tolist() == [1, 2, 1]
    assert points.read(text.replace(b"z_gyro_deg", b"turn"), mapping={"turn": "z_gyro_deg"}).gyro[1] == 32.6


NAMES = "set_point,x_rate_dps,x_gyro_dps,axis"
BAD = {
    "a recording": ("time_s,x_gyro_dps\n0,1", "points.is_recording", 1, None),
    "another format": ("# format: gyro-points 2\n" + NAMES, "recording.unknown_format", None, None),
    "no set-point": ("x_rate_dps,x_gyro_dps\n1,2", "points.no_set_point", 1, None),
    "no gyro": ("set_point,x_rate_dps\n1,2", "points.no_pair", 1, None),
    "rates and angles": (NAMES + ",x_position_deg,x_gyro_deg\n1,2,3,x,4,5", "points.two_kinds", 1, None),
    "a column twice": (NAMES + ",axis\n1,2,3,x,x", "recording.duplicate_column", 1, "axis"),
    "another axis": (NAMES + "\n1,2,3,x\n1,2,3,z", "points.axis", 3, "axis"),
    "text for a number": (NAMES + "\n1,2,3,x\n1,2,much,x", "recording.not_a_number", 3, "x_gyro_dps"),
    "an infinite number": (NAMES + "\n1,2,inf,x", "recording.not_a_number", 2, "x_gyro_dps"),
    "no reference": (NAMES + "\n1,,3,x", "points.empty", 2, "x_rate_dps"),
    "a cell too few": (NAMES + "\n1,2,3", "recording.cells", 2, None),
    "no rows": (NAMES, "recording.no_rows", None, None),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_points_get_one_sentence_with_line_and_column(case: str) -> None:
    text, code, line, column = BAD[case]
    with pytest.raises(Problem) as refused:
        points.read(text.encode())
    problem = refused.value
    assert (problem.code, problem.values.get("line"), problem.values.get("column")) == (code, line, column)
    assert all("{" not in sentence(problem, lang) for lang in LANGUAGES)
    assert all(not sentence(problem, lang).startswith(code) for lang in LANGUAGES)


NUMBERS = st.floats(-1e6, 1e6).map(lambda value: value + 0.0)
ROW = st.tuples(
    st.sampled_from(["1", "LPY-2"]), st.sampled_from("xz"), st.sampled_from(["linearity", "repeat", ""]),
    NUMBERS, NUMBERS, NUMBERS, st.integers(1, 99), st.one_of(st.just(float("nan")), NUMBERS),
)  # fmt: skip


@settings(max_examples=50, deadline=None)
@given(st.sampled_from(sorted(COLUMNS)), st.lists(ROW, min_size=1, max_size=20))
def test_a_round_trip_gives_the_same_readings(kind: str, rows: list[tuple[object, ...]]) -> None:
    board, axis, test, *numbers = (np.array(column) for column in zip(*rows, strict=True))
    table = Points(board, axis, kind, test, *numbers)
    back = points.read(written(table))
    assert back.kind == kind
    for name in ("board", "axis", "test", "set_point", "reference", "gyro", "reading", "duration_s"):
        np.testing.assert_array_equal(getattr(back, name), getattr(table, name))
