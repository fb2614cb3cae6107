"""``gyro-recording 1`` in and out: every bad file gets its sentence, every good one comes back as it was."""

import gzip
import io
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from recordings import NAMES, csv_bytes, csv_lines, recordings, to_csv, to_parquet
from shared import shared

from calib_core import recording_file
from calib_core.packing import pack_recording, unpack_recording
from calib_core.problem import Problem
from calib_core.recording import Recording, check, read
from server.texts import LANGUAGES, sentence

Change = Callable[[list[str]], list[str] | bytes]


def line(number: int, text: str) -> Change:
    """Line ``number``, from 1, replaced."""
    return lambda lines: [*lines[: number - 1], text, *lines[number:]]


def names(text: str, cell: str = "") -> Change:
    """Another line of names, and ``cell`` at the end of every row."""
    return lambda lines: [lines[0], text, *(row + cell for row in lines[2:])]


def zipped(cut: int | None = None, damage: bool = False) -> Change:
    def change(lines: list[str]) -> bytes:
        packed = bytearray(gzip.compress(csv_bytes(lines)))
        packed[-6] ^= 255 * damage
        return bytes(packed[:cut])

    return change


# What is wrong: (how a good file is changed, the sentence, its line, its column).
BAD: dict[str, tuple[Change, str, int | None, str | None]] = {
    "empty file": (lambda _: b"", "recording.empty_file", None, None),
    "empty after unpacking": (lambda _: gzip.compress(b""), "recording.empty_file", None, None),
    "header only": (lambda lines: lines[:1], "recording.no_rows", None, None),
    "names only": (lambda lines: lines[:2], "recording.no_rows", None, None),
    "a workbook": (lambda _: b"PK\x03\x04" + bytes(999), "recording.not_text", 1, None),
    "a picture": (lambda _: b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "recording.not_text", 1, None),
    "UTF-16": (lambda lines: csv_bytes(lines).decode().encode("utf-16"), "recording.not_text", 1, None),
    "UTF-16 without a mark": (lambda lines: csv_bytes(lines).decode().encode("utf-16-le"),
                              "recording.not_text", 1, None),
    "Latin-1 in a segment": (lambda lines: csv_bytes([*lines[:8], "0.06,1.2,0,hold", *lines[9:]]).replace(
                                 b"0.06,1.2,0,hold", b"0.06,1.2,0,h\xe4lt"), "recording.not_text", 9, None),
    "bytes of zero in a row": (line(9, "0.06,1.2,0,ho\0ld"), "recording.not_text", 9, None),
    "semicolons": (lambda lines: [row.replace(",", ";") for row in lines], "recording.not_commas", 2, None),
    "tabs": (lambda lines: [row.replace(",", "\t") for row in lines], "recording.not_commas", 2, None),
    "truncated gzip": (zipped(cut=-20), "recording.gzip_truncated", None, None),
    "gzip without its end": (zipped(cut=-4), "recording.gzip_truncated", None, None),
    "damaged gzip": (zipped(damage=True), "recording.gzip_corrupt", None, None),
    "cut off in a row": (lambda lines: csv_bytes(lines)[:-12], "recording.cells", 212, None),
    "cut off in a segment": (lambda lines: csv_bytes(lines)[:-3], "recording.cut_off", 212, "segment"),
    "cut off before a segment": (lambda lines: csv_bytes(lines)[:-5], "recording.cut_off", 212, "segment"),
    "a cell too many": (line(50, "0.47,1.2,0,hold,7"), "recording.cells", 50, None),
    "a quotation mark that is never closed": (line(50, '0.47,1.2,0,"hold'), "recording.control_character", 50,
                                              "segment"),
    "another format": (line(1, "# format: gyro-recording 2"), "recording.unknown_format", None, None),
    "single readings": (line(1, "# format: gyro-points 1"), "recording.is_points", None, None),
    "single readings without a header": (names("board,set_point,x_gyro_dps,x_rate_dps"),
                                         "recording.is_points", None, None),
    "no time": (names("clock,x_gyro_v,x_position_deg,segment"), "recording.no_time", 2, "time_s"),
    "time in another unit": (names("time_ms,x_gyro_v,x_position_deg,segment"), "recording.unknown_unit", 2, "time_ms"),
    "no gyro column": (names("time_s,gyro,x_position_deg,segment"), "recording.no_gyro", 2, None),
    "unknown unit of a gyro": (names("time_s,x_gyro_rad_s,a,segment"), "recording.unknown_unit", 2, "x_gyro_rad_s"),
    "unknown unit of a position": (names("time_s,x_gyro_v,x_position_rad,segment"), "recording.unknown_unit", 2,
                                   "x_position_rad"),
    "unknown unit of a covariate": (names("time_s,x_gyro_v,temperature_f,segment"), "recording.unknown_unit", 2,
                                    "temperature_f"),
    "a column twice": (names(NAMES + ",x_gyro_v", ",1"), "recording.duplicate_column", 2, "x_gyro_v"),
    "two units on one axis": (names(NAMES + ",x_gyro_dps", ",1"), "recording.two_units", 2, "x_gyro_dps"),
    "times of no positions": (names(NAMES + ",z_position_time_s", ","), "recording.position_time_alone", 2,
                              "z_position_time_s"),
    "text for a number": (line(40, "0.37,high,0,hold"), "recording.not_a_number", 40, "x_gyro_v"),
    "a decimal comma": (line(40, '0.37,"1,25",0,hold'), "recording.not_a_number", 40, "x_gyro_v"),
    "the first of two bad cells": (lambda lines: line(40, "0.37,high,0,hold")(line(60, "late,1,0,hold")(lines)),
                                   "recording.not_a_number", 40, "x_gyro_v"),
    "an infinite number": (line(40, "0.37,inf,0,hold"), "recording.out_of_range", 40, "x_gyro_v"),
    "a number that is no measurement": (line(40, "0.37,1e12,0,hold"), "recording.out_of_range", 40, "x_gyro_v"),
    "a row without its time": (line(40, ",1.2,0,hold"), "recording.time_missing", 40, "time_s"),
    "a time twice": (line(40, "0.36,1.2,0,hold"), "recording.time_not_increasing", 40, "time_s"),
    "a time that goes back": (line(40, "0.2,1.2,0,hold"), "recording.time_not_increasing", 40, "time_s"),
    "after a blank line": (lambda lines: ["", *line(40, "0.35,1.2,0,hold")([*lines[:9], "", *lines[9:]])],
                           "recording.time_not_increasing", 41, "time_s"),
    "an encoder reading twice": (lambda lines: [lines[0], NAMES + ",x_position_time_s",
                                                *(row + "," for row in lines[2:40]), "0.38,1.2,5,hold,0.37",
                                                *(row + "," for row in lines[41:])],
                                 "recording.time_not_increasing", 41, "x_position_time_s"),
    "valid is neither 1 nor 0": (lambda lines: line(40, "0.37,1.2,0,hold,2")(names(NAMES + ",valid", ",1")(lines)),
                                 "recording.valid_not_0_or_1", 40, "valid"),
    "valid is empty": (lambda lines: line(40, "0.37,1.2,0,hold,")(names(NAMES + ",valid", ",1")(lines)),
                       "recording.valid_not_0_or_1", 40, "valid"),
    "a segment of two lines": (line(40, '0.37,1.2,0,"ho\nld"'), "recording.control_character", 40, "segment"),
    "a delay that is no number": (line(1, "# x_gyro_delay_s: soon"), "recording.header_seconds", None, None),
    "under two seconds": (lambda lines: lines[:200], "recording.too_short", None, None),
    "truncated Parquet": (lambda lines: to_parquet(read(csv_bytes(lines)))[:-50],
                          "recording.parquet_corrupt", None, None),
}  # fmt: skip


