"""The thesis' published readings give the thesis' published tables, and show where these disagree."""

import csv
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from shared import shared

from calib_core.thesis import compare, printed, report, simulation, tables
from server import cli
from server.texts import render, texts

# What METHOD 1 lists. The program must find these itself; nothing of the kind stands in it.
NINE = [
    ("5.8", "60", "bias_error", 0.7634, 2.1692),
    *[("5.10", "-60", name, None, None) for name in ("mean", "standard_deviation", "bias_error", "random_error")],
    *[("5.16", "-120", name, None, None) for name in ("mean", "standard_deviation", "bias_error", "random_error")],
]
OTHERS = [
    # table, board, axis, quantity, printed, recomputed
    ("5.3", "1", "x", "residual", -2.2539, -2.2520),
    ("fig 5.10-5.13", "1", "z", "intercept", -0.4192, -0.3633),
    ("5.20", "1", "z", "nonlinearity", 0.69, 0.66),
    ("5.20", "1", "x", "max_linearity_error", -2.2593, -2.2520),
    ("5.21", "2", "x", "max_bias_error", 2.0874, 4.9882),
    ("5.21", "2", "z", "max_bias_error", 0.6450, 1.5480),
    ("5.21", "2", "x", "max_random_error", 2.7359, 1.3679),
    ("5.21", "2", "z", "max_random_error", 3.3970, 1.6985),
    ("5.2", "", "", "scale_factor", 0.005905, 0.0059482),
    ("4.2", "", "", "scale_factor", 0.00459, None),
]
TRUNCATED = {(1.0768, 1.07), (0.6362, 0.63), (0.7860, 0.78), (0.7077, 0.70), (0.7997, 0.79)}


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    return report(seeds=2)


def of_code(found: dict[str, Any], code: str) -> Iterator[dict[str, Any]]:
    return (one for one in found["disagreements"] if one["code"] == f"finding.{code}")


def test_215_of_224_statistics_and_seven_of_eight_lines_come_out(found: dict[str, Any]) -> None:
    assert found["statistics"] == {"printed": 224, "reproduced": 215}
    assert found["lines"] == {"printed": 8, "reproduced": 7}


def test_the_nine_statistics_that_do_not_come_out_are_found(found: dict[str, Any]) -> None:
    repeats = {table for tables in printed.REPEAT.values() for table in tables}
    statistics = [one for one in found["disagreements"] if one["table"] in repeats and one["row"]]
    assert len(statistics) == 9
    for table, row, quantity, was, gives in NINE:
        (one,) = [o for o in statistics if (o["table"], o["row"], o["quantity"]) == (table, row, quantity)]
        if was is not None:
            assert (one["printed"], round(one["recomputed"], 4)) == (was, gives)


@pytest.mark.parametrize("expected", OTHERS, ids=lambda e: " ".join(e[:4]))
def test_each_listed_disagreement_is_found(found: dict[str, Any], expected: tuple[Any, ...]) -> None:
    *place, was, gives = expected
    names = ("table", "board", "axis", "quantity")
    (one,) = [o for o in found["disagreements"] if [o[n] for n in names] == place]
    assert one["printed"] == was
    if gives is not None:
        decimals = len(str(gives).partition(".")[2])
        assert round(one["recomputed"], decimals) == pytest.approx(gives)


def test_five_truncated_percentages_are_told_from_rounded_ones(found: dict[str, Any]) -> None:
    assert {(round(o["recomputed"], 4), o["printed"]) for o in of_code(found, "truncated")} == TRUNCATED


def test_what_was_doubled_twice_is_recognised(found: dict[str, Any]) -> None:
    assert [(o["table"], o["board"], o["axis"]) for o in of_code(found, "doubled_twice")] == [
        ("5.21", "2", "x"),
        ("5.21", "2", "z"),
    ]


def test_type_a_is_t_times_ours_to_within_0014(found: dict[str, Any]) -> None:
    off = [one["values"]["off"] for one in of_code(found, "type_a_expanded")]
    assert len(off) == 8
    assert 0.013 < max(off) <= 0.014


def test_raw_converter_codes_are_seen_in_three_tables_and_no_other(found: dict[str, Any]) -> None:
    grids = {one["table"]: one for one in of_code(found, "raw_codes")}
    assert set(grids) == {"5.3", "5.7", "5.9"}
    for one in grids.values():
        assert one["recomputed"] == pytest.approx(0.1904, abs=2e-4)
        assert one["values"]["step_mV"] == pytest.approx(1.133, abs=1e-3)


