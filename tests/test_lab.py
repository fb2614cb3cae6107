"""Blind exercises: strengths, the hidden bench, what a recording tells, the grading rules, the table."""

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib_core import strengths
from calib_core.effects import library
from calib_core.problem import Problem
from server import lab_bench
from server.documents.lab_table import render_results
from server.lab_grading import grade
from server.store import Store

WAVE = [{"axis": "x", "kind": "sine", "amplitude_deg": [30.0], "frequency_hz": [0.2513], "duration_s": 8.0}]
TIED = {"rivals": [["bandwidth_lag", "time_offset"]], "rival_sets": [[["bias_drift"], ["warm_up", "bias_step"]]]}


# --- strengths ---------------------------------------------------------------------------------------------------
def test_every_effect_that_can_be_hidden_has_parameters_within_its_bounds_that_grow_with_strength() -> None:
    left_out = set(library()) - set(strengths.SCALE)
    assert left_out == {"input_loading", "supply_sensitivity"}
    for name in strengths.SCALE:
        sizes = []
        for strength in (0.5, 1.0, strengths.STRONGEST):
            rng = np.random.default_rng(1)
            values = strengths.parameters(name, strength, rng, bias=1.25, scale_factor=5.9e-3)
            assert strengths.checked(name, values) == values
            linear = [values[p] for p in values if p not in ("t1", "tau", "f") or name == "bandwidth_lag"]
            sizes.append(math.hypot(*linear))
        if name != "saturation":  # there a lower limit is the stronger effect
            np.testing.assert_allclose(sizes[1:], [2.0 * sizes[0], 10.0 * sizes[0]], err_msg=name)


def test_strength_one_is_as_the_method_has_it() -> None:
    rng = np.random.default_rng(2)

    def of(name: str) -> dict[str, float]:
        return strengths.parameters(name, 1.0, rng, bias=1.25, scale_factor=5.9e-3)

    assert abs(of("bias_temperature")["k1"]) == 0.25e-3
    assert of("bandwidth_lag") == {"tau": 6e-3}
    assert of("saturation") == pytest.approx({"V_lo": 1.25 - 88 * 5.9e-3, "V_hi": 1.25 + 88 * 5.9e-3})
    assert math.hypot(*of("g_sensitivity").values()) == pytest.approx(0.8e-3)


@pytest.mark.parametrize(
    ("name", "values", "code"),
    [
        ("supply_sensitivity", {"k": 0.04}, "effects.not_hidden"),
        ("bandwidth_lag", {"delay": 0.01}, "effects.parameter"),
        ("time_offset", {"delay": -0.01}, "effects.value"),
        ("dead_band", {"d": 400.0}, "effects.value"),
    ],
)
def test_what_cannot_be_hidden_is_refused(name: str, values: dict[str, float], code: str) -> None:
    with pytest.raises(Problem) as refused:
        lab_bench.truth("x", 1, effects=[{"effect": name, "parameters": values}])
    assert refused.value.code == code


def test_surprises_are_as_many_and_as_strong_as_their_difficulty_says() -> None:
    for difficulty, (low, high, odds) in strengths.DIFFICULTIES.items():
        drawn = [strengths.surprise(difficulty, np.random.default_rng(seed)) for seed in range(300)]
        share = np.bincount([len(names) for names in drawn], minlength=len(odds)) / len(drawn)
        np.testing.assert_allclose(share, odds, atol=0.09)
        assert all(low <= strength <= high for names in drawn for strength in names.values())
        assert all(len(kin & {*names}) < 2 for names in drawn for kin in strengths.KIN)


# --- the bench ---------------------------------------------------------------------------------------------------
def test_a_bench_is_the_same_for_all_and_differs_only_by_what_is_hidden() -> None:
    hidden = lab_bench.truth("x", 7, effects=[{"effect": "hysteresis", "parameters": {"h": 0.02}}])
    none = lab_bench.truth("x", 7)
    a = lab_bench.measured(hidden, "CODE", "ann", 1, WAVE, 0.0)
    b = lab_bench.measured(hidden, "CODE", "bob", 1, WAVE, 0.0)
    plain = lab_bench.measured(none, "CODE", "ann", 1, WAVE, 0.0)
    noise = a.columns["x_gyro_v"] - b.columns["x_gyro_v"]
    assert 1.0e-3 < np.std(noise) / math.sqrt(2.0) < 1.6e-3
    differs = np.abs(a.columns["x_gyro_v"] - plain.columns["x_gyro_v"])
    assert np.median(differs) > 0.015
    np.testing.assert_array_equal(a.columns["z_gyro_v"], plain.columns["z_gyro_v"])
    assert a.header == plain.header
    assert a.header["rig"] == "lab:CODE"
    assert (a.header["board"], a.header["axis"], a.header["seed"]) == ("LAB-CODE", "x", "0")
    other = lab_bench.truth("x", 8)
    assert other["bias_V"] != none["bias_V"]