def refusal(data: bytes, **options: object) -> Problem:
    with pytest.raises(Problem) as refused:
        read(data, **options)  # type: ignore[arg-type]
    return refused.value


def assert_told(problem: Problem, code: str, line: int | None, column: str | None) -> None:
    assert (problem.code, problem.values.get("line"), problem.values.get("column")) == (code, line, column)
    for lang in LANGUAGES:
        text = sentence(problem, lang)
        assert "{" not in text
        assert not text.startswith(code)
        assert line is None or str(line) in text
        assert column is None or column in text


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_gets_one_sentence_with_line_and_column(case: str) -> None:
    change, code, at, column = BAD[case]
    changed = change(csv_lines())
    assert_told(refusal(changed if isinstance(changed, bytes) else csv_bytes(changed)), code, at, column)


def test_the_good_file_that_the_bad_ones_are_made_of_is_good() -> None:
    recording = read(csv_bytes(csv_lines()))
    assert len(recording) == 210
    assert recording.columns["x_position_deg"][4] == 0.2933
    assert read(csv_bytes(csv_lines()).rstrip()).digest() == recording.digest()


def test_a_file_over_the_limit_is_refused_unread() -> None:
    data = csv_bytes(csv_lines())
    assert_told(refusal(data, max_bytes=1000), "recording.too_large", None, None)
    assert_told(refusal(io.BytesIO(data), max_bytes=1000), "recording.too_large", None, None)
    assert_told(refusal(to_parquet(read(data)), max_bytes=5000), "recording.too_large", None, None)


