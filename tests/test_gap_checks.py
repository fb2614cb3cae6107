"""Bad recordings of every kind are recognised before anything is fitted, and good ones are let through."""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import NDArray
from recordings import recordings
from shared import shared

from calib_core.gap import prepare
from calib_core.gap_checks import Check, checks
from calib_core.recording import Recording, read
from server.bench.gap_records import EFFECTS, record
from server.diagnosis import of_recording, told
from server.texts import render, texts

F64 = NDArray[np.float64]
Bad = Callable[[Recording], Recording]


def recording(effects: Mapping[str, float], seed: int = 5, **options: object) -> Recording:
    made = record(seed, effects, **options)  # type: ignore[arg-type]
    names = tuple(dict.fromkeys(made.segments))
    codes = np.array([names.index(name) for name in made.segments], np.int32)
    columns = dict(made.columns)
    return Recording(columns.pop("time_s"), columns, codes, names)


@pytest.fixture(scope="module")
def good() -> Recording:
    return recording({})


def changed(good: Recording, **columns: F64 | None) -> Recording:
    """With other columns; None leaves one out."""
    both = good.columns | columns
    return replace(good, columns={name: values for name, values in both.items() if values is not None})


def wrong(recording: Recording, axis: str = "x") -> dict[str, Check]:
    """The checks that are not ok, by the last word of their code."""
    return {c.code.rsplit(".", 1)[1]: c for c in checks(recording, axis) if not c.ok}


def noise(good: Recording, level: float = 1.25) -> F64:
    return level + np.random.default_rng(1).normal(0.0, 1.2e-3, len(good))


def test_a_healthy_recording_passes_every_check(good: Recording) -> None:
    names = "length time temperature motion adc_step encoder_step stuck clipping axis sign unit"
    assert [c.name for c in checks(good, "x")] == names.split()
    assert wrong(good) == {}


@pytest.mark.parametrize("name", sorted(EFFECTS.keys() - {"saturation", "adc_quantization"}))
def test_no_effect_however_strong_is_taken_for_a_damage(name: str) -> None:
    assert wrong(recording({name: 5.0}, seed=len(name))) == {}


@pytest.mark.parametrize("options", [{"plan": "second"}, {"locked": True}, {"reference": "rate"}, {"axis": "z"}])
def test_no_motion_and_no_reference_is_taken_for_a_damage(options: dict[str, object]) -> None:
    axis = str(options.get("axis", "x"))
    assert wrong(recording({}, ar1_V=9e-4, phi=0.995, **options), axis) == {}


@pytest.mark.parametrize("name", ["none_white", "none_coloured", "saturation", "unknown", "sine_only_lag"])
def test_worked_recordings_pass(name: str) -> None:
    assert wrong(read(shared(f"hidden_effects/{name}.csv.gz").read_bytes())) == {}


def test_real_recordings_are_told_their_gaps_and_their_missing_temperature() -> None:
    for name, expected in (
        ("fast_rotation_A", {"time_gaps", "no_temperature"}),
        ("fast_rotation_B", {"no_temperature"}),
        ("thermal_chamber", set()),
    ):
        real = read(shared(f"real/{name}.csv").read_bytes())
        for axis in real.axes:
            first = {"spikes"} if (name, axis) == ("thermal_chamber", "x") else set()
            assert set(wrong(real, axis)) == expected | first
            assert not any(c.blocking for c in checks(real, axis))


def test_no_motion_blocks_and_says_how_to_declare_a_still_record(good: Recording) -> None:
    still = changed(good, x_gyro_v=noise(good), x_position_deg=np.zeros(len(good)))
    assert wrong(still)["no_motion"].blocking
    assert wrong(replace(still, header={"reference": "stationary"})) == {}


def test_an_encoder_that_stands_while_the_gyro_turns_is_not_called_a_rest(good: Recording) -> None:
    assert wrong(changed(good, x_position_deg=np.zeros(len(good))))["reference_stands"].blocking


