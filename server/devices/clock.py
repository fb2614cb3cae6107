"""How the host's clock and the DAQ's belong together, from when samples arrived.

A sample can only arrive late. So over (DAQ time, host time of arrival − DAQ time) the true relation is a line on or
below every point. Its slope, the skew, is that of the edge of their lower convex hull that spans the middle of a long
window (the classical one-way estimate; Moon, Skelly and Towsley, 1999); its height is that of the promptest arrival
of the last half minute, because crystals wander. What is left is the least transfer time, which no one-way measurement
can show: about 1 to 2 ms on USB, constant, and a free parameter of the integral fit.
"""

from bisect import bisect_right
from collections import deque
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

SKEW_S = 300.0
OFFSET_S = 30.0
BIN_S = 0.5  # within a bin only the promptest arrival is kept


class ClockRelation:
    """Feed every arrival to `add`; `to_daq` turns host times into DAQ times."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, float]] = deque()
        self._origin_s = 0.0
        self._offset_s = 0.0
        self._skew = 0.0

    def add(self, daq_time_s: float, host_time_s: float) -> None:
        """The sample taken at `daq_time_s` was in the host's hands at `host_time_s`."""
        if not self._points:
            self._origin_s = host_time_s - daq_time_s
        lateness = host_time_s - daq_time_s - self._origin_s
        last = self._points[-1] if self._points else None
        if last is not None and int(last[0] / BIN_S) == int(daq_time_s / BIN_S):
            if lateness >= last[1]:
                return
            self._points.pop()
        self._points.append((daq_time_s, lateness))
        while self._points[0][0] < daq_time_s - SKEW_S:
            self._points.popleft()
        self._fit()

    def to_daq(self, host_time_s: F64) -> F64:
        """DAQ times (n,) of host times (n,)."""
        return (host_time_s - self._origin_s - self._offset_s) / (1.0 + self._skew)

    def _fit(self) -> None:
        hull: list[tuple[float, float]] = []
        for point in self._points:
            while len(hull) > 1 and _turns_down(hull[-2], hull[-1], point):
                hull.pop()
            hull.append(point)
        times = [time for time, _ in hull]
        middle = 0.5 * (times[0] + times[-1])
        i = min(max(bisect_right(times, middle), 1), len(hull) - 1)
        (t0, d0), (t1, d1) = hull[i - 1], hull[i]
        # Two crystals differ by some 1e-4 at most: a steeper edge is a late arrival in a short window.
        self._skew = float(np.clip((d1 - d0) / (t1 - t0), -2e-4, 2e-4)) if t1 > t0 else 0.0
        now = self._points[-1][0]
        recent = takewhile(lambda point: point[0] >= now - OFFSET_S, reversed(self._points))
        self._offset_s = min(late - self._skew * time for time, late in recent)


def _turns_down(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    """True where b lies on or above the line from a to c."""
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])
