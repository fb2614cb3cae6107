"""A model turned round gives the rate back, the same in numpy, in Python without imports and in C."""

import json
import math
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calib_core.compensation import Compensation
from calib_core.compensation_body import INPUTS, REASONS
from calib_core.compensation_c import write_c
from calib_core.compensation_python import write_python
from calib_core.effects import Covariates, Effect, library
from calib_core.formula import effect_of, to_json
from calib_core.model import REFERENCE, Model, Truth
from calib_core.problem import Problem

F64 = NDArray[np.float64]

RATE_HZ, N = 100.0, 1500
TIME = np.arange(N) / RATE_HZ
BASE = {"bias_V": 1.25, "scale_factor_V_per_dps": 0.0059}
USERS = (
    effect_of("cogging", "sin(radians(7*position_deg) + pi/4)", "A", "{out}"),
    effect_of("notch", "exp(-((abs(rate_dps) - 45)/6)**2)", "d", "deg/s", "rate"),
    effect_of(
        "odd", "where(rate_dps > 5 and not tilt_deg < 0, min(rate_dps, 40, 60), max(-3, sign(rate_dps)))", "k", "1"
    ),
    effect_of("kink", "clip(temperature_c - 25, 0, 2)**0.5 * (0 <= time_s < 9 or supply_v > 3)", "m", "{out}"),
)


def motion() -> tuple[Truth, Covariates]:
    """Sines and rests whose rates between samples stay clear of the dead band's edge, with everything else moving."""
    rate = 60.0 * np.sin(2.0 * np.pi * 0.2513 * TIME) + 20.0 * np.sin(2.0 * np.pi * 1.3 * TIME)
    rate = np.where(np.abs(rate) < 6.0, 0.0, rate)
    other = 10.0 * np.cos(2.0 * np.pi * 0.4 * TIME)
    position = {"x": np.cumsum(rate) / RATE_HZ, "z": np.cumsum(other) / RATE_HZ}
    temperature = 25.0 + 3.0 * np.sin(TIME / 4.0)
    supply = 3.0 + 0.05 * np.sin(TIME / 3.0)
    truth = Truth(TIME, {"x": rate, "z": other}, position, temperature, supply)
    zero = np.zeros(N)
    covariates = Covariates(
        "x", TIME, zero, position["x"], zero, zero, 1.0 / RATE_HZ, temperature, supply, other, position["x"]
    )
    return truth, covariates


TRUTH, GIVEN = motion()
CASES: dict[str, dict[str, float]] = {
    "base": {},
    "bias_temperature": {"k1": 2e-4, "k2": 5e-6, "k3": 1e-6},
    "thermal_lag": {"k": 4e-4, "tau": 5.0},
    "warm_up": {"a": 4e-3, "tau": 6.0},
    "bias_drift": {"r": 8e-5},
    "bias_step": {"a": 1e-3, "t1": 7.0},
    "supply_sensitivity": {"k": 0.04},
    "g_sensitivity": {"k_s": 8e-4, "k_c": -5e-4},
    "g_squared_sensitivity": {"k_s": 4e-4, "k_c": 3e-4},
    "hysteresis": {"h": 6e-4, "start": 1.0},
    "scale_factor_quadratic": {"k": 6e-5},
    "scale_factor_cubic": {"k": -4.5e-6},
    "scale_factor_asymmetry": {"k": 4e-3},
    "scale_factor_temperature": {"k": 8e-4},
    "cross_axis": {"k": 8e-3},
    "dead_band": {"d": 2.0},
    "bandwidth_lag": {"tau": 0.006},
    "angular_acceleration": {"k": 6e-3},
    "input_loading": {"loss": 0.19, "V_input": 1.4},
    "cogging": {"A": 6e-4},
    "notch": {"d": 0.5},
    "odd": {"k": 1e-5},
    "kink": {"m": 1e-3},
}
KNOWN: dict[str, type[Effect]] = {**library(), **{effect.name: effect for effect in USERS}}


def compensation(values: Mapping[str, Mapping[str, float]], **more: Any) -> Compensation:
    rows: list[dict[str, Any]] = [
        {"name": n, "value": v, "unit": "V", "standard_uncertainty": 1e-6} for n, v in BASE.items()
    ]
    for effect, parameters in values.items():
        rows += [{"name": f"{effect}.{name}", "value": value, "unit": "V"} for name, value in parameters.items()]
    users = [to_json(effect) for effect in USERS if effect.name in values]
    return Compensation.of(rows, axis="x", unit="V", reference=REFERENCE, user_effects=users, **more)


