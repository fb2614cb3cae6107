"""What the diagnosis says of records whose truth it did not make."""

import json

import numpy as np
import pytest
from shared import shared

from calib_core import gap, recording
from calib_core.effects import library
from calib_core.experiment import propose
from calib_core.gap import Diagnosis, diagnose, named
from calib_core.gap_report import _ties, to_json
from calib_core.recording import Recording
from server.bench import gap_records
from server.bench.gap_campaign import true_floor


def made(seed: int, effects: dict[str, float], **options: object) -> Recording:
    """A record of the independent generator as a Recording."""
    record = gap_records.record(seed, effects, **options)  # type: ignore[arg-type]
    columns = dict(record.columns)
    time_s = columns.pop("time_s")
    names = tuple(dict.fromkeys(record.segments))
    codes = np.array([names.index(name) for name in record.segments], np.int32)
    return Recording(time_s=time_s, columns=columns, segment_codes=codes, segment_names=names, header={})


def told(diagnosis: Diagnosis) -> set[str]:
    """Every name given, and everything declared to be as good."""
    assert diagnosis.search is not None
    names = {t.name for t in named(diagnosis.search)} | {s.term.name for rivals in diagnosis.rivals for s in rivals}
    return names | ({"saturation"} if diagnosis.clip else set())


@pytest.mark.parametrize("plan", ["first", "second"])
def test_a_healthy_record_is_given_nothing(plan: str) -> None:
    diagnosis = diagnose(made(7, {}, plan=plan), "x")
    assert diagnosis.verdict == "adequate"
    assert to_json(diagnosis)["missing"] == []


@pytest.mark.parametrize(
    ("effect", "plan"),
    [
        ("scale_factor_cubic", "first"),
        ("hysteresis", "second"),
        ("bias_temperature", "second"),
        ("encoder_eccentricity", "first"),
        ("backlash", "first"),
        ("dead_band", "first"),
        ("saturation", "first"),
        ("cross_axis", "second"),
    ],
)
def test_a_hidden_effect_is_named_and_the_error_falls_to_the_floor(effect: str, plan: str) -> None:
    truth = gap_records.record(11, {effect: 0.6}, plan=plan)
    diagnosis = diagnose(made(11, {effect: 0.6}, plan=plan), "x")
    answer = to_json(diagnosis)
    assert effect in told(diagnosis)
    assert diagnosis.verdict in ("missing", "ambiguous")
    assert diagnosis.after is not None
    windows, first = diagnosis.after.windows, diagnosis.after.first
    # Samples on a limit are not the record's any more; a reversal in fast motion is known to a sample only, and
    # backlash then leaves a few percent above the floor.
    if effect not in ("saturation", "backlash"):
        noise = windows.mean(truth.gyro_noise_dps[:, None]) - windows.rate(truth.encoder_error_deg[:, None])
        floor = float(np.sqrt(np.mean(noise[first] ** 2)))
        assert answer["after"]["held_out_rms_dps"] < 1.03 * floor
    assert answer["after"]["held_out_rms_dps"] < 0.9 * answer["error"]["held_out_rms_dps"] or effect == "saturation"


def test_lag_and_delay_of_four_milliseconds_are_declared_a_tie() -> None:
    diagnosis = diagnose(made(3, {"bandwidth_lag": 0.5}), "x")
    assert {"bandwidth_lag", "time_offset"} <= told(diagnosis)
    assert diagnosis.verdict == "ambiguous"


def test_an_effect_in_no_library_is_flagged_and_gets_no_name() -> None:
    answer = to_json(diagnose(made(5, {"cogging_7_per_rev": 2.0}), "x"))
    assert answer["verdict"] == "unknown"
    assert answer["unknown"]["covariate"] == "x_position_deg"
    assert answer["missing"] == []


@pytest.mark.parametrize(("effect", "along"), [("cross_axis", "other_rate_dps"), ("temperature_kink", "temperature_c")])
def test_what_has_no_name_does_not_pass_for_noise(effect: str, along: str) -> None:
    pool = {name: suspect for name, suspect in library().items() if name != effect}
    answer = to_json(diagnose(made(8, {effect: 3.0}, ar1_V=3e-4, phi=0.97), "x", suspects=pool))
    assert answer["verdict"] == "unknown"
    assert answer["unknown"]["covariate"] == along


def test_two_effects_are_both_found() -> None:
    diagnosis = diagnose(made(9, {"bias_temperature": 1.0, "scale_factor_asymmetry": 1.0}), "x")
    assert {"bias_temperature", "scale_factor_asymmetry"} <= told(diagnosis)


@pytest.mark.parametrize(
    ("effects", "plan"),
    [
        ({"dead_band": 1.4, "saturation": 1.2}, "second"),
        ({"dead_band": 1.0, "clock_skew": 1.3}, "first"),
    ],
)
def test_a_large_effect_does_not_bend_the_shape_of_another(effects: dict[str, float], plan: str) -> None:
    truth = gap_records.record(23, effects, plan=plan, locked=True)
    diagnosis = diagnose(made(23, effects, plan=plan, locked=True), "x")
    assert told(diagnosis) >= set(effects)
    assert diagnosis.verdict in ("missing", "ambiguous")
    assert diagnosis.after is not None
    assert diagnosis.after.error().held_out_rms_dps < 1.1 * true_floor(truth)


