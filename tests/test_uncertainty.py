"""The GUM's own worked examples, and the certified NIST sets through the estimator that the instrument uses."""

import csv
import json
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shared import shared

from calib_core.integral_fit import Design
from calib_core.problem import Problem
from calib_core.rows import Averages, Samples
from calib_core.uncertainty import Budget, Contribution, coverage_factor, monte_carlo, propagate
from calib_core.whitening import RowNoise, Rows

F64 = NDArray[np.float64]


def gum() -> dict[str, Any]:
    reference: dict[str, Any] = json.loads(shared("reference/gum/reference.json").read_text(encoding="utf-8"))
    return reference


def test_gum_h1_end_gauge() -> None:
    example = gum()["H1"]
    x, expect, full = example["inputs"], example["expect"], example["gtc_full_precision"]
    length = x["l_s"]["value"]
    budget = Budget(
        length + x["d_obs"]["value"],
        (
            Contribution("l_s", x["l_s"]["u"], dof=x["l_s"]["dof"]),
            Contribution("d_obs", x["d_obs"]["u"], "A", dof=x["d_obs"]["dof"]),
            Contribution("random", x["d_comparator_random"]["u"], dof=x["d_comparator_random"]["dof"]),
            Contribution("systematic", x["d_comparator_systematic"]["u"], dof=x["d_comparator_systematic"]["dof"]),
            Contribution(
                "delta_alpha", x["delta_alpha"]["uniform_half_width"], distribution="uniform",
                sensitivity=-length * x["theta_bar"]["value"], dof=x["delta_alpha"]["dof"],
            ),
            Contribution(
                "delta_theta", x["delta_theta"]["uniform_half_width"], distribution="uniform",
                sensitivity=-length * x["alpha_s"]["value"], dof=x["delta_theta"]["dof"],
            ),
        ),
    )  # fmt: skip
    assert budget.value == expect["l"]
    assert budget.standard_uncertainty == pytest.approx(full["u_c"], rel=1e-5)
    assert budget.dof == pytest.approx(full["nu_eff"], rel=1e-4)
    assert math.floor(budget.dof) == expect["nu_eff"]
    assert budget.coverage_factor(0.99) == pytest.approx(expect["k_99"], abs=0.005)
    # The GUM multiplies its rounded 2.92 and 32; unrounded it is 92.5.
    assert budget.expanded_uncertainty(0.99) == pytest.approx(expect["U_99"], abs=1.0)


def test_gum_h1_arcsine_and_parts() -> None:
    example = gum()["H1"]
    x, full = example["inputs"], example["gtc_full_precision"]
    theta = Budget(
        x["theta_bar"]["value"],
        (
            Contribution("mean", x["theta_bar"]["u"]),
            Contribution("cycle", x["Delta"]["arcsine_half_width"], distribution="arcsine"),
        ),
    )
    assert theta.standard_uncertainty == pytest.approx(full["u_theta"], rel=1e-9)
    parts = (x["d_obs"], x["d_comparator_random"], x["d_comparator_systematic"])
    d = Budget(215.0, tuple(Contribution(str(k), p["u"], dof=p["dof"]) for k, p in enumerate(parts)))
    assert d.standard_uncertainty == pytest.approx(full["u_d"], rel=1e-9)
    assert d.dof == pytest.approx(full["dof_d"], rel=1e-9)


def test_gum_h2_correlated_inputs() -> None:
    example = gum()["H2"]
    data, expect = np.array([example["data"][k] for k in ("V", "I", "phi")]), example["expect"]
    means, covariance = data.mean(axis=1), np.cov(data) / data.shape[1]

    def impedance(x: F64) -> F64:
        v, i, phi = x
        return np.array([v / i * np.cos(phi), v / i * np.sin(phi), v / i])

    values, out = propagate(impedance, means.tolist(), covariance)
    u = np.sqrt(np.diag(out))
    for k, name in enumerate("RXZ"):
        assert values[k] == pytest.approx(expect[name], abs=0.0006 if name != "Z" else 0.006)
        assert u[k] == pytest.approx(expect[f"u{name}"], abs=0.0006)
    for (j, k), name in {(0, 1): "r_RX", (0, 2): "r_RZ", (1, 2): "r_XZ"}.items():
        assert out[j, k] / (u[j] * u[k]) == pytest.approx(expect[name], abs=0.0006)


