"""The arithmetic of thesis 5.1-5.9, on published numbers."""

import csv
import json
import re
from decimal import Decimal

import numpy as np
import pytest
from shared import ROOT, shared

from calib_core import linearity
from calib_core.points import Points
from server.texts import render, texts


def made(test: str, set_points: list[float], readings: list[list[float]]) -> Points:
    flat = [(at, value, i + 1) for at, row in zip(set_points, readings, strict=True) for i, value in enumerate(row)]
    at, gyro, reading = (np.array(column) for column in zip(*flat, strict=True))
    n = len(flat)
    return Points(np.full(n, "B"), np.full(n, "x"), "rate", np.full(n, test), at, at, gyro, reading, np.full(n, np.nan))


def test_the_line_has_norris_certified_digits() -> None:
    certified = json.loads(shared("reference/nist_strd/reference.json").read_text())["sets"]["norris"]
    rows = list(csv.DictReader(shared("reference/nist_strd/norris.csv").read_text().splitlines()))
    x, y = (np.array([float(row[name]) for row in rows]) for name in "xy")
    fit = linearity.line(x, y)
    intercept, slope = map(float, certified["coef"])
    intercept_se, slope_se = map(float, certified["se"])
    assert fit.slope == pytest.approx(slope, rel=1e-12)
    assert fit.intercept == pytest.approx(intercept, rel=1e-10)
    assert (fit.slope_se, fit.intercept_se) == pytest.approx((slope_se, intercept_se), rel=1e-10)
    assert fit.residual_sd == pytest.approx(float(Decimal(certified["rsd"])), rel=1e-11)


def test_the_worked_sample_size_needs_44_readings_and_not_10() -> None:
    case = linearity.sample_size(0.3959, 0.25, 20, t=2.086)
    assert (case.d, round(case.needed, 2), case.enough) == (0.125, 43.65, False)
    slip = linearity.sample_size(0.3959, 0.50, 20, t=2.086)
    assert round(slip.needed, 2) == 10.91


def test_sample_size_takes_t_at_one_less_than_the_readings() -> None:
    assert linearity.sample_size(0.1, 0.25, 20).t == pytest.approx(2.0930, abs=1e-4)


def test_a_verdict_follows_every_repeat_test() -> None:
    rng = np.random.default_rng(1)
    loud = linearity.evaluate(made("repeat", [20.0], [rng.normal(20, 1.0, 22).tolist()]), 200.0, kind="rate")
    assert loud.sample_size is not None
    assert not loud.sample_size.enough
    assert [w["code"] for w in loud.warnings] == ["test.too_few_repeats"]
    quiet = linearity.evaluate(made("repeat", [20.0], [rng.normal(20, 0.01, 22).tolist()]), 200.0, kind="rate")
    told = quiet.to_json()["sample_size"]
    assert told["enough"]
    assert "±0.125 deg/s" in render(told["code"], told["values"])
    assert not quiet.warnings


def test_the_two_extremes_take_no_part() -> None:
    readings = [20.0, 20.1, 19.9, 35.0, -4.0]
    result = linearity.evaluate(made("repeat", [20.0], [readings]), 200.0, kind="rate").to_json()
    point = result["points"]["repeat"][0]
    assert point["used"] == [True, True, True, False, False]
    assert point["mean"] == pytest.approx(20.0)
    assert result["max_standard_deviation_dps"] == pytest.approx(0.1)
    assert result["max_random_error_dps"] == pytest.approx(0.2)
    assert result["repeatability_pct_fs"] == pytest.approx(0.1)
    assert result["uncertainty_type_a_dps"] == pytest.approx(0.1 / 3**0.5)


def test_a_short_plan_keeps_its_few_readings() -> None:
    point = linearity.set_points(made("repeat", [20.0], [[19.0, 20.0, 21.0]]), "repeat", drop_extremes=True)[0]
    assert point.n == 3


def test_the_tables_own_movement_is_not_the_gyros_scatter() -> None:
    points = made("repeat", [20.0], [[20.0, 20.5, 21.0]])
    followed = Points(**{**vars(points), "reference": points.gyro - 0.1})
    point = linearity.set_points(followed, "repeat", drop_extremes=True)[0]
    assert point.standard_deviation == pytest.approx(0.0, abs=1e-12)
    assert point.bias_error == pytest.approx(0.1)


def test_what_is_missing_is_said() -> None:
    points = made("linearity", [10.0, 20.0, 40.0], [[10.0, 10.1, 9.9], [20.0, 20.1], [40.0, 40.1, 39.9]])
    result = linearity.evaluate(points, 200.0, kind="rate", expected={"linearity": [10, 20, 40, 60], "repeat": [20]})
    told = {warning["code"]: warning["values"] for warning in result.warnings}
    assert set(told) == {"test.set_points_missing", "test.readings_missing"}
    assert told["test.readings_missing"] | {"set_point": 20.0, "got": 2, "of": 3} == told["test.readings_missing"]
    assert result.repeatability is None
    assert result.to_json()["repeatability_pct_fs"] is None


@pytest.mark.parametrize("lang", ["en", "th"])
def test_every_warning_of_the_tests_has_its_words(lang: str) -> None:
    core = ROOT / "calib_core"
    sources = [*core.glob("*_test.py"), *(core / f"{name}.py" for name in ("linearity", "strokes", "rig_check"))]
    pattern = r'"((?:test|rate_test|position_test|rig_check|sample_size)\.[a-z_]+)"'
    codes = {code for path in sources for code in re.findall(pattern, path.read_text(encoding="utf-8"))}
    assert len(codes) > 10
    known = set(texts(lang))
    assert [code for code in sorted(codes) if not known & {code, f"warning.{code}", f"error.{code}"}] == []
    assert {"test_name.linearity", "test_name.repeat"} <= known


def test_an_empty_test_is_a_result_without_numbers() -> None:
    result = linearity.evaluate(made("repeat", [0.0], [[0.0]]), 200.0, kind="rate").to_json()
    assert result["nonlinearity_pct_fs"] is None
    assert result["sample_size"] is None
    assert [w["code"] for w in result["warnings"]] == ["test.readings_missing"]