def test_a_small_gzip_cannot_fill_the_memory() -> None:
    bomb = gzip.compress(bytes(20_000_000))
    assert len(bomb) < 20_000
    assert_told(refusal(bomb, max_bytes=1_000_000), "recording.too_large", None, None)


def test_a_small_parquet_cannot_fill_the_memory() -> None:
    rows = 100_000
    still = Recording(np.arange(rows) / 100, {"x_gyro_v": np.zeros(rows)}, np.zeros(rows, np.int32), ("",))
    bomb = to_parquet(still)
    assert_told(refusal(bomb, max_bytes=1_500_000), "recording.too_large", None, None)


def test_a_row_of_parquet_is_told_by_its_number() -> None:
    r = read(csv_bytes(csv_lines()))
    time_s = r.time_s.copy()
    time_s[7] = time_s[6]
    data = to_parquet(Recording(time_s, r.columns, r.segment_codes, r.segment_names))
    assert_told(refusal(data), "recording.time_not_increasing", 8, "time_s")


def test_foreign_columns_come_in_by_mapping() -> None:
    lines = csv_lines()
    foreign = csv_bytes([lines[0], "clock,gx,label,what", *lines[2:]])
    mapping = {"clock": "time_s", "gx": "x_gyro_v", "label": "x_position_deg", "what": "segment"}
    assert read(foreign, mapping=mapping).digest() == read(csv_bytes(lines)).digest()
    assert_told(refusal(foreign, mapping={"gy": "y_gyro_v"}), "recording.no_such_column", None, "gy")
    clash = mapping | {"label": "x_gyro_v"}
    assert_told(refusal(foreign, mapping=clash), "recording.duplicate_column", 2, "x_gyro_v")
    partial = read(foreign, mapping={"clock": "time_s", "gx": "x_gyro_v"})
    # Numbers of other names stay, text that nobody asked for goes.
    assert list(partial.columns) == ["x_gyro_v", "label"]
    assert partial.header["left_out"] == "what"


def test_what_spreadsheets_do_to_a_recording_does_no_harm() -> None:
    lines = csv_lines()
    plain = read(csv_bytes([lines[0], "# source: bench 2, left", *lines[1:]]))
    spaced = [lines[0] + ",,,", '"# source: bench 2, left",,,', *(row.replace(",", " , ") for row in lines[1:])]
    saved = b"\xef\xbb\xbf" + "\r\n".join([*spaced, "", ""]).encode()
    saved = saved.replace(b" , hold", b",hold")
    assert read(saved).digest() == plain.digest()
    assert read(saved).header == plain.header == {"format": "gyro-recording 1", "source": "bench 2, left"}
    old_mac = csv_bytes(lines).replace(b"\n", b"\r")
    assert read(old_mac).digest() == plain.digest()


