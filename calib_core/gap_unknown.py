"""Structure that is in no library: smooth shapes along each covariate, tested beside whatever the library has named.

METHOD 3, step 7. A shape along rate must not contain a constant or a straight line: the base has those from the
encoder, and the difference of the two would be the gyro's own noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calib_core.effects.base import Acts, Effect, Stage
from calib_core.gap_search import equivalent_z
from calib_core.gap_space import FEIGNED_STEPS, Space, Term

F64 = NDArray[np.float64]

CERTAIN = 4.0
"""The |z| that a shape must reach: one healthy record in thousands does, over all five covariates."""
HARMONICS = range(3, 13)
SINCE_REVERSAL_S = (0.0, 0.1, 0.3, 1.0, 3.0)


class Unknown(Effect):
    """A shape without a name, kept in the model as a nuisance."""

    name, stage, acts = "unknown", Stage.SENSOR, Acts.OUTPUT


@dataclass(frozen=True, eq=False)
class Structure:
    """A shape along ``covariate`` and its evidence beside the terms it was tested with."""

    covariate: str
    term: Term
    gain: float
    z: float


def structures(space: Space, chosen: Sequence[Term]) -> list[Structure]:
    """Every covariate's shape beside base and ``chosen``, the most certain first."""
    found = []
    held = np.column_stack([space.white(space.base), *(space.whitened(t) for t in chosen)])
    prior = np.zeros((len(space.prior), held.shape[1]))
    np.fill_diagonal(prior, space.prior)
    held = np.vstack([held, prior])
    own, _ = np.linalg.qr(held / np.sqrt(np.einsum("ij,ij->j", held, held) + 1e-300))
    own = own[: len(space.rows)]
    residual = space.white(space.residual)
    residual = residual - own @ (own.T @ residual)
    for covariate, shapes in _shapes(space).items():
        columns = _basis(space.over_rows(Acts.OUTPUT, shapes), space.base)
        white = space.white(columns)
        free = white - own @ (own.T @ white)
        block = free.T @ free
        inverse = np.linalg.pinv(block, rcond=1e-6, hermitian=True)
        value = inverse @ (free.T @ residual)
        gain = float(value @ np.linalg.solve(inverse + np.diag(_slack(space, columns)), value))
        z = float(equivalent_z(gain, int(np.linalg.matrix_rank(block, rtol=1e-6, hermitian=True))))
        names = tuple(f"c{k}" for k in range(columns.shape[1]))
        term = Term(Unknown, (), names, columns, np.zeros(len(names)))
        found.append(Structure(covariate, term, gain, z))
    return sorted(found, key=lambda s: -s.z)


def _shapes(space: Space) -> dict[str, F64]:
    """(k, p) shapes at the samples along each covariate that varies."""
    c = space.covariates
    shapes = {}
    if np.ptp(c.position_deg) > 30.0:
        angle = np.radians(c.position_deg)
        waves = [f(k * angle) for k in HARMONICS for f in (np.sin, np.cos)]
        shapes[f"{c.axis}_position_deg"] = np.column_stack([*waves, *_bumps(c.position_deg, 17).T])
    if np.ptp(c.rate_dps) > 10.0:
        shapes[f"{c.axis}_rate_dps"] = _curved(_bumps(c.rate_dps, 21), np.linspace(-1.0, 1.0, 21))
    if c.temperature_c is not None and np.ptp(c.temperature_c) > 0.5:
        shapes["temperature_c"] = _bumps(c.temperature_c, 10)
    if c.time_s[-1] > 20.0:
        shapes["time_s"] = _bumps(c.time_s, 16)
    if np.any(np.diff(c.direction) != 0.0):
        shapes["time_since_reversal_s"] = _since_reversal(c.direction, c.interval_s)
    return shapes


def _slack(space: Space, columns: F64) -> F64:
    """(p,) variance of each coefficient that the encoder's codes may feign: angles of a few thousandths of a degree."""
    design = space.design
    if design.readings is None:
        return np.zeros(columns.shape[1])
    moving = space.rows.after >= 0
    angle = np.cumsum(columns[moving] * space.rows.dt_s[moving, None], axis=0) / space.scale_factor
    # Within a second or so: slower than that the encoder's codes average out.
    span = max(2, round(1.0 / float(np.median(space.rows.dt_s[moving]))))
    swing = angle[span:] - angle[:-span] if len(angle) > 2 * span else angle
    return np.asarray((FEIGNED_STEPS * design.readings.step_deg) ** 2 / np.maximum(swing.var(axis=0) / 2.0, 1e-300))


def _basis(columns: F64, base: F64) -> F64:
    """Orthogonal columns that span what ``columns`` (n, p) add to ``base`` (n, b)."""
    own, _ = np.linalg.qr(base)
    free = columns - own @ (own.T @ columns)
    span, power, _ = np.linalg.svd(free / np.sqrt((columns**2).sum(axis=0) + 1e-300), full_matrices=False)
    return np.asarray(span[:, power > 1e-2 * power[0]])


def _bumps(values: F64, count: int) -> F64:
    """(k, count) triangles that sum to one, evenly spread over the values."""
    centres, width = np.linspace(values.min(), values.max(), count, retstep=True)
    return np.asarray(np.clip(1.0 - np.abs(values[:, None] - centres) / width, 0.0, 1.0))


def _curved(bumps: F64, centres: F64) -> F64:
    """What the bumps can form that has no mean and no slope where the record was."""
    occupied = bumps.sum(axis=0)
    used = occupied > 20.0
    constraints = np.stack([occupied[used], occupied[used] * centres[used]])
    return np.asarray(bumps[:, used] @ np.linalg.svd(constraints, full_matrices=True)[2][2:].T)


def _since_reversal(direction: F64, interval_s: float) -> F64:
    """(k, p) which stretch of time after the last reversal, signed by the direction."""
    k = np.arange(len(direction))
    turned = np.concatenate([[0], np.flatnonzero(np.diff(direction) != 0.0) + 1])
    since = (k - turned[np.searchsorted(turned, k, side="right") - 1]) * interval_s
    inside = [(since >= a) & (since < b) for a, b in pairwise(SINCE_REVERSAL_S)]
    return np.column_stack([np.where(part, direction, 0.0) for part in inside])