def test_the_state_list_names_one_state_twice(found: dict[str, Any]) -> None:
    (one,) = of_code(found, "state_named_twice")
    assert (one["row"], one["printed"], one["axis"]) == ("6", "rate", "z")


def test_the_eighth_line_comes_out_with_another_encoder_reading(found: dict[str, Any]) -> None:
    (one,) = of_code(found, "line_of_other_reference")
    assert one["values"]["instead"] == pytest.approx(11.7302, abs=1e-4)
    assert one["values"]["steps"] == pytest.approx(4.0, abs=1e-3)


def test_two_rows_come_out_when_other_readings_are_dropped(found: dict[str, Any]) -> None:
    dropped = {(o["table"], tuple(o["values"]["dropped"])) for o in of_code(found, "other_readings_dropped")}
    assert dropped == {("5.10", (-60.0294, -63.0517)), ("5.16", (-122.51, -123.842))}


def test_the_worked_sample_size_used_the_whole_interval(found: dict[str, Any]) -> None:
    (one,) = of_code(found, "interval_for_half")
    assert (one["printed"], round(one["recomputed"], 2)) == (10.91, 43.65)


def test_every_table_is_there_with_printed_and_recomputed_side_by_side(found: dict[str, Any]) -> None:
    tables = {table["table"]: table["rows"] for table in found["tables"]}
    assert {"4.1", "4.2", *(f"5.{i}" for i in range(1, 22))} <= set(tables)
    for i in (*range(3, 19), 20, 21):
        assert all(isinstance(row["recomputed"], float) for row in tables[f"5.{i}"])
    for name in ("4.1", "5.1", "5.2", "5.19"):
        assert all(row["recomputed"] is None for row in tables[name])
        assert all(row["printed"] is not None for row in tables[name])


@pytest.mark.parametrize(
    ("place", "misprint", "code"),
    [
        (("5.7", "1", "x", "60", "mean"), "58.1539", "not_reproduced"),
        (("5.17", "2", "x", "120", "bias_error"), "4.8982", "bias_error_alone"),
        (("fig 5.14-5.17", "2", "x", "", "slope"), "1.051", "not_reproduced"),
        (("5.20", "1", "x", "", "max_random_error"), "4.3538", "doubled_twice"),
        (("5.20", "1", "x", "", "nonlinearity"), "1.12", "truncated"),
        (("5.21", "1", "x", "", "max_bias_error"), "3.4114", "summary_differs"),
    ],
)
def test_a_misprint_made_here_is_found_too(place: tuple[str, ...], misprint: str, code: str) -> None:
    """What is found comes from comparing: nothing would know of these."""
    key = printed.Key(*place)
    cells = printed.cells()
    tests = tables.tests()
    values = tables.recompute(tests)
    wrong = {**cells, key: replace(cells[key], printed=misprint)}
    before = {one.key for one in compare.disagreements(cells, values, tests)}
    after = {one.key: one.code for one in compare.disagreements(wrong, values, tests)}
    assert key not in before
    assert after[key] == code


def test_a_printed_value_put_right_is_no_longer_found() -> None:
    key = printed.Key("5.8", "1", "z", "60", "bias_error")
    cells, tests = printed.cells(), tables.tests()
    right = {**cells, key: replace(cells[key], printed="2.1692")}
    assert key not in {one.key for one in compare.disagreements(right, tables.recompute(tests), tests)}


@pytest.mark.parametrize("lang", ["en", "th"])
def test_every_finding_and_every_table_has_its_words(found: dict[str, Any], lang: str) -> None:
    known = texts(lang)
    for one in found["disagreements"]:
        assert one["code"] in known
        sentence = render(one["code"], one["values"], lang)
        assert not re.search(r"[{}]|finding\.|thesis_quantity\.", sentence), sentence
    for table in found["tables"]:
        assert table["title"]["code"] in known
        assert all(f"thesis_quantity.{row['quantity']}" in known for row in table["rows"])


