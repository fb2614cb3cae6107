"""The benchmark of the diagnosis, a record of each kind; the generator against what it says it hides."""

import math
from pathlib import Path

import numpy as np
import pytest
from shared import shared

from calib_core.gap import diagnose
from calib_core.problem import Problem
from server.bench import gap, gap_campaign, gap_cost, gap_peers, gap_real
from server.bench.gap_campaign import INSIDE, ON_THE_TABLE, Case, Outcome, one_effect
from server.bench.gap_oracle import evidence, whitened
from server.bench.gap_records import EFFECTS, record


def test_a_record_of_the_campaign_is_diagnosed_rightly() -> None:
    """Two effects, ties and the rest are in test_gap."""
    shares = [row for row in gap.part("one", 1, 1) if row.unit == "%" and row.limit is not None]
    assert len(shares) == 2
    assert [f"{row.name}: {row.ours}" for row in shares if not row.ok] == []


def test_cost_and_peers_have_their_rows() -> None:
    rows = [*gap_cost.run(quick=True), *gap_peers.run(quick=True)]
    assert len(rows) == 4
    assert all(np.isfinite(row.figure) for row in rows)


def test_a_campaign_goes_on_where_it_was_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    played: list[Case] = []

    def found(case: Case) -> Outcome:
        played.append(case)
        return Outcome(case, "missing", tuple(case.effects), frozenset(), "", 1.0, 1.0, 0.1)

    monkeypatch.setattr(gap_campaign, "play", found)
    kept = tmp_path / "kept.jsonl"
    for count in (1, 1, 2):
        (row, *_) = gap.part("two", 5, count, kept)
    assert len(played) == len({str(case) for case in played}) == 2
    assert (row.figure, row.ours.split(",")[0]) == (100.0, "2/2")
    assert "34.2 to 100.0 %" in row.ours
    assert all(str(case.seed) in row.ours for case in played)
    kept.write_text(kept.read_text().replace(gap_campaign.code(), "other code"))
    (row, *_) = gap.part("two", 5, 1, kept)
    assert (len(played), row.ours.split(",")[0]) == (3, "1/1")


def test_a_slice_of_a_group_is_a_sample_of_all_of_it() -> None:
    names = {name for case in gap._ordered("one")[:60] for name in case.effects}
    assert len(names) > 0.8 * len(INSIDE)
    with pytest.raises(Problem):
        next(gap.part("nothing"))


def test_every_effect_of_the_generator_leaves_its_mark_and_none_leaves_none() -> None:
    assert evidence(1, {}, {}) == 0.0
    for name in EFFECTS:
        seen_by = {} if name in ON_THE_TABLE else {"reference": "rate"}
        if name != "adc_quantization":
            assert evidence(1, {name: 1.0}, seen_by) > 30.0, name


def test_a_case_can_be_made_again_from_its_name() -> None:
    first, again = (next(iter(one_effect(1.0, 1))) for _ in range(2))
    assert str(first) == str(again)
    assert np.array_equal(first.made().columns["x_gyro_v"], again.made().columns["x_gyro_v"])
    assert Case("one-1", 1, {}).seed != Case("one-1", 2, {}).seed


def test_the_oracle_whitens_what_the_generator_makes() -> None:
    """White and AR(1) noise together come out with unit variance and no correlation."""
    made = record(5, {}, ar1_V=1.2e-3, phi=0.95, reference="rate")
    noise = made.gyro_noise_dps * float(str(made.truth["scale_factor_V_per_dps"]))
    white = whitened(noise[:, None], math.hypot(1.2e-3, 5.0 / 4096.0 / math.sqrt(12.0)), 1.2e-3, 0.95)[:, 0]
    assert np.var(white) == pytest.approx(1.0, abs=0.05)
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.03


def test_the_library_and_the_generator_know_the_same_effects() -> None:
    from calib_core.effects import library

    assert set(library()) - set(INSIDE) == {"input_loading"}


@pytest.mark.parametrize(
    ("axis", "names", "most_dps"),
    [
        ("x", ["bias_temperature", "thermal_lag", "bias_drift"], 0.23),
        ("z", ["bias_temperature", "bias_drift"], 0.064),
    ],
)
def test_a_real_chamber_record_is_given_no_trap_and_its_last_leg_is_predicted(
    axis: str, names: list[str], most_dps: float
) -> None:
    """METHOD 4 has 0.163 for x, 0.064 for z."""
    shared("real/thermal_chamber.csv")
    whole = gap_real.read_named("thermal_chamber")
    seen = whole.time_s <= gap_real.TURNED_S
    said = diagnose(whole.take(seen), axis)
    assert said.after is not None
    assert [t.name for t in said.after.terms] == names
    assert gap_real.error(said, said.after, whole, axis, ~seen) < most_dps


def test_powers_of_one_temperature_asked_for_by_hand_are_fitted_beside_slow_noise() -> None:
    shared("real/thermal_chamber.csv")
    whole = gap_real.read_named("thermal_chamber")
    said = diagnose(whole.take(whole.time_s <= gap_real.TURNED_S), "x", effects=["bias_temperature"])
    assert said.after is not None
    assert [t.setting for t in said.after.terms][:1] == [(3.0,)]
