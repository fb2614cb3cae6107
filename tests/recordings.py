"""Recordings for tests: a healthy CSV to damage, and random ones for properties."""

import io

import numpy as np
from hypothesis import strategies as st

from calib_core.recording import MAX_VALUE, Recording, write_csv, write_parquet

NAMES = "time_s,x_gyro_v,x_position_deg,segment"


def csv_lines(rows: int = 210) -> list[str]:
    """A good recording, line by line: the format, the names in line 2, then 100 Hz rows; line 3 + i is row i."""
    body = [f"{i / 100:.2f},{1.25 + 0.001 * (i % 7):.3f},{i // 4 * 0.2933:.4f},hold" for i in range(rows)]
    return ["# format: gyro-recording 1", NAMES, *body]


def csv_bytes(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode()


def to_csv(recording: Recording) -> bytes:
    file = io.BytesIO()
    write_csv(recording, file)
    return file.getvalue()


def to_parquet(recording: Recording) -> bytes:
    file = io.BytesIO()
    write_parquet(recording, file)
    return file.getvalue()


_text = st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=12)
_keys = st.from_regex(r"[a-z][a-z_]{0,8}", fullmatch=True).filter(lambda key: key != "format")
_cells = st.one_of(
    st.just(float("nan")),
    st.integers(-(10**6), 10**6).map(lambda k: k / 1000),
    st.floats(-MAX_VALUE, MAX_VALUE),
)


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    """Any valid recording of a few rows: odd numbers, missing samples, odd names, any header."""
    ticks = sorted(draw(st.sets(st.integers(1, 10**6), min_size=2, max_size=25)))
    time_s = np.array([0, *(t + 2_000_000 for t in ticks)]) / 1e6
    n = len(time_s)
    names = ["x_gyro_v", *draw(st.lists(st.sampled_from(["x_position_deg", "z_gyro_dps", "other"]), unique=True))]
    columns = {name: np.array(draw(st.lists(_cells, min_size=n, max_size=n))) + 0.0 for name in names}
    if draw(st.booleans()):
        columns["valid"] = np.array(draw(st.lists(st.sampled_from([0.0, 1.0]), min_size=n, max_size=n)))
    segments = draw(st.lists(_text, min_size=1, max_size=3, unique=True))
    codes = np.array(draw(st.lists(st.integers(0, len(segments) - 1), min_size=n, max_size=n)), np.int32)
    header = {key: value.strip().rstrip(",") for key, value in draw(st.dictionaries(_keys, _text, max_size=3)).items()}
    header = {key: value.strip() for key, value in header.items()}
    return Recording(time_s, columns, codes, tuple(segments), {"format": "gyro-recording 1", **header})