def test_without_temperature_the_rest_is_still_tested(good: Recording) -> None:
    found = wrong(changed(good, temperature_c=None))
    assert set(found) == {"no_temperature"}
    assert not found["no_temperature"].blocking


def test_three_seconds_are_too_short(good: Recording) -> None:
    assert wrong(good.take(slice(0, 300)))["too_short"].blocking


def test_a_channel_that_is_stuck_all_along_or_for_a_second_blocks(good: Recording) -> None:
    output = good.columns["x_gyro_v"]
    assert wrong(changed(good, x_gyro_v=np.full(len(good), 1.25)))["never_changes"].blocking
    for start, stop in ((9000, 9100), (9000, len(good))):
        stuck = output.copy()
        stuck[start:stop] = stuck[start]
        found = wrong(changed(good, x_gyro_v=stuck))
        assert set(found) == {"stuck"}
        assert found["stuck"].blocking
        assert found["stuck"].values["at_s"] == pytest.approx(good.time_s[start], abs=0.05)


def test_a_coarse_converter_that_rests_on_one_code_is_not_stuck_until_the_table_moves(good: Recording) -> None:
    coarse = np.round(good.columns["x_gyro_v"] / 9.77e-3) * 9.77e-3
    found = wrong(changed(good, x_gyro_v=coarse))
    assert set(found) == {"adc_coarse"}
    assert found["adc_coarse"].values["step"] == pytest.approx(9.77e-3, rel=1e-6)
    assert not found["adc_coarse"].blocking
    coarse[9000:] = coarse[9000]
    assert wrong(changed(good, x_gyro_v=coarse))["stuck"].blocking


@pytest.mark.parametrize(("step", "found"), [(4.1e-3, True), (2.5e-3, True), (1.2e-3, False), (1e-6, False)])
def test_a_step_is_coarse_above_4_mV_or_beside_little_noise(good: Recording, step: float, found: bool) -> None:
    rng = np.random.default_rng(2)
    smooth = good.columns["x_gyro_v"] + rng.uniform(-0.5, 0.5, len(good)) * 5.0 / 4096.0
    assert ("adc_coarse" in wrong(changed(good, x_gyro_v=np.round(smooth / step) * step))) == found


@pytest.mark.parametrize(("limit", "blocks"), [(98.0, False), (60.0, False), (20.0, True), (5.0, True)])
def test_a_clipped_channel_is_told_and_blocks_when_little_is_left(good: Recording, limit: float, blocks: bool) -> None:
    clipped = np.clip(good.columns["x_gyro_v"], 1.25 - 0.006 * limit, 1.25 + 0.006 * limit)
    (found,) = wrong(changed(good, x_gyro_v=clipped)).values()
    assert (found.name, found.blocking) == ("clipping", blocks)
    assert found.values["levels"] == pytest.approx([1.25 - 0.006 * limit, 1.25 + 0.006 * limit])


def test_exchanged_axes_are_recognised_in_either_column(good: Recording) -> None:
    x, z = good.columns["x_position_deg"], good.columns["z_position_deg"]
    assert wrong(changed(good, x_position_deg=z, z_position_deg=x))["axes_swapped"].blocking
    renamed = changed(good, x_gyro_v=noise(good), z_gyro_v=good.columns["x_gyro_v"])
    assert wrong(renamed, "z")["axes_swapped"].values["other"] == "x"
    assert wrong(renamed, "x")["does_not_answer"].blocking


def test_a_floating_input_does_not_answer(good: Recording) -> None:
    assert wrong(changed(good, x_gyro_v=noise(good, 1.4)))["does_not_answer"].blocking


def test_a_reversed_sign_blocks(good: Recording) -> None:
    for flipped in ({"x_gyro_v": 2.5 - good.columns["x_gyro_v"]}, {"x_position_deg": -good.columns["x_position_deg"]}):
        assert set(wrong(changed(good, **flipped))) == {"reversed"}


