"""Rows of a rate equation with correlated errors, and their whitening by one lower-banded solve.

Each row says: mean output over a short interval = columns · parameters + gyro noise + encoder error. Gyro noise is
white plus AR(1). A row between two encoder readings carries (S/dt)·(error before - error after), so neighbours share
an error; rows at rest or with a reference rate carry none. METHOD 2 (n: quantisation plus a random walk), differenced.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

PER_ROW = ("time_s", "dt_s", "start", "before", "after", "white_own", "white_next")
TAIL = 512
"""Rows after a rest over which its error is followed first; doubled until it has faded."""


@dataclass(frozen=True)
class RowNoise:
    """Gyro noise in the unit of the output: ``white`` is the standard deviation of one sample."""

    white: float
    ar1: float = 0.0
    correlation_time_s: float = 0.5
    reading_deg: float = 0.0
    """Independent error of each encoder reading, beside the variance that the rows bring."""


@dataclass(frozen=True, eq=False)
class Rows:
    """n rows in time order, over m encoder readings."""

    time_s: F64
    """(n,) the middle of each row's interval."""
    dt_s: F64
    """(n,) its length."""
    start: Mask
    """(n,) True where the record was interrupted before this row: nothing is carried over."""
    before: Ints
    after: Ints
    """(n,) which reading begins and ends the interval; -1 for a row without encoder."""
    reading_variance: F64
    """(m,) deg²; a reading that stands for a whole rest has one error."""
    white_own: F64
    """(n,) variance of the row's mean if a sample's noise is white with variance 1."""
    white_next: F64
    """(n,) and its covariance with the next row: neighbours share the sample between them."""

    def __len__(self) -> int:
        return len(self.time_s)

    @cached_property
    def ends(self) -> tuple[Ints, Ints]:
        """The row that each reading (m,) ends and the row it begins; -1 where there is none."""
        m = len(self.reading_variance)
        ending, beginning = np.full(m, -1), np.full(m, -1)
        ending[self.after[self.after >= 0]] = np.flatnonzero(self.after >= 0)
        beginning[self.before[self.before >= 0]] = np.flatnonzero(self.before >= 0)
        return ending, beginning

    def take(self, chosen: Ints) -> "Rows":
        """The rows ``chosen`` (increasing); nothing is carried over where one was left out."""
        start = self.start[chosen] | (np.diff(chosen, prepend=-2) != 1)
        white_next = np.where(np.append(start[1:], True), 0.0, self.white_next[chosen])
        return replace(self.reordered(chosen), start=start, white_next=white_next)

    @cached_property
    def resting_last(self) -> Ints | None:
        """(n,) an order that puts rows without encoder behind the others; None where it is this one already."""
        order = np.argsort(self.before < 0, kind="stable")
        return None if np.array_equal(order, np.arange(len(self))) else order

    def reordered(self, order: Ints) -> "Rows":
        """The same rows in another order that keeps moving rows in theirs."""
        return replace(self, **{name: getattr(self, name)[order] for name in PER_ROW})

    def to_readings(self, values: F64) -> F64:
        """(m,) how the readings' errors (deg) meet ``values`` (n,): the adjoint of errors -> rows, for S = 1."""
        ending, beginning = self.ends
        per_dt = np.append(values / self.dt_s, 0.0)  # index -1 finds the zero
        return np.asarray(per_dt[beginning] - per_dt[ending])