def test_bench_time_goes_on_and_a_warm_up_is_seen_once() -> None:
    hidden = lab_bench.truth("x", 3, effects=[{"effect": "warm_up", "parameters": {"a": 0.1, "tau": 20.0}}])
    rest = [{"axis": "x", "kind": "hold", "duration_s": 3.0}]
    cold = lab_bench.measured(hidden, "C", "s", 1, rest, 0.0).columns["x_gyro_v"]
    later = lab_bench.measured(hidden, "C", "s", 2, rest, 300.0).columns["x_gyro_v"]
    assert cold[-200:].mean() - later[-200:].mean() > 0.05
    assert abs(later[-200:].mean() - hidden["bias_V"]) < 2e-3


@pytest.mark.parametrize("axis", ["x", "z"])
def test_everything_that_is_offered_is_inside_the_limits_and_can_be_looked_at_first(axis: str) -> None:
    for name, steps in lab_bench.offers(axis).items():
        shown = lab_bench.preview([step.to_json() for step in steps], axis)
        assert 60.0 < shown["duration_s"] < 130.0, name
        assert len(shown["time_s"]) == len(shown["angle_deg"]["x"]) == len(shown["warming_degC"])
        assert max(map(abs, shown["angle_deg"]["x"] + shown["angle_deg"]["z"])) <= 150.0


@pytest.mark.parametrize(
    ("motion", "code"),
    [
        ({"kind": "sine", "amplitude_deg": [200.0], "frequency_hz": [0.01]}, "plan.angle_past_rig"),
        ({"kind": "sine", "amplitude_deg": [30.0], "frequency_hz": [2.0]}, "plan.rate_past_sensor"),
        ({"kind": "staircase", "rates_dps": [500.0]}, "plan.rate_past_sensor"),
        ({"kind": "hold", "duration_s": 3000.0}, "lab.too_long"),
        ({"kind": "poses"}, "experiment.numbers"),
    ],
)
def test_a_limit_is_found_before_anything_moves(motion: dict[str, Any], code: str) -> None:
    hidden = lab_bench.truth("x", 1)
    with pytest.raises(Problem) as refused:
        lab_bench.measured(hidden, "C", "s", 1, [{"axis": "x", "duration_s": 20.0} | motion], 0.0)
    assert refused.value.code == code


def test_a_fault_inside_says_nothing_of_what_is_hidden(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object) -> None:
        raise ValueError("dead_band d=2.5 broke")

    hidden = lab_bench.truth("x", 1, effects=[{"effect": "dead_band", "parameters": {"d": 2.5}}])
    monkeypatch.setattr(library()["dead_band"], "apply", broken)
    with pytest.raises(Problem) as refused:
        lab_bench.measured(hidden, "C", "s", 1, WAVE, 0.0)
    assert (refused.value.code, refused.value.values) == ("lab.bench_failed", {})
    assert refused.value.__cause__ is None
    assert refused.value.__suppress_context__
    assert "dead_band" not in caplog.text