@pytest.mark.parametrize("factor", [1e3, 1e-3])
@pytest.mark.parametrize("column", ["x_gyro_v", "x_gyro_dps", "x_gyro_counts", "x_position_deg", "time_s"])
def test_a_unit_wrong_by_1000_blocks(good: Recording, column: str, factor: float) -> None:
    rate = (good.columns["x_gyro_v"] - 1.25) / 0.006
    given = {
        "x_gyro_v": {},
        "x_gyro_dps": {"x_gyro_v": None, "x_gyro_dps": rate},
        "x_gyro_counts": {"x_gyro_v": None, "x_gyro_counts": np.round(rate * 14.375)},
    }
    whole = changed(good, **given.get(column, {}))
    assert not any(c.blocking for c in checks(whole, "x"))
    if column == "time_s":
        bad = replace(whole, time_s=whole.time_s * factor)
    else:
        bad = changed(whole, **{column: whole.columns[column] * factor})
    assert any(c.blocking for c in checks(bad, "x"))


def test_radians_and_impossible_temperatures_block(good: Recording) -> None:
    assert "unit_implausible" in wrong(changed(good, x_position_deg=np.radians(good.columns["x_position_deg"])))
    assert wrong(changed(good, temperature_c=1e3 * good.columns["temperature_c"]))["covariate_impossible"].blocking


@pytest.mark.parametrize("at", [3000, 9000, 12345])
def test_time_that_jumps_while_the_table_turns_on_blocks(good: Recording, at: int) -> None:
    jumped = replace(good, time_s=good.time_s + 0.5 * (np.arange(len(good)) >= at))
    assert wrong(jumped)["time_jumps"].values["at_s"] == pytest.approx(good.time_s[at - 1])


