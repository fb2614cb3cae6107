"""Independent readings: the thesis' own, and made ones whose truth is known."""

import io
import json
from pathlib import Path

import numpy as np
import pytest

from calib_core import points
from calib_core.effects import Effect, library
from calib_core.formula import effect_of
from calib_core.gap_points import Readings, diagnose
from calib_core.points import Points
from calib_core.problem import Problem
from calib_core.thesis.printed import readings
from server import cli

RATES = np.repeat([-100.0, -80, -60, -40, -20, -10, 10, 20, 40, 60, 80, 100], 14)
ANGLES = np.repeat([a for a in range(-120, 121, 10) if a], 6).astype(float)


def made(kind: str, effect: object, *, noise: float = 0.4, seed: int = 1, axis: str = "x") -> Points:
    """Readings of a gyro with gain 0.98, offset 0.3 and ``effect`` (set-points -> what it adds)."""
    rng = np.random.default_rng(seed)
    asked = RATES if kind == "rate" else ANGLES
    reference = asked + rng.normal(0.0, 0.05, len(asked))
    gyro = 0.3 + 0.98 * reference + effect(reference) + rng.normal(0.0, noise, len(asked))  # type: ignore[operator]
    same = np.full(len(asked), "B1"), np.full(len(asked), axis)
    none = np.full(len(asked), np.nan)
    return Points(*same, kind, np.full(len(asked), ""), asked, reference, gyro, np.arange(len(asked)), none)


def named(said: dict[str, object]) -> list[str]:
    return [finding["effect"] for finding in said["missing"]]  # type: ignore[attr-defined, index]


@pytest.mark.parametrize("board", ["1", "2"])
@pytest.mark.parametrize("axis", ["x", "z"])
def test_the_thesis_rate_readings_show_a_cubic_on_all_four_axes(board: str, axis: str) -> None:
    said = diagnose(readings("rate", board, axis))
    first = said["missing"][0]
    assert first["effect"] == "scale_factor_cubic"
    # METHOD 1: the coefficient is -2.2 to -4.5e-6 (deg/s)^-2 on all four.
    assert -4.6e-6 < first["parameters"][0]["value"] < -2.2e-6
    assert said["after"]["held_out_rms_dps"] < said["error"]["held_out_rms_dps"]


def test_the_cubic_of_board_1_x_has_the_errors_that_method_prints() -> None:
    fit = Readings(readings("rate", "1", "x"))
    cubic = next(c for c in fit.columns(_library()) if c.name == "scale_factor_cubic")
    for columns, rms in (([], 1.593), ([cubic], 1.288)):
        assert np.sqrt(fit.fit(columns).squares / 168) == pytest.approx(rms, abs=5e-4)


@pytest.mark.parametrize("board", ["1", "2"])
def test_the_thesis_position_tests_of_x_cannot_tell_a_moved_bias_from_asymmetry(board: str) -> None:
    said = diagnose(readings("position", board, "x"))
    assert said["verdict"] == "ambiguous"
    assert {"bias_step", "scale_factor_asymmetry"} <= set(said["rivals"][0])
    assert "held_out_rms_deg" in said["error"]
    assert said["unit"] == "deg"


@pytest.mark.parametrize("kind", ["rate", "position"])
def test_healthy_readings_are_given_nothing(kind: str) -> None:
    """One in a hundred is the design; three of 60 are met once in 40 times."""
    assert sum(bool(named(diagnose(made(kind, np.zeros_like, seed=seed)))) for seed in range(60)) <= 3


@pytest.mark.parametrize(
    ("effect", "name", "parameter", "value"),
    [
        (lambda w: -0.98 * 3e-6 * w**3, "scale_factor_cubic", "k", -3e-6),
        (lambda w: 0.98 * 2e-4 * w**2, "scale_factor_quadratic", "k", 2e-4),
        (lambda w: 0.98 * 2e-2 * np.abs(w), "scale_factor_asymmetry", "k", 2e-2),
        (lambda w: -0.98 * 1.5 * np.sign(w), "dead_band", "d", 1.5),
    ],
)
def test_an_effect_of_rate_is_named_with_its_size(effect: object, name: str, parameter: str, value: float) -> None:
    said = diagnose(made("rate", effect))
    assert named(said) == [name]
    found = said["after"]["parameters"][-1]
    assert found["name"] == f"{name}.{parameter}"
    assert abs(found["value"] - value) < 4.0 * found["standard_uncertainty"]


def test_a_users_own_effect_of_the_rate_is_named_too() -> None:
    own = effect_of("fifth", "(rate_dps / 100)**5 - (rate_dps / 100)**3", "k", "deg/s", "rate")
    wavy = made("rate", lambda w: 0.98 * 6.0 * ((w / 100) ** 5 - (w / 100) ** 3))
    said = diagnose(wavy, suspects={"fifth": own, **_library()})
    assert named(said) == ["fifth"]
    assert said["after"]["parameters"][-1]["value"] == pytest.approx(6.0, abs=1.0)


def test_a_bias_that_moved_adds_up_over_the_time_written_down() -> None:
    """With moves at two speeds its column is no longer that of asymmetry."""
    speed = np.where(np.arange(len(ANGLES)) % 2, 25.0, 100.0)
    duration = np.abs(ANGLES) / speed
    moved = made("position", lambda _: 0.8 * duration)
    said = diagnose(Points(**{**vars(moved), "duration_s": duration}))
    assert (said["verdict"], named(said)) == ("missing", ["bias_step"])
    assert said["after"]["parameters"][-1]["value"] == pytest.approx(0.8, abs=0.1)
    assert said["after"]["parameters"][-1]["unit"] == "deg/s"


def test_what_needs_time_has_no_data_and_what_hides_in_the_base_is_not_excited() -> None:
    status = {c["effect"]: c["status"] for c in diagnose(made("position", np.zeros_like))["candidates"]}
    assert {status[name] for name in ("thermal_lag", "time_offset", "hysteresis", "encoder_eccentricity")} == {
        "no_data"
    }
    assert status["scale_factor_cubic"] == "not_excited"
    assert status["bias_step"] == "tested"


def test_few_or_senseless_readings_are_not_testable() -> None:
    plain = made("rate", np.zeros_like)
    for broken in (plain.take(slice(0, 5)), Points(**{**vars(plain), "gyro": -plain.gyro})):
        said = diagnose(broken)
        assert said["verdict"] == "not_testable"
        assert said["after"] is None


def test_a_given_effect_belongs_to_the_model_and_one_without_a_column_is_refused() -> None:
    cubic = made("rate", lambda w: -3e-6 * w**3)
    said = diagnose(cubic, effects=["scale_factor_cubic"])
    assert (said["verdict"], said["model"]["effects"]) == ("adequate", ["scale_factor_cubic"])
    with pytest.raises(Problem, match="effect_not_possible"):
        diagnose(cubic, effects=["thermal_lag"])


def test_the_command_takes_points_and_tells_each_board_and_axis(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written = io.BytesIO()
    points.write(readings("position", "2", "x"), written)
    file = tmp_path / "board2.csv"
    file.write_bytes(written.getvalue())
    assert cli.main(["diagnose", str(file), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["recording"]["board"], said["recording"]["samples"]) == ("2", 248)
    codes = [limit["code"] for limit in said["limits"]]
    assert "diagnosis.limit.moved" in codes
    assert "one of" in said["sentence"]
    assert " deg;" in said["sentence"]
    assert cli.main(["diagnose", str(file)]) == 0
    assert "board 2, axis x, 248 readings" in capsys.readouterr().out


def _library() -> dict[str, type[Effect]]:
    return dict(library())
