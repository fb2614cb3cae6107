"""Certified numbers, how they are written, and the verdict of a specification."""

import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib_core.certificate import FIELDS, concise, judge, limits, two_digits
from calib_core.problem import Problem

AXES: dict[str, dict[str, Any]] = {
    "x": {
        "bias_V": {"value": 1.263, "standard_uncertainty": 2e-5, "expanded_uncertainty": 4e-5},
        "rate": {"nonlinearity_pct_fs": 0.7, "max_bias_error_dps": -1.2},
    }
}


def spec(**figures: object) -> dict[str, Any]:
    return {"name": "lab", "axes": {"x": figures}}


@pytest.mark.parametrize(
    ("value", "uncertainty", "written"),
    [
        (5.9482, 0.0031, "5.9482(31)"),
        (1.263014, 0.000042, "1.263014(42)"),
        (45.63, 1.2, "45.6(1.2)"),
        (1234.0, 123.0, "1230(120)"),
        (1.26, 0.0996, "1.26(10)"),
        (1.2, 0.99999, "1.2(1.0)"),
        (12.3, 9.96, "12(10)"),
        (-0.5, 0.012, "-0.500(12)"),
        (5.0, 0.0, "5"),
    ],
)
def test_a_value_is_written_with_two_digits_of_its_uncertainty(value: float, uncertainty: float, written: str) -> None:
    assert concise(value, uncertainty) == written


@given(st.floats(-1e4, 1e4), st.floats(1e-9, 1e4))
def test_what_is_written_reads_back_to_within_its_uncertainty(value: float, uncertainty: float) -> None:
    found = re.fullmatch(r"(-?[\d.]+)\(([\d.]+)\)", concise(value, uncertainty))
    assert found
    assert abs(float(found[1]) - value) <= 0.051 * uncertainty + 1e-12 * abs(value)
    decimals = len(found[1].partition(".")[2])
    digits = float(found[2]) if "." in found[2] else float(found[2]) * 10.0**-decimals
    assert digits == pytest.approx(uncertainty, rel=0.051)
    assert float(two_digits(uncertainty)) == pytest.approx(digits)


def test_no_certified_number_is_listed_twice() -> None:
    assert len({field.path for field in FIELDS}) == len(FIELDS)


def test_without_a_specification_the_verdict_is_issued() -> None:
    assert judge(AXES, None) == ("issued", [])


def test_limits_apply_to_the_value_and_to_the_size_of_signed_errors() -> None:
    inside = spec(bias_V={"min": 1.2, "max": 1.3}, rate={"max_bias_error_dps": {"max": 1.5}})
    verdict, rows = judge(AXES, inside)
    assert verdict == "pass"
    assert [row["ok"] for row in rows] == [True, True]
    assert judge(AXES, spec(rate={"max_bias_error_dps": {"max": 1.0}}))[0] == "fail"
    assert judge(AXES, spec(bias_V={"max": 1.2}))[0] == "fail"
    assert judge(AXES, spec(bias_V={"min": 1.3}))[0] == "fail"


def test_an_uncertainty_can_be_limited_too() -> None:
    assert judge(AXES, spec(bias_V={"expanded_uncertainty": {"max": 5e-5}}))[0] == "pass"
    assert judge(AXES, spec(bias_V={"expanded_uncertainty": {"max": 3e-5}}))[0] == "fail"


def test_a_limit_on_what_was_not_measured_is_not_met() -> None:
    verdict, rows = judge(AXES, spec(position={"nonlinearity_pct_fs": {"max": 9}}))
    assert verdict == "fail"
    assert rows[0]["value"] is None
    assert judge(AXES, {"axes": {"z": {"bias_V": {"max": 9}}}})[0] == "fail"


@pytest.mark.parametrize(
    ("given", "code", "path"),
    [
        ([], "spec.not_an_object", "spec"),
        ({}, "spec.not_an_object", "axes"),
        ({"axes": {}, "limit": 1}, "spec.unknown_key", "spec.limit"),
        ({"axes": {"w": {}}}, "spec.unknown_key", "axes.w"),
        (spec(sensitivity={"max": 1}), "spec.unknown_key", "axes.x.sensitivity"),
        (spec(rate={"nonlinearity": {"max": 1}}), "spec.unknown_key", "axes.x.rate.nonlinearity"),
        (spec(rate={"max": 1}), "spec.unknown_key", "axes.x.rate.max"),
        (spec(bias_V={"maximum": 1}), "spec.unknown_key", "axes.x.bias_V.maximum"),
        (spec(bias_V=1.3), "spec.not_an_object", "axes.x.bias_V"),
        (spec(bias_V={"max": "1.3"}), "spec.not_a_number", "axes.x.bias_V.max"),
        (spec(bias_V={"max": True}), "spec.not_a_number", "axes.x.bias_V.max"),
        (spec(bias_V={"max": float("nan")}), "spec.not_a_number", "axes.x.bias_V.max"),
        (spec(bias_V={"min": 2, "max": 1}), "spec.crossed", "axes.x.bias_V"),
        (spec(rate={"nonlinearity_pct_fs": {}}), "spec.no_limit", "axes.x.rate.nonlinearity_pct_fs"),
    ],
)
def test_a_specification_is_refused_at_the_key_that_is_wrong(given: object, code: str, path: str) -> None:
    with pytest.raises(Problem) as refused:
        limits(given)
    assert (refused.value.code, refused.value.values["path"]) == (code, path)


def test_a_specification_without_limits_is_refused() -> None:
    with pytest.raises(Problem, match=r"spec\.empty"):
        limits({"axes": {"x": {}}})