def test_the_command_prints_one_json_object(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["thesis", "--json", "--seeds", "1"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["statistics"] == {"printed": 224, "reproduced": 215}
    assert all(one["sentence"] for one in said["disagreements"])


def test_the_command_sets_the_tables_side_by_side(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["thesis", "--seeds", "1", "--lang", "th"]) == 0
    said = capsys.readouterr().out
    assert "0.7634 ≠ 2.1692" in said
    assert "215" in said.splitlines()[-2]
    pairs = re.findall(r"(-?[\d.]+) ([=≠]) (-?[\d.]+)", said)
    assert len(pairs) > 700
    assert all((left == right) == (mark == "=") for left, mark, right in pairs)


@pytest.mark.parametrize("frequency_hz", [0.25, 0.2513])
def test_the_simulation_study_recovers_what_was_set(frequency_hz: float) -> None:
    study = simulation.study(20 if frequency_hz == 0.25 else 4, frequency_hz)
    scale = {name: np.abs(values / simulation.SCALE_FACTOR - 1) for name, values in study.scale_factor.items()}
    bias = {name: np.abs(values - simulation.BIAS_V) for name, values in study.bias_V.items()}
    assert scale["integral_fit"].max() < 3e-4
    assert bias["integral_fit"].max() < 1e-4
    assert scale["matched"].max() < 5e-3
    assert bias["matched"].max() < 1e-3
    assert np.isfinite(study.scale_factor["thesis"]).all()


def test_the_data_here_are_the_published_ones() -> None:
    for kind, unit in (("rate", "dps"), ("position", "deg")):
        ours = printed.every_reading(kind)
        theirs = []
        for name in ("linearity", "repeatability"):
            with shared(f"thesis/{kind}_{name}.csv").open(encoding="utf-8") as file:
                for row in csv.DictReader(file):
                    place = row["board"], row["axis"], name[:6], row[f"setpoint_{unit}"], row[f"encoder_{unit}"]
                    if name == "linearity":
                        theirs += [(*place, i, row[f"gyro_{i}_{unit}"]) for i in (1, 2, 3)]
                    else:
                        theirs.append((*place, int(row["repeat"]), row[f"gyro_{unit}"]))
        mine = zip(
            ours.board, ours.axis, ours.test, ours.set_point, ours.reference, ours.reading, ours.gyro, strict=True
        )
        plain = [(b, a, t[:6], float(s), float(e), int(n), float(g)) for b, a, t, s, e, n, g in mine]
        assert plain == [(b, a, t, float(s), float(e), n, float(g)) for b, a, t, s, e, n, g in theirs]


def test_the_printed_figures_here_are_the_published_ones() -> None:
    ours = {tuple(vars(key).values()): cell.printed for key, cell in printed.cells().items()}
    count = 0
    for row in read("printed_repeatability_statistics.csv"):
        for name in ("mean", "std", "bias_error", "random_error"):
            quantity = {"std": "standard_deviation"}.get(name, name)
            assert ours[row["table"], row["board"], row["axis"], row["setpoint"], quantity] == row[f"printed_{name}"]
            count += 1
    for kind, unit in (("rate", "dps"), ("position", "deg")):
        for row in read(f"{kind}_linearity.csv"):
            for name in ("mean", "fit", "residual"):
                place = row["table"], row["board"], row["axis"], row[f"setpoint_{unit}"], name
                assert ours[place] == row[f"printed_{name}_{unit}"]
                count += 1
    printed_here = {(place[0], place[1], place[2], value) for place, value in ours.items()}
    for row in read("printed_summary.csv"):
        assert (row["table"], row["board"], row["axis"], row["printed_value"]) in printed_here
        count += 1
    for row in read("printed_tables_without_readings.csv"):
        assert (row["table"], "", "", row["value"]) in printed_here
        count += 1
    extra = [place for place in ours if place[0] in ("equations 5.3-5.6", "section 4.1.3", "list of states")]
    assert count + len(extra) == len(ours)


def read(name: str) -> Iterator[dict[str, str]]:
    with shared(f"thesis/{name}").open(encoding="utf-8") as file:
        yield from csv.DictReader(file)


@pytest.mark.parametrize("lang", ["en", "th"])
def test_every_row_and_place_that_is_not_a_number_has_its_words(found: dict[str, Any], lang: str) -> None:
    named = [("place", table["table"]) for table in found["tables"]]
    for row in (row for table in found["tables"] for row in table["rows"]):
        named += [("row", cell) for cell in (row["row"], row["printed"]) if isinstance(cell, str)]
    known = texts(lang)
    missing = {
        (kind, name)
        for kind, name in named
        if re.search("[a-z]{3}", name) and f"thesis_{kind}.{re.sub('[^a-z0-9]+', '_', name.lower())}" not in known
    }
    assert missing == set()


def test_a_unit_stands_in_the_head_of_its_column_or_beside_each_value(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["thesis", "--seeds", "1"]) == 0
    said = capsys.readouterr().out
    for words in ("480 deg/s", "300 x 300 mm", "33.3 mV/(deg/s)", "scale factor, V/(deg/s)"):
        assert words in said
