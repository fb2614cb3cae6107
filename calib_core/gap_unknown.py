"""Structure that is in no library: smooth shapes along each covariate, tested beside whatever the library has named.

METHOD 3, step 7. A shape along rate must not contain a constant or a straight line: the base has those from the
encoder, and the difference of the two would be the gyro's own noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calib_core.condense import Operator
from calib_core.effects.base import Acts, Effect, Stage
from calib_core.gap_search import equivalent_z
from calib_core.gap_space import FEIGNED_STEPS, LONG, TOGETHER, Space, Term

F64 = NDArray[np.float64]

CERTAIN = 4.0
"""The |z| that a shape must reach: one healthy record in thousands does, over all seven covariates."""
HARMONICS = range(3, 13)
UNFEIGNED = ("temperature_c", "supply_v", "time_s", "other_rate_dps")
"""What goes on for many seconds, or with the other axis, the codes of this one do not feign."""
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
    """Of what the encoder's codes could not feign, as the gain is."""
    plain: float
    """The |z| with it: what follows one covariate is seen along others too, but less."""


def strongest(space: Space, chosen: Sequence[Term]) -> Structure | None:
    """Of every covariate's shape beside base and ``chosen`` the one that explains most of those that are certain, or of
    all where none is; None where nothing varies. Only two are kept at a time: their columns are many."""
    was = space.noise
    if was.noise.ar1 == 0.0 or len(space.rows) > LONG:
        return min(_tested(space, chosen, _bases(space)), key=_rank, default=None)
    # What has no name yet is in no model, and poses as noise that is correlated over seconds. What goes on for so
    # long and follows nothing but time is that noise as likely as not.
    bases = list(_bases(space))
    fast = [columns for name, columns in bases if name != "time_s"]
    found = list(_tested(space, chosen, [base for base in bases if base[0] == "time_s"]))
    if fast:
        held = np.column_stack([space.base, *(t.columns for t in chosen)])
        space.refit_noise([*chosen, _as_term(_basis(np.column_stack(fast), held))])
        found += _tested(space, chosen, [base for base in bases if base[0] != "time_s"])
        space.use_noise(was)
    return min(found, key=_rank, default=None)


def _rank(structure: Structure) -> tuple[bool, float]:
    return structure.z < CERTAIN, -structure.plain


def _bases(space: Space) -> Iterator[tuple[str, F64]]:
    for name, shapes in _shapes(space):
        columns = _basis(shapes, space.base)
        del shapes
        yield name, columns


def _tested(space: Space, chosen: Sequence[Term], bases: Iterable[tuple[str, F64]]) -> Iterator[Structure]:
    held = np.column_stack([space.white(space.base), *(space.whitened(t) for t in chosen)])
    prior = np.zeros((len(space.prior), held.shape[1]))
    np.fill_diagonal(prior, space.prior)
    held = np.vstack([held, prior])
    own, _ = np.linalg.qr(held / np.sqrt(np.einsum("ij,ij->j", held, held) + 1e-300))
    own = own[: len(space.rows)]
    residual = space.white(space.residual)
    residual = residual - own @ (own.T @ residual)
    space.forget()
    for covariate, columns in bases:
        if not columns.shape[1]:
            continue
        free = space.white(columns)
        _take_out(free, own)
        block = free.T @ free
        inverse = np.linalg.pinv(block, rcond=1e-6, hermitian=True)
        value = inverse @ (free.T @ residual)
        slack = np.zeros(columns.shape[1]) if covariate in UNFEIGNED else _slack(space, columns)
        gain = float(value @ np.linalg.pinv(inverse + np.diag(slack), 1e-12, hermitian=True) @ value)
        rank = int(np.linalg.matrix_rank(block, rtol=1e-6, hermitian=True))
        z, plain = (float(equivalent_z(x, rank)) for x in (gain, float(value @ block @ value)))
        yield Structure(covariate, _as_term(columns), gain, z, plain)


def _as_term(columns: F64) -> Term:
    names = tuple(f"c{k}" for k in range(columns.shape[1]))
    return Term(Unknown, (), names, columns, np.zeros(len(names)))


