"""Models tried by hand: the same answers as the diagnosis', rows condensed without loss."""

import numpy as np
import pytest

from calib_core.condense import condense
from calib_core.effects import Acts
from calib_core.gap import diagnose, prepare
from calib_core.gap_gram import Bank, Folds, Gram
from calib_core.gap_report import to_json
from calib_core.integral_fit import Design
from calib_core.problem import Problem
from calib_core.whitening import RowNoise, Whitener
from calib_core.workspace import Workspace
from server.bench.gap_campaign import as_recording, true_floor
from server.bench.gap_records import Record, record


@pytest.fixture(scope="module")
def made() -> Record:
    return record(2, {"bias_temperature": 1.0, "scale_factor_asymmetry": 1.0}, plan="second")


@pytest.fixture(scope="module")
def workspace(made: Record) -> Workspace:
    return Workspace.of(as_recording(made), "x")


def test_condensed_rows_are_means_of_their_own(made: Record) -> None:
    design = Design.of(as_recording(made), "x")
    rows, operator = condense(design)
    assert len(rows) < len(design.rows) / 3.5
    np.testing.assert_allclose(operator @ np.ones(len(design.rows)), 1.0)
    # Between means of readings the mean rate is the difference of their mean angles.
    assert design.readings is not None
    turned = (operator @ design.rate) * rows.dt_s
    assert turned[rows.after >= 0].sum() == pytest.approx(float(np.ptp(design.readings.angle_deg[[0, -1]])), abs=1.0)
    # White noise of the samples, summed over neighbouring rows: what one row gives, it takes from the next.
    noise = np.random.default_rng(0).standard_normal((len(design.averages.samples.time_s), 200))
    scatter = (operator @ design.averages.mean(noise)).std(axis=1) / np.sqrt(rows.white_own)
    assert np.median(scatter) == pytest.approx(1.0, abs=0.03)


def test_condensed_rows_know_as_much_of_lateness_and_of_slow_things(made: Record) -> None:
    space = prepare(as_recording(made), "x")
    noise = RowNoise(1.2e-3, 5e-4, 0.2)
    fine = Whitener(space.design.rows, space.scale_factor, noise)
    few = Whitener(space.rows, space.scale_factor, noise)
    c, averages = space.covariates, space.design.averages
    for shape in (c.acceleration_dps2, np.abs(c.rate_dps), c.warmth):
        before = fine.whiten(averages.mean(shape))
        after = few.whiten(space.over_rows(Acts.OUTPUT, shape[:, None]))
        assert float(after[:, 0] @ after[:, 0]) > 0.93 * float(before @ before)


def test_adding_what_is_missing_lowers_the_error_to_the_floor(workspace: Workspace, made: Record) -> None:
    base = workspace.fit()
    both = workspace.fit(["bias_temperature", "scale_factor_asymmetry"])
    assert both.error.held_out_rms_dps < 1.01 * true_floor(made) < base.error.held_out_rms_dps
    assert both.two_delta_lnL > workspace.fit(["bias_temperature"]).two_delta_lnL + 50.0
    found = {p["name"]: p for p in both.parameters}
    scale = found["scale_factor_V_per_dps"]
    assert abs(scale["value"] - made.truth["scale_factor_V_per_dps"]) < 5.0 * scale["standard_uncertainty"]
    assert len(both.middle_s) == len(both.residual_dps) == len(both.spread_dps) == len(both.along["temperature_c"])
    assert max(workspace.gains(both).values()) < 15.0 < 1000.0 < max(workspace.gains(base).values())


def test_the_floor_is_what_the_right_model_leaves_whatever_model_is_tried(workspace: Workspace) -> None:
    """A rest's error is one draw and a slow code's a sawtooth: taken for white noise they were off by a quarter."""
    tried = [workspace.fit(names).error for names in ((), ("bias_temperature", "scale_factor_asymmetry"))]
    assert tried[0].floor_rms_dps == pytest.approx(tried[1].floor_rms_dps, rel=0.1)
    healthy = Workspace.of(as_recording(record(3, {}, plan="first")), "x").fit().error
    # Some hundred windows: the RMS of one record scatters by a twentieth.
    ratios = [error.held_out_rms_dps / error.floor_rms_dps for error in (tried[1], healthy)]
    assert max(ratios) < 1.12
    assert min(ratios) > 0.9


def test_a_size_that_multiplies_the_rate_is_told_per_scale_factor_as_it_is() -> None:
    """Fitted beside a scale factor that had to make up for it, a cubic was told two per cent too large."""
    cubic = Workspace.of(as_recording(record(2, {"scale_factor_cubic": 2.0}, plan="second")), "x")
    told = {p["name"]: p for p in cubic.fit(["scale_factor_cubic"]).parameters}["scale_factor_cubic.k"]
    assert abs(told["value"]) == pytest.approx(2.4e-6, abs=2.0 * told["standard_uncertainty"], rel=0.0)
    assert told["standard_uncertainty"] < 0.012 * 2.4e-6


def test_a_model_tried_by_hand_is_the_one_that_the_diagnosis_makes(workspace: Workspace, made: Record) -> None:
    answer = to_json(diagnose(as_recording(made), "x", effects=["scale_factor_asymmetry"]))
    tried = workspace.fit(["scale_factor_asymmetry"])
    assert tried.error.held_out_rms_dps == pytest.approx(answer["error"]["held_out_rms_dps"], rel=0.05)


def test_parameters_that_are_held_are_not_fitted(workspace: Workspace) -> None:
    free = workspace.fit(["warm_up"])
    held = workspace.fit(["warm_up"], {"warm_up.tau": 30.0, "warm_up.a": 1e-3, "bias_V": 1.25})
    told = {p["name"]: (p["value"], p["standard_uncertainty"]) for p in held.parameters}
    assert told["warm_up.tau"] == (30.0, None)
    assert told["warm_up.a"] == (1e-3, None)
    assert told["bias_V"] == (pytest.approx(1.25, abs=1e-6), None)
    assert held.two_delta_lnL < free.two_delta_lnL


def test_an_effect_without_its_covariate_is_refused(workspace: Workspace) -> None:
    assert "mains_hum" not in workspace.effects
    with pytest.raises(Problem, match="mains_hum"):
        workspace.fit(["mains_hum"])


def test_many_models_are_scored_as_each_would_be() -> None:
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((4000, 6))
    columns[:, 0] += 0.1 * columns[:, 2]
    folds = Folds.of(np.arange(4000) * 0.01)
    gram = Gram(Bank(folds, columns).parts, np.zeros(1))
    scores = gram.scores(np.array([[2], [3]]))
    fold = folds.of_time(np.arange(4000) * 0.01)
    for model, score in zip(([1, 2], [1, 3]), scores, strict=True):
        squares = 0.0
        for k in range(len(folds)):
            seen, unseen = columns[fold != k], columns[fold == k]
            weights = np.linalg.lstsq(seen[:, model], seen[:, 0], rcond=None)[0]
            squares += float(np.sum((unseen[:, 0] - unseen[:, model] @ weights) ** 2))
        assert score == pytest.approx(squares, rel=1e-9)
    assert scores[0] < scores[1]
