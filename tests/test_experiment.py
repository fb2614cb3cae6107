"""The motion that would decide: known cases come out as physics has them, and what is expected is what comes."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib_core import experiment
from calib_core.effects import library
from calib_core.excitation import Excitation, commanded, plan_of, steps
from calib_core.experiment import DECIDES, Offer, Proposal, excite, join, separate
from calib_core.gap import _search
from calib_core.gap_space import Term
from calib_core.problem import Problem
from calib_core.prospect import Hand, _followed, clipping, imagine
from calib_core.recording import Recording, read, write_csv
from calib_core.sequence import Axis
from calib_core.twin import Plant
from server import cli
from server.devices import open_rig
from server.engine import record
from server.experiments import perform

SINE = (Excitation("x", "sine", 59.7, (30.0,), (0.2513,)), Excitation("x", "hold", 5.0))
LIBRARY = library()


def measured(effects: str, motion: Sequence[Excitation] = SINE, *, seed: int = 3, warming: float = 0.0) -> Recording:
    rig = open_rig(f"twin:?seed={seed}&covariates=1&warming={warming}&effects={effects}")
    rig.open()
    return record(plan_of(motion, experiment="hand", axis="x"), rig, board="B")


def hand_of(recording: Recording, *truth: tuple[Any, ...]) -> Hand:
    """The data in hand, with the noise as it is beside ``truth`` (name, setting …): no effect may pose as noise."""
    space, _ = _search(recording, "x", LIBRARY, (), np.random.default_rng(0))
    space.refit_noise([space.term(LIBRARY[name], setting) for name, *setting in truth])
    return Hand(recording, space)


def term(hand: Hand, name: str, *setting: float) -> Term:
    return hand.space.term(LIBRARY[name], setting)


def kinds(proposal: Proposal) -> list[str]:
    return [e.kind for e in proposal.motion]


def brought(proposal: Proposal, *wanted: str) -> float:
    """The most that a motion of these kinds would bring."""
    return max(o.expected for o in proposal.offered if tuple(e.kind for e in o.motion) == wanted)


@pytest.fixture(scope="module")
def late() -> Hand:
    return hand_of(measured("bandwidth_lag.tau:0.004"), ("bandwidth_lag", 0.004))


def test_lag_and_delay_take_several_frequencies_at_once(late: Hand) -> None:
    tau = 0.004
    proposal = separate(late, [term(late, "bandwidth_lag", tau), term(late, "time_offset", tau)])
    assert proposal.in_hand < 1.0, "from one sine it is a coin toss"
    assert kinds(proposal) == ["multisine"]
    assert proposal.decides
    assert max(proposal.motion[0].frequency_hz) > 4.0
    assert brought(proposal, "sine") < 6.0, "a single frequency never separates them"
    assert brought(proposal, "hold") < 1.0
    assert proposal.to_json()["code"] == "experiment.rivals"


def test_a_motion_that_brings_too_little_may_last_longer_but_not_for_ever(
    late: Hand, monkeypatch: pytest.MonkeyPatch
) -> None:
    def of(tau: float) -> Proposal:
        monkeypatch.setattr(experiment, "sizes_in", lambda *_: np.array([tau]))
        return separate(late, [term(late, "bandwidth_lag", tau), term(late, "time_offset", tau)])

    weak, tiny = of(0.0026), of(0.0005)
    assert 100.0 < weak.offer.duration_s < 450.0
    assert weak.decides
    assert not tiny.decides
    assert tiny.to_json()["code"] == "experiment.none_decides"


def test_quadratic_and_asymmetry_take_a_staircase_to_the_top_speed() -> None:
    hand = hand_of(measured("scale_factor_quadratic.k:3e-5"), ("scale_factor_quadratic",))
    proposal = separate(hand, [term(hand, "scale_factor_quadratic"), term(hand, "scale_factor_asymmetry")])
    assert kinds(proposal) == ["staircase"]
    assert max(proposal.motion[0].rates_dps) > 110.0
    assert proposal.decides
    slow = {"x": Axis("x", -150.0, 150.0, 40.0, 0.2933), "z": Axis("z", -150.0, 150.0, 40.0, 0.2933)}
    terms = [term(hand, "scale_factor_quadratic"), term(hand, "scale_factor_asymmetry")]
    assert separate(hand, terms, slow).expected < 0.5 * proposal.expected, "a slow rig can do less"


def test_cubic_and_saturation_take_a_staircase_to_the_top_speed() -> None:
    hand = hand_of(
        measured("scale_factor_cubic.k:-4e-6", (Excitation("x", "staircase", 60.0, rates_dps=(50.0, 90.0)),)),
        ("scale_factor_cubic",),
    )
    bias, scale = hand.space.values[:2]
    limits = (bias - 89.0 * scale, bias + 89.0 * scale)
    proposal = separate(hand, [term(hand, "scale_factor_cubic"), clipping(hand.space, limits)])
    assert kinds(proposal) == ["staircase"]
    assert proposal.decides


def test_temperature_and_drift_take_heat_and_some_ties_no_motion_breaks() -> None:
    hand = hand_of(measured("bias_drift.r:2e-5", warming=2.0), ("bias_drift",))
    rivals = [term(hand, "bias_temperature", 1.0), term(hand, "bias_drift"), term(hand, "warm_up", 1500.0)]
    proposal = separate(hand, rivals)
    assert proposal.in_hand < 6.0
    assert "heat" in kinds(proposal)
    assert proposal.decides
    assert proposal.remain == (("bias_drift", "warm_up"),), "a warm-up slow enough is a drift, whatever is done"


def test_gravity_that_was_never_excited_takes_poses_or_a_slow_tilt() -> None:
    hand = hand_of(measured("", (Excitation("x", "hold", 20.0), Excitation("x", "sine", 20.0, (8.0,), (1.0137,)))))
    proposal = excite(hand, [LIBRARY["g_sensitivity"]])
    assert proposal is not None
    assert proposal.separates == ("g_sensitivity",)
    assert proposal.decides
    assert kinds(proposal) in (["poses"], ["sine"])
    swept = max(np.ptp(path) for path in commanded(steps(proposal.motion, "1"), 10.0).values())
    assert swept > 200.0
    assert excite(hand, [LIBRARY["saturation"]]) is None, "no motion within the sensor's range shows its limit"


def test_other_axis_moves_where_cross_axis_is_the_question(late: Hand) -> None:
    proposal = excite(late, [LIBRARY["cross_axis"]])
    assert proposal is not None
    assert [e.axis for e in proposal.motion] == ["z"]
    assert proposal.decides


def test_what_is_expected_is_what_comes() -> None:
    """2ΔlnL of the joined record scatters about the expectation by twice its root."""
    rig = open_rig("twin:?seed=8&covariates=1&effects=time_offset.delay:0.004")
    rig.open()
    hand = record(plan_of(SINE, experiment="hand", axis="x"), rig, board="B")
    found = hand_of(hand, ("time_offset", 0.004))
    rivals = [term(found, "bandwidth_lag", 0.004), term(found, "time_offset", 0.004)]
    proposal = separate(found, rivals, rig.axes)
    both = perform(hand, "x", [e.to_json() for e in proposal.motion], rig)
    space, search = _search(both, "x", LIBRARY, (), np.random.default_rng(0))
    space.refit_noise([space.term(LIBRARY["time_offset"], (0.004,))])
    chi2 = {n: search.refined(space.term(LIBRARY[n]), [])[1] for n in ("bandwidth_lag", "time_offset")}
    came = chi2["bandwidth_lag"] - chi2["time_offset"]
    assert came == pytest.approx(proposal.expected, abs=3.0 * 2.0 * proposal.expected**0.5)
    assert (np.diff(both.time_s) > 0.0).all()
    assert any(name.startswith("experiment/1/") for name in both.segment_names)


def test_the_imagined_path_is_the_one_that_the_twins_servo_takes() -> None:
    motion = [Excitation("x", "staircase", 20.0, rates_dps=(50.0,)), Excitation("x", "sine", 10.0, (20.0,), (0.5039,))]
    plan = steps(motion, "1")
    path = _followed(commanded(plan, 1000.0)["x"])[::10]
    rig = open_rig("twin:?seed=2")
    rig.open()
    time, angle = record(plan_of(motion, experiment="1", axis="x"), rig).position("x")
    began = sum(step.duration_s for step in plan_of(motion, experiment="1", axis="x").states[0].steps[:2]) + 0.1
    there = np.interp(began + np.arange(len(path)) / 100.0, time, angle)
    assert np.sqrt(np.mean((there - path) ** 2)) < 1.5


def test_a_motion_without_turning_still_knows_the_scale_factor(late: Hand) -> None:
    prospect = imagine(late, [Excitation("x", "hold", 20.0)], late.space.values)
    assert prospect.base.shape[1] == 2
    assert prospect.scale_factor == late.space.scale_factor
    assert prospect.covariates.time_s[0] > late.end_s


def test_records_of_other_boards_or_instruments_are_not_joined() -> None:
    hand, run = measured("", SINE[1:], seed=1), measured("", SINE[1:], seed=1)
    both = join(hand, run, "x", 5.0)
    assert both.time_s[len(hand)] - both.time_s[len(hand) - 1] == pytest.approx(5.0)
    for header in ({"board": "C"}, {"gyro_average_s": "0"}, {"x_gyro_delay_s": "0.002"}):
        with pytest.raises(Problem, match=r"experiment\.other_record"):
            join(hand, replace(run, header={**run.header, **header}), "x")


def test_of_motions_that_decide_as_much_the_one_that_takes_least_is_offered() -> None:
    def offer(seconds: float, evidence: float, *more: str) -> Offer:
        return Offer(tuple(Excitation("x", kind, seconds) for kind in ("hold", *more)), (evidence,))

    long, short, weak = offer(300.0, 1000.0), offer(100.0, 800.0), offer(50.0, DECIDES + 1.0)
    assert experiment._cheapest([long, short, weak]) is short
    assert experiment._cheapest([weak, offer(50.0, 1e4, "heat"), short]) is short
    assert experiment._cheapest([offer(10.0, 3.0), offer(100.0, 9.0)]).expected == 9.0


def test_the_twin_hides_effects_of_the_table_in_its_encoder() -> None:
    plain = measured("", SINE[:1])
    bent = measured("encoder_nonlinearity.k2:0.002", SINE[:1])
    (time, straight), (_, curved) = plain.position("x"), bent.position("x")
    assert np.abs(straight - curved).max() == pytest.approx(0.002 * 30.0**2, abs=0.6)
    assert len(time) > 5000


def test_the_twins_heater_warms_the_board_and_is_off_after_the_run() -> None:
    rig = open_rig("twin:?seed=1&covariates=1")
    rig.open()
    motion = [Excitation("x", "hold", 5.0), Excitation("x", "heat", 60.0)]
    recording = record(plan_of(motion, experiment="1", axis="x"), rig)
    warm = recording.columns["temperature_c"]
    assert warm[-200:].mean() - warm[:500].mean() == pytest.approx(9.0, abs=0.6)
    plant: Plant = rig.table.plant  # type: ignore[attr-defined]
    assert plant._heater[2] == 0.0


def test_the_command_proposes_within_the_limits_of_the_rig_it_is_given(
    late: Hand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Running it, joining and judging again is tested over HTTP (test_experiment_api.py)."""
    file, both = tmp_path / "sine.csv", tmp_path / "both.csv.gz"
    with file.open("wb") as opened:
        write_csv(late.recording, opened)
    words = ["diagnose", str(file), "--json", "--rig", "twin:?seed=3", "--experiments", "0", "--out", str(both)]
    assert cli.main(words) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["verdict"], said["experiments"]) == ("ambiguous", [])
    assert said["next_experiment"]["motion"][0]["kind"] == "multisine"
    assert "swing x at 1.0137" in said["next_experiment"]["sentence"]
    with both.open("rb") as opened:
        assert read(opened, name=both.name).digest() == late.recording.digest()
    assert cli.main(["diagnose", str(file), "--out", str(both)]) == 2
    assert cli.main(["diagnose", str(file), str(file), "--rig", "twin:"]) == 2