@pytest.mark.parametrize("cell", ["", "nan", "NaN", "NAN", " "])
def test_a_cell_without_a_sample_is_nan(cell: str) -> None:
    recording = read(csv_bytes(line(40, f"0.37,{cell},0,hold")(csv_lines())))  # type: ignore[arg-type]
    assert np.flatnonzero(np.isnan(recording.columns["x_gyro_v"])).tolist() == [37]


def test_header_lines_are_kept_in_order() -> None:
    lines = csv_lines()
    header = ["# operator: ปรีชา", "# note:", "# just words", "# url: https://a/b", "# operator: N"]
    recording = read(csv_bytes([lines[0], *header, *lines[1:]]))
    expected = {"format": "gyro-recording 1", "operator": "ปรีชา; N", "note": "", "comment": "just words"}
    assert recording.header == expected | {"url": "https://a/b"}
    assert read(to_csv(recording)).header == recording.header
    assert read(to_parquet(recording)).header == recording.header


def test_a_line_break_in_a_header_value_cannot_add_a_row() -> None:
    r = read(csv_bytes(csv_lines()))
    sly = Recording(r.time_s, r.columns, r.segment_codes, r.segment_names, {"note": "a\nb: c\r\n0,0,0,x"})
    back = read(to_csv(sly))
    assert back.header == {"format": "gyro-recording 1", "note": "a b: c 0,0,0,x"}
    assert back.digest() == r.digest()


def same(a: Recording, b: Recording) -> bool:
    return (
        np.array_equal(a.time_s, b.time_s)
        and sorted(a.columns) == sorted(b.columns)
        and all(np.array_equal(a.columns[name], b.columns[name], equal_nan=True) for name in a.columns)
        and [(run.name, run.start) for run in a.runs()] == [(run.name, run.start) for run in b.runs()]
        and a.digest() == b.digest()
        and dict(a.header) == dict(b.header)
    )


@settings(max_examples=60, deadline=None)
@given(recordings())
def test_every_round_trip_gives_the_same_recording(recording: Recording) -> None:
    check(recording)
    text = to_csv(recording)
    assert same(read(text), recording)
    assert same(read(gzip.compress(text, 1)), recording)
    assert same(read(to_parquet(recording)), recording)
    assert same(unpack_recording(pack_recording(recording)), recording)
    assert to_csv(read(text)) == text


@pytest.mark.parametrize(
    "write", [to_csv, lambda r: gzip.compress(to_csv(r)), to_parquet], ids=["csv", "gz", "parquet"]
)
def test_damage_anywhere_ends_in_a_sentence(write: Callable[[Recording], bytes]) -> None:
    good = write(read(csv_bytes(csv_lines())))
    rng = np.random.default_rng(7)
    refused = 0
    for _ in range(150):
        data = bytearray(good)
        for at in rng.integers(0, len(good), rng.integers(1, 4)):
            data[at : at + rng.integers(0, 3)] = rng.choice([b'"', b",", b"\n", b"#", b"\0", b"\xff", b"-1e9", b""])
        try:
            read(bytes(data))
        except Problem:
            refused += 1
    assert refused > 75


@settings(max_examples=60, deadline=None)
@given(recordings())
def test_the_fast_reader_agrees_with_the_careful_one(recording: Recording) -> None:
    table = recording_file.split(to_csv(recording))
    fast = recording_file._fast(table, table.names)
    assert fast is not None
    assert same(fast, recording_file._slow(table, table.names))


@pytest.mark.parametrize("folder", ["hidden_effects", "real"])
def test_the_worked_recordings_are_read_and_come_back_the_same(folder: str) -> None:
    files = sorted(path for path in shared(folder).iterdir() if ".csv" in path.name)
    assert len(files) >= 3
    for path in files:
        recording = read(path.read_bytes())
        assert recording.axes[0] == "x"
        assert recording.duration_s > 100
        assert same(unpack_recording(pack_recording(recording)), recording)
    assert same(read(to_csv(recording)), recording)
    assert same(read(to_parquet(recording)), recording)
