"""A gyro's output beside its reference in means over short blocks: rough, quick, and enough to see what is crossed."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_core.recording import Recording

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

BLOCK_S = 0.2
FEWEST = 20
"""A line through fewer blocks is not drawn."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """Means over blocks of equal width in which the record is whole."""

    middle_s: F64
    width_s: float
    output: F64
    own: F64
    """deg/s, of the axis itself."""
    other: F64
    """deg/s, of the first other axis that moves; zeros without one."""
    other_axis: str
    step_deg: float
    """The encoder's step; 0 for a reference rate."""

    @classmethod
    def of(cls, recording: Recording, axis: str, index: Ints, step_deg: float) -> "Blocks":
        """The rows ``index`` of the recording in blocks of 0.2 s, or of four samples where those are longer."""
        time, output = recording.time_s[index], recording.gyro(axis).values[index]
        interval = float(np.median(np.diff(time)))
        width = max(BLOCK_S, 4.0 * interval)
        edges = np.arange(time[0], time[-1], width)
        full = np.diff(np.searchsorted(time, edges)) >= 0.7 * width / interval
        own, rated = _rate(recording, axis, edges)
        others = ((a, _rate(recording, a, edges)[0]) for a in "xyz".replace(axis, ""))
        other_axis, other = next(((a, rate) for a, rate in others if rate.any()), ("", np.zeros_like(own)))
        mean = _means(edges, time, output)
        middle = edges[:-1] + width / 2.0
        return cls(middle[full], width, mean[full], own[full], other[full], other_axis, 0.0 if rated else step_deg)

    @property
    def restlessness(self) -> float:
        """Change of the output from block to block that one in ten exceeds, as a deviation: a table that only goes to
        its start does not count."""
        return float(np.quantile(np.abs(np.diff(self.output)), 0.9)) / 1.645 if len(self.output) > 2 else 0.0

    @property
    def scale_factor(self) -> float:
        """Output per deg/s, beside the other axis and a slow drift."""
        return float(self._both[0][0])

    @property
    def follows_other(self) -> bool:
        """Whether the other axis moves the output as an axis of its own would, not as a cross-axis error."""
        own, other = np.abs(self._both[0][:2])
        return bool(other > 0.5 * own)

    @cached_property
    def shares(self) -> tuple[float, float]:
        """Shares of the output's motion explained by the own and by the other axis, each beside the other."""
        design, (_, left) = self._design, self._both
        without = [_fit(np.delete(design, k, axis=1), self.output)[1] for k in (0, 1)]
        own, other = (1.0 - left / w if w > 0.0 else 0.0 for w in without)
        return own, other

    @property
    def trust(self) -> float:
        """How much of the variance of the own rate is not the encoder's step."""
        variance = float(np.var(self.own)) if len(self.own) else 0.0
        coded = self.step_deg**2 / 6.0 / self.width_s**2
        return 1.0 - coded / variance if variance > coded else 0.0

    def past(self, begin_s: F64, end_s: F64, asked: Mask) -> F64 | None:
        """(r,) the output that the motion predicts in the middle of each stretch ``asked``, nan for the others.

        The line is drawn through the blocks outside all r stretches; None where too few are left.
        """
        k = len(self.middle_s)
        inside = np.zeros(k + 1)
        np.add.at(inside, np.searchsorted(self.middle_s, begin_s - self.width_s / 2.0), 1.0)
        np.add.at(inside, np.searchsorted(self.middle_s, end_s + self.width_s / 2.0), -1.0)
        outside = np.cumsum(inside)[:k] == 0.0
        if outside.sum() < FEWEST or np.ptp(self.own[outside]) == 0.0:
            return None
        line = np.column_stack([self.own, np.ones(k)])
        weights, _ = _fit(line[outside], self.output[outside])
        rate = np.interp((begin_s + end_s) / 2.0, self.middle_s, self.own)
        return np.where(asked, weights[0] * rate + weights[1], np.nan)

    def changed(self, begin_s: F64, end_s: F64) -> Mask:
        """In which of the stretches the own rate changes by a quarter of its whole range."""
        out = np.zeros(len(begin_s), bool)
        whole = float(np.ptp(self.own)) if len(self.own) else 0.0
        half = self.width_s / 2.0
        inner = np.searchsorted(self.middle_s, [begin_s + half, end_s - half])
        for k in np.flatnonzero(inner[1] - inner[0] >= 2):
            out[k] = np.ptp(self.own[slice(*inner[:, k])]) > 0.25 * whole > 0.0
        return out

    def moving(self, time_s: F64) -> Mask:
        """(k,) during which samples the axis moves; all of them where it never does."""
        rate = np.abs(np.interp(time_s, self.middle_s, self.own)) if len(self.own) else np.zeros_like(time_s)
        moving: Mask = rate > 0.05 * rate.max()
        return moving if moving.any() else ~moving

    @cached_property
    def _design(self) -> F64:
        u = np.linspace(-1.0, 1.0, len(self.output))
        return np.column_stack([self.own, self.other, np.ones_like(u), u, u**2, u**3])

    @cached_property
    def _both(self) -> tuple[F64, float]:
        return _fit(self._design, self.output)


def _fit(design: F64, output: F64) -> tuple[F64, float]:
    """Weights and the sum of squares that is left."""
    weights = np.asarray(np.linalg.lstsq(design, output, rcond=None)[0], np.float64)
    return weights, float(np.sum((output - design @ weights) ** 2))


def _rate(recording: Recording, axis: str, edges: F64) -> tuple[F64, bool]:
    """Mean rates between ``edges``, and whether they come from a reference rate."""
    rate = recording.reference_rate(axis)
    if rate is not None:
        return _means(edges, recording.time_s, rate), True
    time, angle = recording.position(axis)
    if len(time) < 2:
        return np.zeros(len(edges) - 1), False
    return np.diff(np.interp(edges, time, angle)) / np.diff(edges), False


def _means(edges: F64, time_s: F64, values: F64) -> F64:
    """Means between ``edges`` by the trapezoid rule, samples that are NaN left out."""
    known = np.isfinite(values)
    if known.sum() < 2:
        return np.zeros(len(edges) - 1)
    time, values = time_s[known], values[known]
    total = np.concatenate([[0.0], np.cumsum(np.diff(time) * (values[1:] + values[:-1]) / 2.0)])
    return np.asarray(np.diff(np.interp(edges, time, total)) / np.diff(edges))
