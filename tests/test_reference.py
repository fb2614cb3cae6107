"""The encoders' calibration record: fitted, refused where it cannot be one, and applied to what recordings say."""

import json
from typing import Any

import numpy as np
import pytest

from calib_core.integral_fit import fit
from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.reference import HEADER, AxisCalibration, ReferenceCalibration
from calib_core.sequence import make_plan
from calib_core.session import analyse_state
from server.devices import open_rig
from server.engine import record

STEP_DEG = 300.0 / 1023.0
TRUTH = np.array([0.0, 0.97, 2e-4, 1.5e-6])  # true angle of an encoder reading: 3 % of gain and some bow
AT = np.arange(-120.0, 121.0, 20.0)


def record_of(points: Any, uncertainty: float = 0.1, **more: Any) -> dict[str, Any]:
    axis = {"points": points, "standard_uncertainty_deg": uncertainty}
    return {"date": "2026-11-20", "means": "protractor", "by": "A. Student", "axes": {"x": axis}, **more}


def bowed(seed: int = 1) -> Recording:
    """A hundred seconds of a swing, read by an encoder whose gain and linearity are off."""
    rng = np.random.default_rng(seed)
    t = np.arange(10_000) * 0.01
    true, rate = 30.0 * np.sin(2 * np.pi * 0.2513 * t), 30.0 * 2 * np.pi * 0.2513 * np.cos(2 * np.pi * 0.2513 * t)
    fine = np.linspace(-60.0, 60.0, 20_001)
    read = np.interp(true, np.polynomial.polynomial.polyval(fine, TRUTH), fine)
    columns = {
        "x_gyro_v": 1.25 + 5.9e-3 * rate + 1.2e-3 * rng.standard_normal(len(t)),
        "x_position_deg": np.round(np.rint(read / STEP_DEG) * STEP_DEG, 4),
    }
    return Recording(t, columns, np.zeros(len(t), np.int32), ("estimate_x",), {})


def calibrated(recording: Recording, record: dict[str, Any]) -> Recording:
    header = {**recording.header, HEADER: json.dumps(record)}
    return Recording(recording.time_s, recording.columns, recording.segment_codes, recording.segment_names, header)


def test_a_polynomial_goes_through_what_the_encoder_read_and_what_was_true() -> None:
    points = tuple((e, float(np.polynomial.polynomial.polyval(e, TRUTH)) + 0.3) for e in AT)  # an offset is nothing
    found = AxisCalibration(points, 0.05)
    np.testing.assert_allclose(found.coefficients, TRUTH[1:], rtol=1e-9)
    np.testing.assert_allclose(found.apply(AT), np.polynomial.polynomial.polyval(AT, TRUTH), atol=1e-9)
    assert found.scale == pytest.approx(0.97)


def test_few_pairs_carry_few_terms() -> None:
    assert [AxisCalibration(tuple((e, e) for e in AT[:n]), 0.1).degree for n in (2, 3, 4, 5, 6, 13)] == [
        1,
        1,
        2,
        2,
        3,
        3,
    ]


def test_the_gains_uncertainty_is_the_pairs_over_their_span() -> None:
    two = AxisCalibration(((-100.0, -100.0), (100.0, 100.0)), 0.5)
    assert two.scale_uncertainty == pytest.approx(0.5 * 2**0.5 / 200.0)


def test_the_gains_uncertainty_covers_the_truth() -> None:
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(300):
        true = np.polynomial.polynomial.polyval(AT, TRUTH) + rng.normal(0.0, 0.3, len(AT))
        found = AxisCalibration(tuple(zip(AT.tolist(), true.tolist(), strict=True)), 0.3)
        mean = np.polynomial.polynomial.polyval(np.array([-120.0, 120.0]), TRUTH)
        off = np.ptp(found.apply(np.array([-120.0, 120.0]))) - np.ptp(mean)
        inside += abs(off / 240.0) < 1.96 * found.scale_uncertainty * found.scale
    assert 0.91 < inside / 300 < 0.99


