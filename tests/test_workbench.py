"""The workbench's arithmetic and its messages: fits in time, what terms buy, suspects, ties, formulas, examples."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib_core.gyro_models import PRESETS
from calib_core.pictures import decimated, spectrum
from calib_core.problem import Problem
from calib_core.workbench import Workbench
from server import examples, workbench
from server.devices import open_rig
from server.live import decode
from server.store import Store

FULL = (None, None)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """A store with an example, a record of over 22 000 samples, and a short one that clips."""
    data = tmp_path_factory.mktemp("data")
    swing, stairs = examples.SLOW, examples.STAIRS
    full_scale = examples.EXAMPLES["full_scale"]
    made = {
        "long": replace(full_scale, motion=(swing, stairs, examples.QUICK, swing, stairs)),
        "clipped": replace(full_scale, seed=21, effects="saturation.V_hi:1.62", motion=(stairs,)),
    }
    with Store(data) as store:
        ids = {name: store.recordings.add(examples.record(one), board="", name=name) for name, one in made.items()}
        ids["one_sine"] = examples.made(store, "one_sine")
    return data, ids


def fit(stored: tuple[Path, dict[str, str]], name: str, *effects: str, formulas: tuple[Any, ...] = ()) -> Any:
    data, ids = stored
    return decode(workbench.fit(data, ids[name], "x", effects, formulas, FULL, 4000, "", "en"))


def test_a_picture_and_an_effect_take_the_server_a_part_of_a_third_of_a_second_on_22_000_samples(
    stored: tuple[Path, dict[str, str]],
) -> None:
    head, columns = fit(stored, "long")
    assert head["samples"] >= 22_000
    assert len(columns["time_s"]) <= 4000
    took = {}
    for effect in ("scale_factor_cubic", "dead_band", "bias_step"):
        began = time.process_time()
        fit(stored, "long", effect)
        took[effect] = time.process_time() - began
    assert max(took.values()) < 0.15, took
    data, ids = stored
    began = time.process_time()
    workbench.signal(data, ids["long"], "x", "", 4000)
    assert time.process_time() - began < 0.25, "the first picture"


def test_the_truth_buys_the_error_and_what_is_useless_buys_nothing(stored: tuple[Path, dict[str, str]]) -> None:
    head, _ = fit(stored, "one_sine", "bandwidth_lag", "warm_up")
    base, lag, useless = head["steps"]
    assert lag < 0.3 * base
    assert useless > 0.997 * lag
    assert head["error"]["held_out"] == useless
    tau = next(p for p in head["parameters"] if p["name"] == "bandwidth_lag.tau")
    assert abs(tau["value"] - 5e-3) < 4.0 * tau["standard_uncertainty"]


def test_clipped_samples_leave_the_model_with_saturation_and_the_error_with_them(
    stored: tuple[Path, dict[str, str]],
) -> None:
    before, _ = fit(stored, "clipped")
    after, _ = fit(stored, "clipped", "saturation")
    assert after["error"]["held_out"] < 0.1 * before["error"]["held_out"]
    assert after["error"]["held_out"] == pytest.approx(after["error"]["floor"], rel=0.05)
    limit = next(p for p in after["parameters"] if p["name"] == "saturation.V_hi")
    assert limit["value"] == pytest.approx(1.62, abs=2e-3)


def test_a_top_speed_that_is_often_reached_is_no_limit() -> None:
    steps = replace(examples.EXAMPLES["full_scale"], motion=(examples.STAIRS,))
    bench = Workbench(examples.record(steps), "x")
    assert bench.fit(["saturation"]).clip is None
    error = bench.fit(["scale_factor_cubic"]).fitted.error
    assert error.held_out_rms_dps == pytest.approx(error.floor_rms_dps, rel=0.05)


def test_the_modelled_signal_is_the_measured_one_within_the_noise(stored: tuple[Path, dict[str, str]]) -> None:
    _, columns = fit(stored, "one_sine", "bandwidth_lag")
    left = columns["measured"] - columns["modelled"]
    assert np.median(np.abs(left)) < 3e-3
    assert np.ptp(columns["measured"]) > 0.5


def test_failing_stretches_come_with_their_pictures_and_are_gone_with_the_cause(
    stored: tuple[Path, dict[str, str]],
) -> None:
    head, columns = fit(stored, "one_sine")
    assert any(failure["covariate"] == "x_acceleration_dps2" for failure in head["failures"])
    assert all(failure["sentence"].startswith("The model reads") for failure in head["failures"])
    for along in head["along"]:
        name = along["covariate"]
        assert len(columns[f"{name}/at"]) == len(columns["residual"])
        assert np.all(np.diff(columns[f"{name}/at"]) >= 0.0)
        assert len(columns[f"{name}/middle"]) == len(columns[f"{name}/sigma"]) > 3 or name.startswith("other")
    better, _ = fit(stored, "one_sine", "bandwidth_lag")
    assert len(better["failures"]) < len(head["failures"])


def test_a_stretch_is_shown_with_every_sample(stored: tuple[Path, dict[str, str]]) -> None:
    data, ids = stored
    head, columns = decode(workbench.fit(data, ids["long"], "x", (), (), (20.0, 25.0), 1000, "", "en"))
    assert head["whole"]
    assert (columns["time_s"][0], columns["time_s"][-1]) == pytest.approx((20.0, 25.0), abs=0.011)
    assert len(columns["time_s"]) in range(499, 503)


def test_rivals_share_a_tie_and_what_cannot_be_tested_says_so(stored: tuple[Path, dict[str, str]]) -> None:
    data, ids = stored
    answer = workbench.suspects(data, ids["one_sine"], "x", (), "", "en")
    rows = {row["effect"]: row for row in answer["suspects"]}
    assert len(rows) == 27
    assert answer["verdict"] == "ambiguous"
    tied = {name for name, row in rows.items() if row["tie"] is not None}
    assert {"bandwidth_lag", "time_offset"} <= tied
    assert answer["suspects"][0]["effect"] in tied
    assert rows["bias_temperature"]["word"] == "no_data"
    assert not rows["bias_temperature"]["can_be_added"]
    beside = {
        row["effect"]: row
        for row in workbench.suspects(data, ids["one_sine"], "x", ("bandwidth_lag",), "", "en")["suspects"]
    }
    assert beside["bandwidth_lag"]["word"] == "in_model"
    assert beside["time_offset"]["word"] in ("nothing", "spanned")
    # Whatever were asked of a bar, beside a large effect a little more is its form, and no finding.
    bench = workbench.warm(data, ids["one_sine"], "x")
    assert workbench._beside(bench, ("bandwidth_lag",), rows, 0.5) == []
    little = [row for row in rows.values() if row.get("word") == "form"]
    assert little
    assert {workbench._evidence(row | {"in_model": False}, 0.5, 20)["word"] for row in little} == {"form"}


def test_a_formula_of_ones_own_is_an_effect_like_any_other(stored: tuple[Path, dict[str, str]]) -> None:
    own = {"name": "mine", "formula": "rate_dps**2", "parameter": "k", "unit": "", "acts": "output"}
    head, _ = fit(stored, "one_sine", "mine", formulas=(own,))
    library, _ = fit(stored, "one_sine", "scale_factor_quadratic")
    assert head["error"]["held_out"] == pytest.approx(library["error"]["held_out"], rel=1e-3)
    other, _ = fit(stored, "one_sine", "mine", formulas=({**own, "formula": "acceleration_dps2"},))
    assert other["error"]["held_out"] < 0.5 * head["error"]["held_out"]
    with pytest.raises(Problem, match=r"formula\.unknown_name"):
        fit(stored, "one_sine", "mine", formulas=({**own, "formula": "speed"},))
    with pytest.raises(Problem, match=r"diagnosis\.effect_not_possible"):
        fit(stored, "one_sine", "bias_temperature")


def test_an_example_is_the_same_each_time_and_kept_once(stored: tuple[Path, dict[str, str]]) -> None:
    data, ids = stored
    with Store(data) as store:
        assert examples.made(store, "one_sine") == ids["one_sine"]
        first = store.recording(ids["one_sine"])
    assert first.digest() == examples.record(examples.EXAMPLES["one_sine"]).digest()
    assert len(examples.EXAMPLES) == 6


def test_an_example_board_is_the_same_gyro_on_any_simulated_rig() -> None:
    rig = open_rig("twin:?seed=5")
    example = examples.EXAMPLES["reversals"]
    rig.mount(example.board, PRESETS["LPY503AL-OUT"])
    models = rig.table.plant.models
    assert models["x"].bias == example.truth()["x"].bias
    assert [effect.name for effect in models["x"].effects] == ["hysteresis"]
    rig.mount("LPY-1", PRESETS["LPY503AL-OUT"])
    assert not rig.table.plant.models["x"].effects


def test_the_thesis_own_readings_are_tried_like_a_recording(stored: tuple[Path, dict[str, str]]) -> None:
    data, _ = stored
    with Store(data) as store:
        made = examples.made(store, "thesis_rate")
    head, _ = decode(workbench.signal(data, made, "x", "", 4000))
    board = head["board"]
    assert (head["points"], head["unit"], len(head["axes"])) == ("rate", "deg/s", 4)
    answer = decode(
        workbench.fit(data, made, "x", ("scale_factor_cubic", "scale_factor_asymmetry"), (), FULL, 4000, board, "en")
    )
    base, cubic, both = answer[0]["steps"]
    assert cubic < 0.9 * base
    assert both > 0.95 * cubic
    assert len(answer[1]["residual"]) == answer[0]["samples"] == 168
    rows = {row["effect"]: row for row in workbench.suspects(data, made, "x", (), board, "en")["suspects"]}
    assert rows["scale_factor_cubic"]["word"] in ("certain", "likely")
    assert rows["bias_drift"]["word"] == "no_data"


def test_decimation_keeps_every_extreme() -> None:
    values = np.sin(np.arange(10_000) / 7.0)
    values[[1234, 8765]] = 9.0, -9.0
    kept = decimated(values, 400)
    assert len(kept) <= 400
    assert {1234, 8765} <= set(kept.tolist())
    assert np.all(np.diff(kept) > 0)


def test_a_line_and_white_noise_stand_in_the_spectrum_as_they_are() -> None:
    rng = np.random.default_rng(3)
    time_s = np.arange(20_000) / 100.0
    f, density = spectrum(0.02 * rng.standard_normal(20_000) + 0.05 * np.sin(2 * np.pi * 12.5 * time_s), 0.01)
    assert f[density.argmax()] == pytest.approx(12.5, abs=0.1)
    away = np.abs(f - 12.5) > 1.0
    assert np.sqrt(np.mean(density[away] ** 2)) == pytest.approx(0.02 * np.sqrt(0.02), rel=0.03)


def test_a_recording_without_the_axis_is_refused(stored: tuple[Path, dict[str, str]]) -> None:
    data, ids = stored
    with pytest.raises(Problem, match=r"diagnosis\.no_axis"):
        workbench.fit(data, ids["one_sine"], "y", (), (), FULL, 4000, "", "en")
