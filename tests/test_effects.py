"""The one contract that every effect keeps: card, parameters, truth and suspect the same, words, drawing.

A new effect is tested here by being there.
"""

import xml.etree.ElementTree as ET
from functools import cache
from importlib import import_module

import numpy as np
import pytest
from numpy.typing import NDArray
from shared import ROOT

from calib_core.effects import Acts, Chain, Covariates, Effect, Stage, library
from calib_core.model import Follower, Model, Truth
from server.texts import texts

F64 = NDArray[np.float64]
CARD = ("summary", "equation", "cause", "signature", "confused_with", "excite_it", "source")
RATE_HZ, SECONDS, BIAS, SCALE = 1000.0, 40.0, 1.25, 0.0059
NO_SHAPE = {"saturation", "adc_quantization", "bias_random_walk", "input_loading"}
"""A limit, a rounding, a variance, a change of the base: found otherwise, so without columns."""
NOTHING = {"saturation": {"V_lo": -np.inf, "V_hi": np.inf}, "dead_band": {"d": 0.0}}
"""The values at which an effect is not there, where these are not zeros."""
STRENGTH = {
    "input_loading": {"loss": 0.02, "V_input": 1.4},
    "saturation": {"V_lo": 1.0, "V_hi": 1.5},
    "bias_step": {"a": 1.2e-3, "t1": 21.0},
}
"""Instead of the typical, which this motion would not show."""


@cache
def truth() -> Truth:
    """Everything that an effect may depend on moves, and no two things alike."""
    t = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    waves = [(40.0, 0.11, 0.3), (7.0, 0.53, 1.1), (1.5, 2.03, 0.7)]
    x = sum(a * np.sin(2.0 * np.pi * f * t + p) for a, f, p in waves)
    x_rate = sum(2.0 * np.pi * f * a * np.cos(2.0 * np.pi * f * t + p) for a, f, p in waves)
    moving = 1.0 - np.exp(-(((t - 28.0) / 2.0) ** 8))  # comes to rest and goes on, smoothly
    z = 25.0 * np.sin(2.0 * np.pi * 0.17 * t)
    return Truth(
        t,
        {"x": moving * x_rate, "z": np.gradient(z, t)},
        {"x": x, "z": z},
        temperature_c=26.0 + 4.0 * np.sin(0.05 * t + 0.4) + 0.02 * t,
        supply_v=3.0 + 0.05 * np.sin(0.31 * t),
    )


def covariates() -> Covariates:
    c = Follower("x", RATE_HZ)(truth())
    level = np.radians(truth().position_deg["x"])
    c.specific_force_g = {"x": 0.1 * np.sin(0.7 * c.time_s), "y": np.sin(level), "z": np.cos(level)}
    return c


def simulated(effect: Effect) -> tuple[F64, F64]:
    """What comes out of the twin's chain with this truth, and what its encoder adds to the angle."""
    model = Model(BIAS, SCALE, effects=(effect,))
    c = covariates()
    rng = np.random.default_rng(4)
    none = np.zeros(len(c.time_s))
    if effect.acts is Acts.ANGLE:
        chain = Chain(c, none.copy(), none, none, SCALE, rng)
        effect.apply(chain)
        return model.predict(c.rate_dps), chain.encoder_deg
    chain = Chain(c, none, c.rate_dps, none, SCALE, rng)
    early = effect.acts is Acts.RATE and effect.stage is not Stage.ACQUISITION
    if early:
        effect.apply(chain)
    chain.output = model.predict(chain.rate_dps)
    if not early:
        effect.apply(chain)
    return chain.output, none


def strength(effect: type[Effect]) -> dict[str, float]:
    return STRENGTH.get(effect.name) or {n: p.typical for n, p in effect.parameters().items()}


EVERY = pytest.mark.parametrize("effect", library().values(), ids=library())


@EVERY
def test_it_says_all_about_itself(effect: type[Effect]) -> None:
    card = effect.card()
    assert [key for key in CARD if not card.get(key)] == []
    assert effect.__name__.lower() == effect.name.replace("_", "")
    assert import_module(f"calib_core.effects.{effect.name}") is not None
    assert effect.stage in Stage
    assert set(effect.needs) <= {"temperature_c", "supply_v", "other_rate_dps", "tilt_deg", "specific_force_g"}
    assert effect.parameters()
    for name, p in effect.parameters().items():
        low, high = p.bounds
        assert p.unit, name
        assert low < high, name
        assert low <= p.typical <= high, name
        assert all(low <= point <= high for point in p.grid), name
        assert not p.log or p.grid, name


@EVERY
def test_its_columns_are_finite_and_shaped_and_named_after_its_parameters(effect: type[Effect]) -> None:
    c = covariates()
    assert not effect.missing(c)
    own = strength(effect)
    columns = effect.columns(c, **{name: own[name] for name in effect.nonlinear()})
    assert bool(columns) == (effect.name not in NO_SHAPE)
    assert set(columns) <= {*effect.linear(), ""}
    for column in columns.values():
        assert column.shape == c.time_s.shape
        assert np.isfinite(column).all()
        assert column.any()


@EVERY
def test_without_size_it_does_exactly_nothing(effect: type[Effect]) -> None:
    output, encoder = simulated(effect(**NOTHING.get(effect.name, dict.fromkeys(effect.linear(), 0.0))))
    np.testing.assert_array_equal(output, BIAS + SCALE * covariates().rate_dps)
    assert not encoder.any()


@EVERY
def test_what_it_does_as_truth_its_columns_explain_as_suspect(effect: type[Effect]) -> None:
    own = strength(effect)
    output, encoder = simulated(effect(**own))
    c = covariates()
    done = encoder if effect.acts is Acts.ANGLE else output - (BIAS + SCALE * c.rate_dps)
    assert np.isfinite(done).all()
    assert np.abs(done).max() > 1e-6
    columns = effect.columns(c, **{name: own[name] for name in effect.nonlinear()})
    if not columns:
        return
    factor = SCALE if effect.acts is Acts.RATE else 1.0
    told = factor * sum(own.get(name, 1.0) * column for name, column in columns.items())
    # The column of a late answer is its first order: some per cent of it are left at 2 Hz.
    least = 0.1 if effect.curvature is not None else 1e-9
    assert np.sqrt(np.mean((done - told) ** 2)) <= least * np.sqrt(np.mean(done**2))


@EVERY
def test_both_languages_tell_of_it_and_it_has_a_drawing(effect: type[Effect]) -> None:
    assert f"effects.{effect.name}.name" in texts("en")
    thai = {part: texts("th").get(f"effects.{effect.name}.{part}", "") for part in ("name", *CARD[:1], *CARD[2:6])}
    assert [part for part, text in thai.items() if not text] == []
    drawing = ROOT / "web" / "effects" / f"{effect.name}.svg"
    assert ET.parse(drawing).getroot().tag.endswith("svg")


def test_a_part_that_begins_hot_and_cools_is_not_warming_up() -> None:
    c = covariates()
    c.temperature_c = 30.0 + 5.0 * np.exp(-c.time_s / 60.0)
    assert not library()["warm_up"].missing(c)
    c.temperature_c = 50.0 - 25.0 * c.time_s / c.time_s[-1]
    assert library()["warm_up"].missing(c)