def test_a_calibrated_encoder_gives_the_true_scale_factor_and_an_uncalibrated_one_its_own() -> None:
    recording = bowed()
    points = [[float(e), float(np.polynomial.polynomial.polyval(e, TRUTH))] for e in AT]
    raw, corrected = fit(recording, "x"), fit(calibrated(recording, record_of(points)), "x")
    assert raw.scale_factor == pytest.approx(5.9e-3 * 0.97, rel=0.004)
    assert corrected.scale_factor == pytest.approx(5.9e-3, rel=3e-4)
    assert corrected.chi2 / corrected.rows == pytest.approx(raw.chi2 / raw.rows, abs=0.1)


def test_raw_readings_stay_in_the_recording() -> None:
    recording = calibrated(bowed(), record_of([[-100, -97], [100, 97]]))
    np.testing.assert_array_equal(recording.codes("x")[1], recording.columns["x_position_deg"])
    np.testing.assert_allclose(recording.position("x")[1], 0.97 * recording.columns["x_position_deg"])
    assert recording.digest() == bowed().digest()


def test_the_budget_names_the_encoder_once_it_is_known() -> None:
    plan = make_plan("standard", seed=1, states=["estimate_x"])
    whole = record(plan, open_rig("twin:?seed=2"), board="B-1")
    how = {"profile": "standard", "gyro_model": plan.gyro_model, "estimates": {}}
    before = analyse_state(whole, "estimate_x", **how)
    after = analyse_state(calibrated(whole, record_of([[-120, -120], [120, 120]], 0.5)), "estimate_x", **how)
    rows = {row["name"]: row for row in before["budget"]["scale_factor"]}
    assert rows["encoder_scale"]["excluded"]
    known = {row["name"]: row for row in after["budget"]["scale_factor"]}
    scale = after["scale_factor_V_per_dps"]
    assert known["encoder_scale"]["standard_uncertainty"] == pytest.approx(scale["value"] * 0.5 * 2**0.5 / 240)
    assert scale["standard_uncertainty"] > before["scale_factor_V_per_dps"]["standard_uncertainty"]
    assert scale["value"] == pytest.approx(before["scale_factor_V_per_dps"]["value"], rel=1e-9)


@pytest.mark.parametrize(
    ("record", "code"),
    [
        (record_of([[-100, -97], [100, 97]], date=" "), "reference.words"),
        (record_of([[-100, -97], [100, 97]], means=""), "reference.words"),
        (record_of([[-100, -97], [100, 97]], by="x" * 300), "reference.long"),
        (record_of([[-100, -97], [100, 97]], axes={}), "reference.no_axis"),
        (record_of([[100, 97]]), "reference.points"),
        (record_of([[-100, -97, 3], [100, 97]]), "reference.points"),
        (record_of([[-100, "many"], [100, 97]]), "reference.points"),
        (record_of([[-100, float("nan")], [100, 97]]), "reference.points"),
        (record_of([[-10, -9.7], [10, 9.7]]), "reference.span"),
        (record_of([[-100, 97], [100, -97]]), "reference.scale"),
        (record_of([[-100, -97], [100, 97]], 0.0), "reference.uncertainty"),
    ],
)
def test_what_cannot_be_a_record_is_refused(record: dict[str, Any], code: str) -> None:
    with pytest.raises(Problem) as refused:
        ReferenceCalibration.from_json(record)
    assert refused.value.code == code


def test_a_record_comes_back_as_it_was_and_says_what_it_is() -> None:
    found = ReferenceCalibration.from_json(record_of([[-100, -97.0], [100, 97.0]]))
    assert ReferenceCalibration.from_json(json.loads(json.dumps(found.to_json()))) == found
    assert found.name == "protractor, 2026-11-20, A. Student"
    assert ReferenceCalibration.of({HEADER: json.dumps(found.to_json())}) == found
    assert ReferenceCalibration.of({}) is None
    with pytest.raises(Problem, match=r"reference\.unreadable"):
        ReferenceCalibration.of({HEADER: "{broken"})
