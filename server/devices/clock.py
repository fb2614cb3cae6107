"""How the host's clock and the DAQ's belong together, from when samples arrived.

A sample can only arrive late. So over (DAQ time, host time of arrival − DAQ time) the true relation is a line on or
below every point. Its slope, the skew, is that of the edge of their lower convex hull that spans the middle of a long
window (the classical one-way estimate; Moon, Skelly and Towsley, 1999); its height is that of the promptest arrival
of the last half minute, because crystals wander. What is left is the least transfer time, which no one-way measurement
can show: about 1 to 2 ms on USB, constant, and a free parameter of the integral fit.
"""

from bisect import bisect_right
from collections import deque

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

SKEW_S = 300.0
OFFSET_S = 30.0
MOST_SKEW = 2e-4  # two crystals differ by some 1e-4: a steeper edge is a late arrival in a short window


class ClockRelation:
    """Feed every arrival to `add`; `to_daq` turns host times into DAQ times."""

    def __init__(self) -> None:
        self._hull: list[tuple[float, float]] = []
        self._recent: deque[tuple[float, float]] = deque()
        self._origin_s: float | None = None
        self._offset_s = 0.0
        self.skew = 0.0

    def add(self, daq_time_s: float, host_time_s: float) -> None:
        """The sample taken at `daq_time_s` was in the host's hands at `host_time_s`; DAQ times only grow."""
        if self._origin_s is None:
            self._origin_s = host_time_s - daq_time_s
        point = daq_time_s, host_time_s - daq_time_s - self._origin_s
        hull, recent = self._hull, self._recent
        while len(hull) > 1 and _on_or_above(hull[-1], hull[-2], point):
            hull.pop()
        hull.append(point)
        while len(hull) > 2 and hull[1][0] < daq_time_s - SKEW_S:
            del hull[0]
        recent.append(point)
        while recent[0][0] < daq_time_s - OFFSET_S:
            recent.popleft()
        self.skew = self._slope()
        self._offset_s = min(late - self.skew * time for time, late in recent)

    @property
    def offset_s(self) -> float:
        """The host's clock at the DAQ's zero, up to the least transfer time."""
        return (self._origin_s or 0.0) + self._offset_s

    def to_daq(self, host_time_s: F64) -> F64:
        """DAQ times (n,) of host times (n,)."""
        return (host_time_s - self.offset_s) / (1.0 + self.skew)

    def _slope(self) -> float:
        times = [time for time, _ in self._hull]
        i = bisect_right(times, 0.5 * (times[0] + times[-1]))
        if not 0 < i < len(times):
            return 0.0
        (t0, d0), (t1, d1) = self._hull[i - 1 : i + 1]
        return max(-MOST_SKEW, min((d1 - d0) / (t1 - t0), MOST_SKEW))


def _on_or_above(b: tuple[float, float], a: tuple[float, float], c: tuple[float, float]) -> bool:
    """Whether b lies on or above the line from a to c."""
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])