@pytest.mark.parametrize(
    ("seed", "effects", "options"),
    [
        (30009515, {"bias_temperature": 1.335, "bias_step": 1.078}, {}),
        (
            763985777,
            {"bias_drift": 1.306, "bias_temperature": 0.807},
            {"locked": True, "ar1_V": 1.906e-4, "phi": 0.99356},
        ),
    ],
)
def test_of_slow_effects_the_first_to_be_seen_does_not_stand_in_for_two(
    seed: int, effects: dict[str, float], options: dict[str, object]
) -> None:
    diagnosis = diagnose(made(seed, effects, plan="second", **options), "x")
    assert told(diagnosis) >= set(effects)
    assert diagnosis.verdict in ("missing", "ambiguous")
    assert diagnosis.walk is None


def test_a_second_look_at_a_time_constant_begins_settled_too() -> None:
    space = gap.prepare(made(7, {}), "x")
    looks = [space.term(library()["thermal_lag"], (40.0,)).columns for _ in range(2)]
    np.testing.assert_array_equal(*looks)


def test_parameters_are_recovered_within_their_uncertainty() -> None:
    record = gap_records.record(21, {"scale_factor_cubic": 1.0})
    answer = to_json(diagnose(made(21, {"scale_factor_cubic": 1.0}), "x"))
    found = {p["name"]: p for p in answer["after"]["parameters"]}
    for name, truth in (
        ("bias_V", record.truth["bias_V"]),
        ("scale_factor_V_per_dps", record.truth["scale_factor_V_per_dps"]),
    ):
        assert abs(found[name]["value"] - truth) < 5.0 * found[name]["standard_uncertainty"]
    cubic = found["scale_factor_cubic.k"]
    assert abs(abs(cubic["value"]) - 1.2e-6) < 5.0 * cubic["standard_uncertainty"]


@pytest.mark.parametrize("effect", ["bias_random_walk", "adc_quantization"])
def test_what_is_no_shape_is_named_by_its_own_evidence(effect: str) -> None:
    answer = to_json(diagnose(made(31, {effect: 1.0}, plan="second"), "x"))
    assert [m["effect"] for m in answer["missing"]] == [effect]
    size = answer["missing"][0]["parameters"][0]
    truth = {"bias_random_walk": 3e-4, "adc_quantization": 9.77e-3}[effect]
    assert size["value"] == pytest.approx(truth, rel=0.01 if effect == "adc_quantization" else 0.6)
    if effect == "bias_random_walk":
        assert answer["after"]["held_out_rms_dps"] < 0.5 * answer["error"]["held_out_rms_dps"]


def test_beside_a_bias_that_wanders_ties_are_declared_and_a_motion_is_proposed() -> None:
    diagnosis = diagnose(made(31, {"bias_random_walk": 1.0, "bandwidth_lag": 0.5}, plan="second"), "x")
    assert diagnosis.walk is not None
    assert {"bandwidth_lag", "time_offset"} <= told(diagnosis)
    proposal = propose(diagnosis)
    assert proposal is not None
    assert proposal.kind == "rivals"


def test_a_walk_and_shapes_that_serve_as_well_are_told_as_rivals_or_as_sets() -> None:
    alternatives = [[["bias_random_walk"], ["bias_step"]], [["bias_random_walk"], ["bias_drift", "warm_up"]]]
    answer = Diagnosis(made(7, {}), "x", [], alternatives=alternatives)
    assert _ties(answer) == {"rivals": [["bias_random_walk", "bias_step"]], "rival_sets": [alternatives[1]]}


def test_an_asked_effect_is_fitted_with_its_time_constant_too() -> None:
    search = diagnose(made(12, {"warm_up": 1.0}), "x", effects=("warm_up",)).search
    assert search is not None
    (term,) = search.chosen
    shorter, longer = (search.space.term(term.effect, (term.setting[0] * factor,)) for factor in (0.8, 1.25))
    assert search.chi2([term]) < min(search.chi2([shorter]), search.chi2([longer]))


def test_asked_effects_stand_in_the_model_and_are_not_missing() -> None:
    answer = to_json(diagnose(made(11, {"scale_factor_cubic": 0.6}), "x", effects=["scale_factor_cubic"]))
    assert answer["model"]["effects"] == ["scale_factor_cubic"]
    assert answer["verdict"] == "adequate"


@pytest.mark.parametrize(
    "name",
    ["bias_temperature", "scale_factor_cubic", "g_sensitivity", "bandwidth_lag", "hysteresis", "saturation", "two"],
)
def test_the_shared_records_are_named(name: str) -> None:
    path = shared(f"hidden_effects/{name}.csv.gz")
    truths = [json.loads(line) for line in shared("hidden_effects/truth.jsonl").read_text().splitlines()]
    truth = next(t for t in truths if t["id"] == name)
    with path.open("rb") as file:
        diagnosis = diagnose(recording.read(file, name=path.name), truth["axis"])
    assert set(truth["effects"]) <= told(diagnosis)