def volts(values: Mapping[str, Mapping[str, float]], truth: Truth = TRUTH) -> F64:
    """What the library makes of the true motion, without noise."""
    effects = [KNOWN[name](**parameters) for name, parameters in values.items()]
    model = Model(BASE["bias_V"], BASE["scale_factor_V_per_dps"], effects=effects)
    return model.simulator("x", RATE_HZ, np.random.default_rng(0))(truth)


def loaded(c: Compensation) -> dict[str, Any]:
    room: dict[str, Any] = {}
    exec(compile(write_python(c), "compensation.py", "exec"), room)
    return room


def arguments(names: Sequence[str], output: F64) -> F64:
    """(n, k) the inputs of a generated function, from its arguments' names."""
    covariates = {name: getattr(GIVEN, name, np.zeros(N)) for name in INPUTS}
    return np.column_stack([output if name.startswith("output_") else covariates[name] for name in names])


def names_in(source: str) -> list[str]:
    found = re.search(r"^def rate_dps\((.*)\):", source, re.MULTILINE)
    assert found
    return [name.strip() for name in found[1].split(",") if name.strip() != "state"]


def in_python(c: Compensation, output: F64) -> F64:
    room, given = loaded(c), arguments(names_in(write_python(c)), output)
    if "State" in room:
        state = room["State"]()
        return np.array([room["rate_dps"](state, *row) for row in given])
    return np.array([room["rate_dps"](*row) for row in given])


MAIN = """
#include <stdio.h>
#include "compensation.h"
int main(void)
{
    GYRO_REAL %s;
    double %s;
    %s
    while (scanf("%s", %s) == %d) {
        %s
        printf("%%.17g\\n", (double)gyro_x_rate_dps(%s));
    }
    return 0;
}
"""