def test_runs_join_in_bench_time_and_not_over_a_restart(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        code, key = store.lab.create("Lab 3", lab_bench.truth("x", 1), None)
        student = store.lab.join(code, "Ann")
        first = lab_bench.run(tmp_path, code, student, WAVE, None, False)
        second = lab_bench.run(tmp_path, code, student, WAVE, first, False)
        one, both = store.recording(first), store.recording(second)
        gap_s = float(np.diff(both.time_s).max())
        assert len(both) == 2 * len(one)
        assert gap_s == pytest.approx(lab_bench.BETWEEN_S, abs=0.1)
        assert [run["numbers"] for run in store.lab.runs(student)] == [[1], [1, 2]]
        store.experiments.add(second, "x", [], {"verdict": "ambiguous"})
        assert store.recordings.find()[0] == store.recordings.find(board=f"LAB-{code}")[0] == []
        assert store.experiments.find()[0] == [], "what others' data said would help with one's own"
        assert len(store.experiments.find(recording=second)[0]) == 1
        lab_bench.run(tmp_path, code, student, WAVE, None, True)
        with pytest.raises(Problem) as refused:
            lab_bench.run(tmp_path, code, student, WAVE, second, False)
        assert refused.value.code == "lab.other_session"
        with pytest.raises(Problem, match="recording"):
            lab_bench.run(tmp_path, code, store.lab.join(code, "Bob"), WAVE, first, False)
        with pytest.raises(Problem, match="name_taken"):
            store.lab.join(code, "ANN")
        assert not [file for file in tmp_path.iterdir() if key.encode() in file.read_bytes()]
        store.lab.delete(code)
        with pytest.raises(Problem, match="not_found"):
            store.lab.exercise(code)


# --- grading -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("hidden", "findings", "marks", "missing", "score"),
    [
        ([], [], [], [], 1.0),
        ([], [["hysteresis"]], ["wrong"], [], 0.0),
        (["hysteresis"], [], [], ["hysteresis"], 0.0),
        (["hysteresis"], [["hysteresis"]], ["right"], [], 1.0),
        (["hysteresis"], [["backlash"]], ["wrong"], ["hysteresis"], 0.0),
        (["bandwidth_lag"], [["time_offset", "bandwidth_lag"]], ["tie"], [], 1.0),
        (["bandwidth_lag"], [["bandwidth_lag"]], ["right"], [], 1.0),
        (["bandwidth_lag"], [["time_offset"]], ["wrong"], ["bandwidth_lag"], 0.0),
        (["bandwidth_lag"], [["bandwidth_lag", "clock_skew"]], ["too_wide"], [], 0.5),
        (["bandwidth_lag"], [["clock_skew", "hysteresis"]], ["wrong"], ["bandwidth_lag"], 0.0),
        (["warm_up"], [["warm_up", "bias_drift"]], ["tie"], [], 1.0),
        (["hysteresis", "bias_drift"], [["bias_drift"]], ["right"], ["hysteresis"], 0.5),
        (["hysteresis", "bias_drift"], [["bias_drift"], ["backlash"]], ["right", "wrong"], ["hysteresis"], 0.5),
        (["hysteresis"], [["hysteresis"], ["hysteresis"]], ["right", "wrong"], [], 0.5),
        (["bandwidth_lag", "time_offset"], [["bandwidth_lag", "time_offset"], ["bandwidth_lag"]], ["tie", "right"], [],
         1.0),
    ],
)  # fmt: skip
def test_the_rules(
    hidden: list[str], findings: list[list[str]], marks: list[str], missing: list[str], score: float
) -> None:
    graded = grade(hidden, findings, TIED)
    assert [mark["mark"] for mark in graded["marks"]] == marks
    assert (graded["missing"], graded["score"]) == (missing, score)


def test_a_tie_counts_only_where_the_students_own_data_leave_it() -> None:
    lag = [["bandwidth_lag", "time_offset"]]
    for said in (None, {"message": {}}, {"rivals": [], "rival_sets": []}):
        (mark,) = grade(["bandwidth_lag"], lag, said)["marks"]
        assert (mark["mark"], mark["told_apart"]) == ("too_wide", ["time_offset"])
    (mark,) = grade(["bandwidth_lag"], [["time_offset"]], TIED)["marks"]
    assert (mark["mark"], mark["tied_with"]) == ("wrong", "bandwidth_lag")


def test_results_as_a_table_say_everything_and_no_formula() -> None:
    hidden = {"effects": [{"effect": "bandwidth_lag"}]}
    answer = {
        "findings": [["bandwidth_lag", "time_offset"]],
        "confidence": 80,
        "reasoning": "=1+1\nso",
        "recording": "r",
    }
    students: list[dict[str, Any]] = [
        {"name": "สมหญิง", "runs": 2, "measured_s": 130.4, "answer": answer, "submitted_at": "2026-11-22T07:00:00Z",
         "grade": grade(["bandwidth_lag"], answer["findings"], TIED),
         "diagnosis": TIED | {"verdict": "ambiguous", "missing": [{"effect": "time_offset"}]}},
        {"name": "@Bob", "runs": 0, "measured_s": 0.0, "answer": None, "grade": None, "diagnosis": None},
    ]  # fmt: skip
    text = render_results(hidden, students).decode("utf-8-sig")
    first, second = csv.DictReader(io.StringIO(text))
    assert (first["answer"], first["score"], first["ties"], first["truth"]) == (
        "bandwidth_lag|time_offset", "1.0", "1", "bandwidth_lag",
    )  # fmt: skip
    assert (first["reasoning"], first["instrument_found"]) == ("'=1+1 so", "time_offset")
    assert (second["name"], second["answer"], second["score"]) == ("'@Bob", "", "")