class Whitener:
    """Σ⁻¹ of the rows' errors for a given S and noise, as a square root: ``whiten`` gives white errors of variance 1.

    AR(1) noise is first made short-ranged by y_j - φ·y_{j-1}; what remains has a covariance of bandwidth 2, factorised
    by LAPACK. The error of a rest's reading ties together two rows far apart, its entry and its exit; those few are
    added afterwards as rank-one terms through a symmetric square root.
    """

    def __init__(self, rows: Rows, scale_factor: float, noise: RowNoise) -> None:
        from scipy.linalg import cholesky_banded

        # Without AR(1) noise the rows at rest stand alone: put last, they leave no gap between entry and exit.
        self._order = None if noise.ar1 > 0.0 else rows.resting_last
        if self._order is not None:
            rows = rows.reordered(self._order)
        self._rows = rows
        n = len(rows)
        reading = scale_factor**2 * (rows.reading_variance + noise.reading_deg**2)
        ending, beginning = rows.ends
        far = np.flatnonzero((ending >= 0) & (beginning > ending + 1))

        # Covariance of y: each row has white noise and two readings' errors, of which it shares one with the next row.
        one = np.append(reading, 0.0)  # index -1 finds the zero
        one[far] = 0.0
        shared = np.where(rows.after[:-1] == rows.before[1:], one[rows.after[:-1]], 0.0)
        own = noise.white**2 * rows.white_own + (one[rows.before] + one[rows.after]) / rows.dt_s**2
        next_ = noise.white**2 * rows.white_next
        next_[:-1] -= shared / (rows.dt_s[:-1] * rows.dt_s[1:])

        # Covariance of y_j - φ·y_{j-1}.
        self._phi = phi = np.zeros(n)
        if noise.ar1 > 0.0:
            phi[1:] = np.exp(-np.diff(rows.time_s) / noise.correlation_time_s)
            phi[rows.start] = 0.0
            band = np.zeros((3, n))
            band[0] = own + noise.ar1**2 * (1.0 - phi**2)
            band[0, 1:] += phi[1:] * (phi[1:] * own[:-1] - 2.0 * next_[:-1])
            band[1, :-1] = next_[:-1] - phi[1:] * own[:-1]
            band[1, 1:-1] += phi[2:] * phi[1:-1] * next_[:-2]
            band[2, :-2] = -phi[2:] * next_[:-2]
        else:
            band = np.stack([own, next_])
        self._factor = cholesky_banded(band, lower=True, check_finite=False, overwrite_ab=True)
        self.log_determinant = 2.0 * float(np.log(self._factor[0]).sum())
        self._far: list[tuple[slice, F64]] = []
        if len(far):
            self._add_rests(ending[far], beginning[far], np.sqrt(reading[far]))

    def _add_rests(self, entry: Ints, leave: Ints, sigma: F64) -> None:
        """Σ += Σ_k u_k·u_kᵀ: u_k is the error of rest k, seen in its entry row and, reversed, in its exit row.

        Whitened, u_k is nothing before its entry and fades after its exit, so only that stretch is kept. With G the
        Gram matrix of the whitened u, the square root is 1 - u·W·uᵀ for W = (1 - (1 + G)^-½)/G.
        """
        rows, n, k = self._rows, len(self._rows), len(entry)
        for e, x, s in zip(entry.tolist(), leave.tolist(), sigma.tolist(), strict=True):
            length, stop = TAIL, 0
            while stop < n:
                stop = min(n, x + length)
                u = np.zeros(stop - e)
                u[0], u[x - e] = -s / rows.dt_s[e], s / rows.dt_s[x]
                u = self._lower(self._filter(u, slice(e, stop)), slice(e, stop))
                if np.abs(u[-8:]).max() < 1e-6 * np.abs(u).max():
                    break
                length *= 2
            self._far.append((slice(e, stop), u))
        gram = np.zeros((k, k))
        for i, (a, u) in enumerate(self._far):
            for j in range(i, k):
                b, v = self._far[j]
                if b.start >= a.stop:
                    break
                stop = min(a.stop, b.stop)
                gram[i, j] = gram[j, i] = u[b.start - a.start : stop - a.start] @ v[: stop - b.start]
        power, vectors = np.linalg.eigh(gram)
        power = np.maximum(power, 1e-300)
        self._weight = vectors * (-np.expm1(-0.5 * np.log1p(power)) / power) @ vectors.T
        self.log_determinant += float(np.log1p(power).sum())

    def whiten(self, columns: F64) -> F64:
        """(n,) or (n, p) in, the same shape out."""
        if self._order is None:
            return self._shrink(self._lower(self._filter(columns)))
        return self._back(self._lower(np.take(columns.T, self._order, axis=-1).T))

    def precision_times(self, white: F64) -> F64:
        """Σ⁻¹·x (n,) for a column that ``whiten`` turned into ``white``."""
        if self._order is not None:
            return self._back(self._lower(white[self._order], transposed=True))
        out = self._lower(self._shrink(white.copy()), transposed=True)
        out[:-1] -= self._phi[1:] * out[1:]
        return out

    def _filter(self, columns: F64, rows: slice = slice(None)) -> F64:
        """y_j - φ·y_{j-1} over ``rows``; before the first there is nothing."""
        out = np.array(columns, dtype=float, order="F")
        phi = self._phi[rows][1:]
        out[1:] -= (phi if columns.ndim == 1 else phi[:, None]) * columns[:-1]
        return out

    def _lower(self, columns: F64, rows: slice = slice(None), *, transposed: bool = False) -> F64:
        """Solves in place where ``columns`` is in Fortran's order."""
        from scipy.linalg.lapack import dtbtrs

        trans = "T" if transposed else "N"
        solved, _ = dtbtrs(self._factor[:, rows], columns, uplo="L", trans=trans, overwrite_b=True)
        return np.asarray(solved, dtype=float).reshape(columns.shape)

    def _back(self, columns: F64) -> F64:
        """Rows in the order of time again."""
        place = np.empty_like(self._order)
        place[self._order] = np.arange(len(place))
        return np.asarray(np.take(columns.T, place, axis=-1).T)

    def _shrink(self, columns: F64) -> F64:
        """Takes the rests' errors into account, in place."""
        if not self._far:
            return columns
        overlap = np.array([u @ columns[a] for a, u in self._far])
        for (a, u), weight in zip(self._far, self._weight @ overlap, strict=True):
            columns[a] -= np.multiply.outer(u, weight)
        return columns