@pytest.fixture(scope="session")
def in_c(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., F64]:
    """Compiles the header, with warnings as errors, and runs it over the samples."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here: the C header is not checked against the others")

    def run(c: Compensation, output: F64, real: str = "double") -> F64:
        header, names = write_c(c), names_in(write_python(c))
        room = tmp_path_factory.mktemp("c")
        (room / "compensation.h").write_text(header, encoding="ascii")
        state = "gyro_x_state *" in header
        text = MAIN % (
            ", ".join(f"r{k}" for k in range(len(names))),
            ", ".join(f"d{k}" for k in range(len(names))),
            "gyro_x_state state; gyro_x_reset(&state);" if state else "",
            " ".join(["%lf"] * len(names)),
            ", ".join(f"&d{k}" for k in range(len(names))),
            len(names),
            " ".join(f"r{k} = (GYRO_REAL)d{k};" for k in range(len(names))),
            ", ".join([*(["&state"] if state else []), *(f"r{k}" for k in range(len(names)))]),
        )
        (room / "main.c").write_text(text, encoding="ascii")
        flags = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", f"-DGYRO_REAL={real}"]
        subprocess.run([compiler, *flags, "main.c", "-o", "main", "-lm"], cwd=room, check=True)
        rows = "\n".join(" ".join(repr(float(x)) for x in row) for row in arguments(names, output))
        told = subprocess.run([room / "main"], input=rows, capture_output=True, text=True, check=True)
        return np.array([float(line) for line in told.stdout.split()])

    return run


def expected_rate(values: Mapping[str, Mapping[str, float]]) -> F64:
    """What can come back: the true rate, or its mean since the last sample where a lag is undone."""
    rate = TRUTH.rate_dps["x"]
    return (rate + np.append(rate[0], rate[:-1])) / 2.0 if "bandwidth_lag" in values else rate


@pytest.mark.parametrize("name", list(CASES))
def test_the_rate_that_went_in_comes_back_out(name: str) -> None:
    values = {} if name == "base" else {name: CASES[name]}
    back = compensation(values).rate(volts(values), GIVEN)
    assert back == pytest.approx(expected_rate(values), abs=1e-6)


APART = ("base", "dead_band", "notch", "odd")
"""Where a formula jumps, or bends back, several together may have no one answer."""
ALL = {name: parameters for name, parameters in CASES.items() if name not in APART}
SETS = {**{name: {name: p} if p else {} for name, p in CASES.items()}, "all": ALL}


def test_many_effects_at_once_come_off_nearly() -> None:
    """A lag mixes the rates that its neighbours bend, so only nearly."""
    back = compensation(ALL).rate(volts(ALL), GIVEN)
    moving = np.convolve(np.abs(np.gradient(TRUTH.rate_dps["x"])) < 3.0, np.ones(9), "same") == 9
    assert back[moving] == pytest.approx(expected_rate(ALL)[moving], abs=0.2)


@pytest.mark.parametrize("name", SETS)
def test_python_and_c_compute_what_the_core_does(name: str, in_c: Callable[..., F64]) -> None:
    c, output = compensation(SETS[name]), volts(SETS[name])
    own = c.rate(output, GIVEN)
    assert np.isfinite(own).all()
    assert in_python(c, output) == pytest.approx(own, abs=2e-7)
    assert in_c(c, output) == pytest.approx(in_python(c, output), abs=1e-9)


def test_noise_and_an_output_beyond_the_model_are_told_alike(in_c: Callable[..., F64]) -> None:
    rng = np.random.default_rng(1)
    values = {name: CASES[name] for name in ("hysteresis", "scale_factor_cubic", "bandwidth_lag", "thermal_lag")}
    c, output = compensation(values), volts(values) + rng.normal(0.0, 1.2e-3, N)
    output[700] = 9.0
    own = c.rate(output, GIVEN)
    assert math.isnan(own[700])
    for other in (in_python(c, output), in_c(c, output)):
        assert math.isnan(other[700])
        fine = np.delete(np.arange(N), [700, 701])
        assert np.mean(np.abs(other - own)[fine] < 1e-6) > 0.97  # a noisy rate may cross the turning rate in between
        assert np.abs(other - own)[fine].max() < 0.5


def test_single_precision_is_as_good_as_its_digits(in_c: Callable[..., F64]) -> None:
    values = {name: CASES[name] for name in ("hysteresis", "scale_factor_cubic", "bias_temperature", "thermal_lag")}
    c, output = compensation(values), volts(values)
    assert in_c(c, output, "float") == pytest.approx(c.rate(output, GIVEN), abs=2e-3)


def test_time_that_stands_still_divides_by_nothing() -> None:
    room = loaded(compensation({name: CASES[name] for name in ("bandwidth_lag", "angular_acceleration")}))
    state = room["State"]()
    assert room["rate_dps"](state, 1.25, 1.0) == room["rate_dps"](state, 1.25, 1.0) == 0.0


def test_exported_python_needs_nothing_and_asks_only_for_what_it_uses() -> None:
    source = write_python(compensation({"bias_temperature": CASES["bias_temperature"]}))
    assert re.findall(r"^(?:import|from) .*", source, re.MULTILINE) == ["import math"]
    assert names_in(source) == ["output_V", "temperature_c"]
    assert "class State" not in source
    assert names_in(write_python(compensation({}))) == ["output_V"]


def test_what_cannot_be_undone_is_left_out_and_named() -> None:
    values = {
        "encoder_eccentricity": {"a": 0.5}, "backlash": {"b": 0.5}, "mains_hum": {"A": 1e-3, "B": 0.0, "f": 50.0},
        "bias_random_walk": {"k": 1e-5}, "adc_quantization": {"step": 0.01}, "clock_skew": {"skew": 1e-5},
    }  # fmt: skip
    c = compensation({**values, "bias_drift": {"r": 1e-5}})
    assert {name for name, _ in c.left_out} == set(values)
    assert [e.name for e in c.effects] == ["bias_drift"]
    for text in (write_c(c), write_python(c)):
        assert all(f"Not undone: {name} ({REASONS[reason]})." in text for name, reason in c.left_out)


def test_every_effect_of_the_library_is_undone_or_has_a_reason() -> None:
    for name, effect in library().items():
        c = compensation({name: {key: p.typical for key, p in effect.parameters().items()}})
        assert [e.name for e in c.effects] == [name] or c.left_out[0][1] in REASONS
        assert c.left_out == () or c.left_out[0][1] != "unwritten", f"{name}: give its parameters a code"


def test_a_limit_and_a_delay_are_told_beside_the_rate(in_c: Callable[..., F64]) -> None:
    values = {"saturation": {"V_lo": 0.9, "V_hi": 1.6}, "time_offset": {"delay": 0.004}}
    c = compensation(values)
    room = loaded(c)
    assert [room["saturated"](v) for v in (0.89, 0.9, 1.2, 1.6)] == [True, True, False, True]
    assert c.delay_s == 0.004
    assert "0.004 s before the sample's time stamp" in write_c(c)
    assert c.rate(np.array([1.25, 1.309]), replace(GIVEN, time_s=TIME[:2])) == pytest.approx([0.0, 10.0])
    assert in_c(c, volts({})) == pytest.approx(TRUTH.rate_dps["x"], abs=1e-9)


def test_a_compensation_goes_through_json_and_back() -> None:
    c = compensation(ALL, board="LPY-1", source={"digest": "sha256:0"})
    text = json.dumps(c.to_json())
    again = Compensation.from_json(text)
    assert json.dumps(again.to_json()) == text
    assert write_c(again) == write_c(c)
    assert [row["name"] for row in again.rows[:2]] == list(BASE)


def test_a_diagnosis_gives_its_model_with_or_without_what_was_missing() -> None:
    base = [{"name": n, "value": v, "unit": "V", "standard_uncertainty": 1e-6} for n, v in BASE.items()]
    warm = {"name": "bias_temperature.k1", "value": 2e-4, "unit": "V/degC", "standard_uncertainty": 1e-6}
    limit = {"name": "saturation.V_hi", "value": 1.8, "unit": "V", "standard_uncertainty": None}
    answer = {
        "recording": {"board": "B1", "file": "a.csv", "samples": 9, "duration_s": 9.0},
        "axis": "x",
        "unit": "V",
        "model": {"effects": [], "parameters": base, "reference": {"temperature_c": 25.0}},
        "missing": [
            {"effect": "bias_temperature", "parameters": [warm]},
            {"effect": "saturation", "parameters": [limit]},
        ],
        "after": {"effects": ["bias_temperature"], "parameters": [*base, warm]},
    }
    with_it = Compensation.of_diagnosis(answer)
    assert [e.name for e in with_it.effects] == ["bias_temperature", "saturation"]
    assert (with_it.board, with_it.source) == ("B1", {"file": "a.csv"})
    assert Compensation.of_diagnosis(answer, as_asked=True).effects == ()


def test_a_gyro_that_tells_deg_s_counts_as_scaled_right_where_nothing_moved() -> None:
    c = Compensation.of([{"name": "bias_dps", "value": 0.9}], axis="y", unit="deg/s", reference={})
    assert c.rate(np.array([1.0, 3.0]), replace(GIVEN, time_s=TIME[:2])) == pytest.approx([0.1, 2.1])
    assert "output_dps" in write_c(c)


@pytest.mark.parametrize(
    ("rows", "unit", "code"),
    [
        ([], "V", "no_base"),
        ([{"name": "bias_V", "value": 1.25}], "V", "no_base"),
        ([{"name": "bias_V", "value": float("nan")}], "V", "no_value"),
        ([{"name": "bias_V", "value": None}], "V", "no_value"),
        (
            [*({"name": n, "value": v} for n, v in BASE.items()), {"name": "magic.k", "value": 1.0}],
            "V",
            "unknown_parameter",
        ),
        (
            [*({"name": n, "value": v} for n, v in BASE.items()), {"name": "bias_drift.q", "value": 1.0}],
            "V",
            "unknown_parameter",
        ),
        ([{"name": n, "value": v} for n, v in BASE.items()], "furlong", "unknown_parameter"),
    ],
)
def test_an_incomplete_model_is_refused(rows: list[dict[str, Any]], unit: str, code: str) -> None:
    with pytest.raises(Problem) as caught:
        Compensation.of(rows, axis="x", unit=unit, reference={})
    assert caught.value.code == f"compensation.{code}"


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": "other"}', b"\xff", '{"format": "gyro-compensation 1"}'])
def test_json_of_something_else_is_refused(text: str | bytes) -> None:
    with pytest.raises(Problem, match=r"compensation\.not_json"):
        Compensation.from_json(text)


def test_a_temperature_effect_without_its_reference_is_refused() -> None:
    rows = [{"name": n, "value": v} for n, v in {**BASE, "bias_temperature.k1": 1e-4}.items()]
    with pytest.raises(Problem, match=r"compensation\.no_reference"):
        Compensation.of(rows, axis="x", unit="V", reference={})


def test_hostile_names_end_neither_comment_nor_docstring(tmp_path: Path) -> None:
    c = compensation({}, board='*/ int x; /* """ \\', source={"file": "a*/\nb"})
    header = write_c(c)
    assert header.count("*/") == header.count("/*")
    assert "rate_dps" in loaded(c)
    assert tmp_path.exists()
