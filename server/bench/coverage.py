"""Do the stated intervals hold the truth? Whole estimate states on the twin, analysed as for a certificate.

White noise, and white plus AR(1) noise of a correlation time that differs from board to board (0.1 to 2 s).
"""

import math
from dataclasses import replace

import numpy as np

from calib_core import session
from calib_core.model import Model
from calib_core.sequence import make_plan
from calib_core.twin import Plant, board_truth
from server.bench import Row
from server.devices.rig import Rig
from server.devices.twin_rig import TwinDaq, TwinTable
from server.engine import record

BOARDS = 200
QUANTITIES = {"scale_factor_V_per_dps": ("scale factor", "scale_factor"), "bias_V": ("bias", "bias")}
COVERAGE_PCT = (93.0, 97.0)
"""Of 400 intervals that hold with 95 %, fewer than 93 or more than 97 come up once in 15 campaigns."""
CHI2 = 0.05


def run(*, quick: bool) -> list[Row]:
    """Coverage, mean χ² per row, and the errors in units of their standard uncertainties."""
    boards = 10 if quick else BOARDS
    rows = []
    for kind in ("white", "AR(1)"):
        results = [found for seed in range(boards) for found in board(seed, coloured=kind != "white")]
        for key, (name, _) in QUANTITIES.items():
            off, u, expanded = np.array([r[key] for r in results]).T
            low, high = wilson(int(np.sum(np.abs(off) < expanded)), len(off))
            share = 100.0 * float(np.mean(np.abs(off) < expanded))
            ours = f"{len(off)} axes, {100 * low:.1f} to {100 * high:.1f} % with 95 % confidence"
            least, most = (None, None) if quick else COVERAGE_PCT  # a few axes decide nothing
            rows.append(Row(f"{kind}: {name} inside its 95 % interval", share, "%", least, True, ours))
            rows.append(Row(f"{kind}: {name} inside, not too often", share, "%", most, ours=ours))
            rows.append(Row(f"{kind}: {name}, RMS of error/uncertainty", math.sqrt(np.mean((off / u) ** 2)), "1"))
        chi2 = float(np.mean([r["chi2"][0] for r in results]))
        rows.append(Row(f"{kind}: chi-square per row, distance from 1", abs(chi2 - 1.0), "1", CHI2))
    return rows


def board(seed: int, *, coloured: bool) -> list[dict[str, tuple[float, ...]]]:
    """(error, standard, expanded uncertainty) of each quantity and χ² per row, x then z, of one board."""
    models = {axis: _noisy(model, seed, axis) if coloured else model for axis, model in board_truth(seed).items()}
    table = TwinTable(Plant(seed, models))
    rig = Rig(f"twin:?seed={seed}", table, TwinDaq(table), simulated=True)
    rig.open()
    try:
        recording = record(make_plan(seed=seed, states=["estimate_x", "estimate_z"]), rig, board=f"coverage-{seed}")
    finally:
        rig.close()
    states = session.analyse(recording).states
    found = []
    for axis, truth in models.items():
        result = states[f"estimate_{axis}"]
        row: dict[str, tuple[float, ...]] = {"chi2": (result["chi2_per_row"],)}
        for key, (_, field) in QUANTITIES.items():
            stated = result[key]
            error = stated["value"] - getattr(truth, field)
            row[key] = (error, stated["standard_uncertainty"], stated["expanded_uncertainty"])
        found.append(row)
    return found


def wilson(inside: int, n: int) -> tuple[float, float]:
    """The 95 % interval of a share (Wilson 1927)."""
    z2, p = 1.96**2, inside / n
    middle, half = p + z2 / (2 * n), 1.96 * math.sqrt(p * (1.0 - p) / n + z2 / (4 * n * n))
    return (middle - half) / (1.0 + z2 / n), (middle + half) / (1.0 + z2 / n)


def _noisy(model: Model, seed: int, axis: str) -> Model:
    """The same gyro with slow noise beside its white noise: half to all of its size, correlated over 0.1 to 2 s."""
    rng = np.random.default_rng([seed, ord(axis)])
    share, tau_s = rng.uniform(0.3, 1.0), math.exp(rng.uniform(math.log(0.1), math.log(2.0)))
    return replace(model, noise=replace(model.noise, ar1=share * model.noise.white, correlation_time_s=tau_s))