def test_monte_carlo_finds_what_jcgm_101_prints_for_four_rectangles() -> None:
    # JCGM 101:2008, 9.2.3 and table 3: y = x1 + x2 + x3 + x4, each uniform with u = 1: u(y) = 2.0, [-3.88, 3.88].
    half = math.sqrt(3.0)
    mean, u, (low, high) = monte_carlo(
        lambda x: x.sum(axis=0), lambda n, rng: rng.uniform(-half, half, (4, n)), 200_000, np.random.default_rng(1)
    )
    assert (mean, u) == (pytest.approx(0.0, abs=0.02), pytest.approx(2.0, abs=0.02))
    assert (low, high) == (pytest.approx(-3.88, abs=0.06), pytest.approx(3.88, abs=0.06))


def test_monte_carlo_agrees_with_a_budget_where_things_are_linear_and_normal() -> None:
    budget = Budget(1.0, (Contribution("a", 0.3), Contribution("b", 0.4, sensitivity=-2.0)))
    _, u, (low, high) = monte_carlo(
        lambda x: 1.0 + 0.3 * x[0] - 0.8 * x[1], lambda n, rng: rng.standard_normal((2, n)), 100_000,
        np.random.default_rng(2),
    )  # fmt: skip
    assert u == pytest.approx(budget.standard_uncertainty, rel=0.02)
    assert (high - low) / 2.0 == pytest.approx(budget.expanded_uncertainty(), rel=0.03)


def test_coverage_factors_are_the_tables_of_gum_g2() -> None:
    for dof, k in {1: 12.71, 5: 2.57, 16: 2.12, 50: 2.01, math.inf: 1.960}.items():
        assert coverage_factor(dof) == pytest.approx(k, abs=0.005)


def test_a_source_of_unknown_size_is_named_and_not_numbered() -> None:
    rows = Budget(0.0, (Contribution("fit", 1e-3, "A", dof=40.0),), excluded=("encoder_scale",)).to_json()
    assert rows[-1] == {"name": "encoder_scale", "excluded": True}
    assert rows[0]["dof"] == 40.0
    json.dumps(rows, allow_nan=False)


@pytest.mark.parametrize("wrong", [{"size": -1.0}, {"size": math.nan}, {"distribution": "flat"}, {"kind": "C"}])
def test_a_contribution_without_a_sound_size_or_shape_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(Problem, match="contribution"):
        Contribution(**{"name": "a", "size": 1.0, **wrong})


@pytest.mark.parametrize("name", ["norris", "pontius", "noint1", "wampler1"])
def test_nist_strd_linear_sets(name: str) -> None:
    certified = json.loads(shared("reference/nist_strd/reference.json").read_text(encoding="utf-8"))["sets"][name]
    with shared(f"reference/nist_strd/{name}.csv").open(encoding="utf-8-sig", newline="") as file:
        table = np.array([[float(row["y"]), float(row["x"])] for row in csv.DictReader(file)])
    y, x = table.T
    n, p = len(y), certified["p"]
    columns = x[:, None] if name == "noint1" else x[:, None] ** np.arange(p)
    values, covariance = ordinary(n).estimate(y, columns, RowNoise(1.0), np.zeros(p))
    truth = np.array([float(c) for c in certified["coef"]])
    np.testing.assert_allclose(values, truth, rtol=1e-9 if name != "wampler1" else 1e-7)
    residual = y - columns @ values
    deviation = math.sqrt(residual @ residual / (n - p))
    rsd = float(certified["rsd"])
    assert deviation == pytest.approx(rsd, rel=1e-8, abs=1e-6)
    if rsd > 1e-9:
        np.testing.assert_allclose(
            deviation * np.sqrt(np.diag(covariance)), [float(s) for s in certified["se"]], rtol=1e-8
        )


def ordinary(n: int) -> Design:
    """n independent rows of one sample each."""
    time, none = np.arange(float(n)), np.full(n, -1)
    sample = Samples("V", time, time, np.arange(n) == 0, 1.0, 0.0, np.arange(n))
    rows = Rows(time, np.ones(n), np.arange(n) == 0, none, none, np.empty(0), np.ones(n), np.zeros(n))
    return Design(rows, Averages(sample, time, time, np.arange(n)), np.zeros(n), "rate")