def _shapes(space: Space) -> Iterator[tuple[str, F64]]:
    """(n, p) shapes over the rows along each covariate that varies, one covariate after the other."""
    c = space.covariates

    def over(shapes: F64 | Operator) -> F64:
        return space.over_rows(Acts.OUTPUT, shapes)

    if np.ptp(c.position_deg) > 30.0:
        yield f"{c.axis}_position_deg", _along_position(space)
    if np.ptp(c.rate_dps) > 10.0:
        bumps = _bumps(c.rate_dps, 21)
        yield f"{c.axis}_rate_dps", over(bumps) @ _curved(bumps, np.linspace(-1.0, 1.0, 21))
    if c.temperature_c is not None and np.ptp(c.temperature_c) > 0.5:
        yield "temperature_c", over(_bumps(c.temperature_c, 10))
    if c.supply_v is not None and np.ptp(c.supply_v) > 0.005:
        yield "supply_v", over(_bumps(c.supply_v, 8))
    if c.time_s[-1] > 20.0:
        yield "time_s", over(_bumps(c.time_s, 16))
    if c.other_rate_dps is not None and np.ptp(c.other_rate_dps) > 10.0:
        yield "other_rate_dps", over(_bumps(c.other_rate_dps, 11))
    if np.any(np.diff(c.direction) != 0.0):
        yield "time_since_reversal_s", over(_since_reversal(c.direction, c.interval_s))


def _along_position(space: Space) -> F64:
    """(n, p) waves of the angle, and bumps along it."""
    position = space.covariates.position_deg
    angle, out = np.radians(position), np.empty((len(space.rows), 2 * len(HARMONICS) + 17))
    for k in HARMONICS:
        for j, wave in enumerate((np.sin, np.cos)):
            out[:, [2 * (k - HARMONICS[0]) + j]] = space.over_rows(Acts.OUTPUT, wave(k * angle)[:, None])
    out[:, 2 * len(HARMONICS) :] = space.over_rows(Acts.OUTPUT, _bumps(position, 17))
    return out


def _slack(space: Space, columns: F64) -> F64:
    """(p,) variance of each coefficient that the encoder's codes may feign: angles of a few thousandths of a degree."""
    design = space.design
    if design.readings is None:
        return np.zeros(columns.shape[1])
    moving = space.rows.after >= 0
    dt = space.rows.dt_s[moving]
    # Within a second or so: slower than that the encoder's codes average out.
    span = max(2, round(1.0 / float(np.median(dt))))
    slack = np.empty(columns.shape[1])
    for k, column in enumerate(columns.T):
        angle = np.cumsum(column[moving] * dt) / space.scale_factor
        swing = angle[span:] - angle[:-span] if len(angle) > 2 * span else angle
        slack[k] = (FEIGNED_STEPS * design.readings.step_deg) ** 2 / max(float(swing.var()) / 2.0, 1e-300)
    return slack


def _basis(columns: F64, base: F64) -> F64:
    """(n, q) orthogonal columns that span what ``columns`` (n, p), which are used up, add to ``base`` (n, b)."""
    own, _ = np.linalg.qr(base)
    size = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    columns /= np.where(size > 0.0, size, 1.0)
    for _ in range(2):  # rounding leaves a little the first time
        _take_out(columns, own)
    power, vectors = np.linalg.eigh(columns.T @ columns)
    kept = power > 1e-4 * power.max(initial=0.0)
    return np.asarray(columns @ (vectors[:, kept] / np.sqrt(power[kept])))


def _take_out(columns: F64, own: F64) -> None:
    """Leaves of the columns (n, p), in place, what the orthonormal ``own`` (n, b) do not span."""
    for begin in range(0, columns.shape[1], TOGETHER):
        few = columns[:, begin : begin + TOGETHER]
        few -= own @ (own.T @ few)


def _bumps(values: F64, count: int) -> Operator:
    """Sparse (k, count): triangles that sum to one, evenly spread over the values."""
    from scipy.sparse import csr_array

    place = (values - values.min()) * ((count - 1) / np.ptp(values))
    left = np.clip(place.astype(np.int64), 0, count - 2)
    k, share = np.arange(len(values)), place - left
    at = (np.concatenate([k, k]), np.concatenate([left, left + 1]))
    return csr_array((np.concatenate([1.0 - share, share]), at), shape=(len(values), count))


def _curved(bumps: Operator, centres: F64) -> F64:
    """(count, q) how bumps form what has no mean and no slope where the record was."""
    occupied = np.asarray(bumps.sum(axis=0)).ravel()
    used = occupied > 20.0
    constraints = np.stack([occupied[used], occupied[used] * centres[used]])
    weights = np.zeros((len(centres), max(int(used.sum()) - 2, 0)))
    weights[used] = np.linalg.svd(constraints, full_matrices=True)[2][2:].T
    return weights


def _since_reversal(direction: F64, interval_s: float) -> F64:
    """(k, p) which stretch of time after the last reversal, signed by the direction."""
    k = np.arange(len(direction))
    turned = np.concatenate([[0], np.flatnonzero(np.diff(direction) != 0.0) + 1])
    since = (k - turned[np.searchsorted(turned, k, side="right") - 1]) * interval_s
    inside = [(since >= a) & (since < b) for a, b in pairwise(SINCE_REVERSAL_S)]
    return np.column_stack([np.where(part, direction, 0.0) for part in inside])
