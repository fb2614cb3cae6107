"""Bias and scale factor of simulated boards against their truth: the estimate states of the six, on the twin."""

import math

import numpy as np

from calib_core import session
from calib_core.sequence import make_plan
from calib_core.twin import board_truth
from server.bench import Row
from server.devices import open_rig
from server.engine import record

ESTIMATES = {"integral fit": "integral_fit", "adaptive": "adaptive"}
FIGURES = (("scale factor", "%", 0.02), ("bias", "mV", 0.1))  # and the limits of the certified estimate


def run(*, quick: bool) -> list[Row]:
    errors = [error for seed in range(6 if quick else 50) for error in board(seed)]
    rows = []
    for name, key in ESTIMATES.items():
        certified = key == "integral_fit"  # the adaptive estimate is shown beside it, whatever it is
        error = np.array([e[key] for e in errors])
        for column, (what, unit, limit) in enumerate(FIGURES):
            rms, mean = math.sqrt(np.mean(error[:, column] ** 2)), abs(float(np.mean(error[:, column])))
            ours = f"{len(error)} axes of simulated boards"
            rows.append(Row(f"{name}: {what}, RMS error", rms, unit, limit if certified else None, ours=ours))
            rows.append(Row(f"{name}: {what}, mean error", mean, unit, limit / 3 if certified else None, ours=ours))
    return rows


def board(seed: int) -> list[dict[str, tuple[float, float]]]:
    """Errors of scale factor (%) and bias (mV) of each estimate, x then z, of one board on its own rig."""
    name = f"bench-{seed}"
    rig = open_rig(f"twin:?seed={seed}")
    rig.open()
    try:
        recording = record(make_plan(seed=seed, states=["estimate_x", "estimate_z"]), rig, board=name)
    finally:
        rig.close()
    states = session.analyse(recording).states
    found = []
    for axis, truth in board_truth(seed, name).items():
        result = states[f"estimate_{axis}"]
        found.append(
            {
                key: (
                    100.0 * (result[key]["scale_factor_V_per_dps"] / truth.scale_factor - 1.0),
                    1e3 * (result[key]["bias_V"] - truth.bias),
                )
                for key in ESTIMATES.values()
            }
        )
    return found
