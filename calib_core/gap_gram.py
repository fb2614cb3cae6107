"""Gram matrices of whitened columns, in parts that lie apart in time: gains, coefficients and errors on unseen data.

METHOD 3, step 3: one pass over the rows; then gains are Schur complements, and a fit without a part is one to G − G_f.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

FOLDS = 8
BLOCK_S = 5.0
MOST_BLOCKS = 64
CERTAIN = 1e6
"""A prior so many times sharper than all the data."""
SPANNED = 1e-7
"""A column of whose square less than this is its own is spanned by those before it."""


@dataclass(frozen=True, eq=False)
class Folds:
    """Blocks of time, dealt out in turn, so that every fold has something of every part of the record."""

    edges_s: F64
    """(blocks + 1,)"""
    edges: Ints
    """(blocks + 1,) the first row of each block, and the number of rows."""

    @classmethod
    def of(cls, time_s: F64) -> Folds:
        """Of rows at increasing times (n,): blocks of 5 s, or longer where these were too many; two at least."""
        begin, end = float(time_s[0]), float(time_s[-1])
        blocks = int(np.clip((end - begin) // BLOCK_S, 2, MOST_BLOCKS))
        edges_s = np.linspace(begin, end, blocks + 1)
        inner = np.searchsorted(time_s, edges_s[1:-1])
        return cls(edges_s, np.concatenate([[0], inner, [len(time_s)]]))

    def __len__(self) -> int:
        return min(FOLDS, len(self.edges) - 1)

    @property
    def block_s(self) -> float:
        return float(self.edges_s[1] - self.edges_s[0])

    def of_time(self, time_s: F64) -> Ints:
        """(w,) the fold that each of the times lies in."""
        block = np.searchsorted(self.edges_s, time_s, side="right") - 1
        return np.asarray(np.clip(block, 0, len(self.edges) - 2) % len(self))

    def products(self, left: F64, right: F64) -> F64:
        """(folds, p, q) leftᵀ·right, fold by fold."""
        out = np.zeros((len(self), left.shape[1], right.shape[1]))
        for block in range(len(self.edges) - 1):
            part = slice(self.edges[block], self.edges[block + 1])
            out[block % len(self)] += left[part].T.astype(float) @ right[part]
        return out


class Gram:
    """The scaled Gram matrix of [residual, base, columns], and what follows from it."""

    def __init__(self, parts: F64, prior: F64) -> None:
        """``parts`` (folds, q, q) are the unscaled sums over each fold; ``prior`` (b,) is known of the base's
        coefficients beforehand: one over their standard deviation."""
        self.parts, self.prior, self.base = parts, prior, len(prior)
        total = parts.sum(axis=0)
        inner = np.arange(1, 1 + self.base)
        total[inner, inner] += prior**2
        scale = np.sqrt(np.diag(total))
        self.scale = np.where(scale > 0.0, scale, 1.0)
        self.matrix = total / np.outer(self.scale, self.scale)

    def known(self, values: Mapping[int, float]) -> Gram:
        """The same with these coefficients, by their column, taken for granted: their part of the residual is gone.

        Columns of the base stay, with a prior that leaves nothing to estimate.
        """
        turn, prior = np.eye(len(self.scale)), self.prior.copy()
        for column, value in values.items():
            turn[column, 0] = -value
            if column <= self.base:
                prior[column - 1] = CERTAIN * self.scale[column]
        return Gram(turn.T @ self.parts @ turn, prior)

    def without(self, kept: Sequence[int]) -> F64:
        """The matrix with the base and the columns ``kept`` (indices from 1 + base) projected out."""
        held = self._held(kept)
        block = self.matrix[np.ix_(held, held)]
        weights = np.linalg.lstsq(block, self.matrix[held], rcond=1e-12)[0]
        out: F64 = self.matrix - self.matrix[:, held] @ weights
        return out

    def gain(self, projected: F64, columns: Sequence[int], slack: F64, *, fixed: bool = False) -> tuple[float, float]:
        """2ΔlnL of adding ``columns`` to what is ``projected`` out, and what of it coefficients of the variances
        ``slack`` (p,) could not feign.

        NaN where what is projected out spans the columns. A coefficient that is ``fixed`` is one.
        """
        block = projected[np.ix_(columns, columns)]
        if np.diag(block).min() < SPANNED:
            return float("nan"), float("nan")
        size = self.scale[list(columns)]
        score = projected[list(columns), 0] * self.scale[0]
        if fixed:
            gain = float(2.0 * score[0] * size[0] - block[0, 0] * size[0] ** 2)
            return gain, gain
        inverse = 1.0 / block if len(columns) == 1 else np.linalg.pinv(block, rcond=1e-9, hermitian=True)
        value = inverse @ score
        gain = float(score @ value)
        if not slack.any():
            return gain, gain
        return gain, float(value @ np.linalg.solve(inverse + np.diag(slack * size**2), value))

    def chi2(self, columns: Sequence[int]) -> float:
        """What base and ``columns`` leave of the residual's square."""
        held = self._held(columns)
        weights = np.linalg.lstsq(self.matrix[np.ix_(held, held)], self.matrix[held, 0], rcond=1e-12)[0]
        return float((1.0 - self.matrix[0, held] @ weights) * self.scale[0] ** 2)

    def coefficients(self, columns: Sequence[int]) -> tuple[F64, F64]:
        """Coefficients and covariance of the base's corrections and of ``columns``."""
        held = self._held(columns)
        inverse = np.linalg.pinv(self.matrix[np.ix_(held, held)], rcond=1e-12, hermitian=True)
        size = self.scale[held]
        return inverse @ self.matrix[held, 0] * self.scale[0] / size, inverse / np.outer(size, size)

    def left_out(self, columns: Sequence[int]) -> tuple[float, F64]:
        """The squares that remain in each fold after a fit to the others, in all; and those fits' coefficients
        (folds, b + p).

        A column that only one fold knows is worth nothing there, and does no harm: its coefficient is taken to be of
        the size that the whole record gives it.
        """
        held = self._held(columns)
        size = self.scale[held]
        own = self.parts[:, held][:, :, held] / np.outer(size, size)
        score = self.parts[:, held, 0] / size
        ridge = np.zeros(len(held))
        if columns:
            whole = self.coefficients(columns)[0] * size
            ridge[self.base :] = 1.0 / np.maximum(whole[self.base :] ** 2, 1.0)
        rest = self.matrix[np.ix_(held, held)] + np.diag(ridge + 1e-12) - own
        values = np.linalg.solve(rest, (score.sum(axis=0) - score)[:, :, None])[:, :, 0]
        squares = self.parts[:, 0, 0] - 2.0 * np.einsum("fi,fi->f", values, score)
        squares += np.einsum("fi,fij,fj->f", values, own, values)
        return float(squares.sum()), values / size

    def scores(self, models: Ints) -> F64:
        """(m,) what each of the models (m, p), columns beside the base, leaves of each fold fitted to the others: all
        at once."""
        held = np.concatenate([np.tile(np.arange(1, 1 + self.base), (len(models), 1)), models], axis=1)
        size = self.scale[held]
        own = self.parts[:, held[:, :, None], held[:, None, :]] / (size[:, :, None] * size[:, None, :])
        score = self.parts[:, held, 0] / size
        whole = self.matrix[held[:, :, None], held[:, None, :]] + 1e-9 * np.eye(held.shape[1])
        values = np.linalg.solve(whole - own, (score.sum(axis=0) - score)[..., None])[..., 0]
        squares = self.parts[:, 0, 0][:, None] - 2.0 * np.einsum("fmi,fmi->fm", values, score)
        return np.asarray((squares + np.einsum("fmi,fmij,fmj->fm", values, own, values)).sum(axis=0))

    def _held(self, columns: Sequence[int]) -> list[int]:
        return [*range(1, 1 + self.base), *columns]


class Bank:
    """Whitened columns with which many models are formed, and their Gram matrix."""

    def __init__(self, folds: Folds, white: F64) -> None:
        self.folds, self.white = folds, white
        self.parts = folds.products(white, white)

    def parts_with(self, inside: Sequence[int], own: Sequence[F64], *, folds: bool) -> F64:
        """(folds or 1, q, q) of the bank's columns ``inside`` and others of one's ``own`` behind them."""
        known = self.parts[np.ix_(range(len(self.parts)), inside, inside)]
        if not folds:
            known = known.sum(axis=0, keepdims=True)
        if not own:
            return known
        extra, chosen = np.column_stack(own), self.white[:, inside]
        if folds:
            cross, among = self.folds.products(chosen, extra), self.folds.products(extra, extra)
        else:
            cross, among = (chosen.T.astype(float) @ extra)[None], (extra.T @ extra)[None]
        return np.concatenate(
            [np.concatenate([known, cross], axis=2), np.concatenate([cross.transpose(0, 2, 1), among], axis=2)], axis=1
        )