def test_samples_that_are_lost_are_told_and_not_fatal(good: Recording) -> None:
    found = wrong(good.take((good.time_s < 90.0) | (good.time_s > 95.0)))
    assert set(found) == {"time_gaps"}
    assert not found["time_gaps"].blocking
    rng = np.random.default_rng(4)
    assert wrong(good.take(np.repeat(rng.random(len(good) // 4) < 0.6, 4)))["time_in_pieces"].blocking


def test_time_that_repeats_or_runs_on_two_clocks_blocks(good: Recording) -> None:
    time = good.time_s.copy()
    time[5000] = time[4999]
    assert wrong(replace(good, time_s=time))["time_repeats"].blocking
    own = good.time_s + 1.0 * (np.arange(len(good)) > 9000)
    assert wrong(changed(good, x_position_time_s=own))["time_two_clocks"].blocking


def test_a_missing_axis_and_a_missing_reference_block(good: Recording) -> None:
    assert wrong(good, "y")["no_gyro"].blocking
    assert wrong(changed(good, x_position_deg=None))["no_reference"].blocking


@pytest.mark.parametrize("at", [0, 1, 700, -1])
def test_a_single_sample_far_out_of_line_is_told_and_left_out(good: Recording, at: int) -> None:
    still = {"x_gyro_v": noise(good), "x_position_deg": None}
    level = replace(changed(good, **still), header={"reference": "stationary"}).take(slice(0, 1200))
    assert wrong(level) == {}
    spoilt = level.columns["x_gyro_v"].copy()
    spoilt[at] += 0.5
    odd = changed(level, x_gyro_v=spoilt)
    assert wrong(odd)["spikes"].values["at_s"] == level.time_s[at]
    assert not wrong(odd)["spikes"].blocking
    assert np.setdiff1d(np.arange(1200), prepare(odd, "x").design.averages.samples.index).tolist() == [at % 1200]


@pytest.fixture(scope="module")
def short(good: Recording) -> Recording:
    """26 s of rest and one sine."""
    return good.take(slice(0, 2600))


def _late(short: Recording, seconds: float) -> Recording:
    return replace(short, time_s=short.time_s + seconds * (np.arange(len(short)) >= 1300))


def _held(short: Recording, value: float) -> F64:
    return np.where(np.arange(len(short)) // 400 == 2, value, short.columns["x_gyro_v"])


def _scaled(name: str) -> Bad:
    return lambda s: changed(s, **{name: 1e3 * s.columns[name]})


BAD: Mapping[str, tuple[Bad, str]] = {
    "nothing moves": (lambda s: changed(s, x_gyro_v=noise(s), x_position_deg=np.zeros(len(s))), "no_motion"),
    "the encoder stands": (lambda s: changed(s, x_position_deg=np.zeros(len(s))), "reference_stands"),
    "no encoder": (lambda s: changed(s, x_position_deg=np.full(len(s), np.nan)), "no_reference"),
    "no temperature": (lambda s: changed(s, temperature_c=None), "no_temperature"),
    "3 s": (lambda s: s.take(slice(0, 300)), "too_short"),
    "stuck": (lambda s: changed(s, x_gyro_v=np.full(len(s), 1.25)), "never_changes"),
    "stuck for 4 s": (lambda s: changed(s, x_gyro_v=_held(s, s.columns["x_gyro_v"][800])), "stuck"),
    "clipped": (lambda s: changed(s, x_gyro_v=np.clip(s.columns["x_gyro_v"], 1.2, 1.3)), "railed"),
    "other axis": (
        lambda s: changed(s, x_position_deg=s.columns["z_position_deg"], z_position_deg=s.columns["x_position_deg"]),
        "axes_swapped",
    ),
    "other sign": (lambda s: changed(s, x_gyro_v=2.5 - s.columns["x_gyro_v"]), "reversed"),
    "an open input": (lambda s: changed(s, x_gyro_v=noise(s, 1.4)), "does_not_answer"),
    "mV for V": (_scaled("x_gyro_v"), "out_of_range"),
    "millidegrees": (_scaled("x_position_deg"), "unit_implausible"),
    "milliseconds": (lambda s: replace(s, time_s=1e3 * s.time_s), "unit_implausible"),
    "m°C for °C": (_scaled("temperature_c"), "covariate_impossible"),
    "5 s more on the clock": (lambda s: _late(s, 5.0), "time_gaps"),
    "5 s less on the clock": (lambda s: _late(s, -5.0), "time_repeats"),
    "samples that are lost": (lambda s: changed(s, x_gyro_v=_held(s, np.nan)), "time_gaps"),
}  # fmt: skip
TOLD = ("no_temperature", "time_gaps")
"""These are told, and what can be known is."""


@pytest.mark.parametrize("name", BAD)
def test_a_bad_recording_gets_a_sentence_and_no_name(short: Recording, name: str) -> None:
    bad, expected = BAD[name]
    answer = told(of_recording(bad(short), axis="x"), "en")
    wrong = {check["code"].rsplit(".", 1)[1]: check["sentence"] for check in answer["checks"] if not check["ok"]}
    assert len(wrong[expected]) > 20
    assert answer["missing"] == []
    assert answer["verdict"] == ("adequate" if expected in TOLD else "not_testable")
    assert answer["sentence"] in wrong.values() or expected in TOLD


@given(recordings())
@settings(max_examples=40, deadline=None)
def test_no_recording_however_odd_breaks_the_checks(odd: Recording) -> None:
    for axis in "xyz":
        assert checks(odd, axis)


def test_every_check_has_its_sentence_in_both_languages(good: Recording) -> None:
    for lang in ("en", "th"):
        for check in [*checks(good, "x"), *wrong(changed(good, x_gyro_v=2.5 - good.columns["x_gyro_v"])).values()]:
            assert check.code in texts(lang)
            assert not re.search(r"[{}]", render(check.code, check.values, lang))
