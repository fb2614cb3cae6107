"""A simulated Dynamixel servo: constant-speed profile, top speed, PD lag, friction, 10-bit encoder.

The profile is a polyline, and a critically damped second-order lag answers each of its pieces in closed form.
So position and rate are exact at any time asked, without a time step. Facts and their standing: HARDWARE.md.
"""

import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

STEP_DEG = 300.0 / 1023.0  # goal and present position: 10 bits over 300°
SPEED_DPS = 0.666  # one step of the moving-speed register, 0.111 rpm
CENTRE = 512


def to_code(angle_deg: F64 | float) -> NDArray[np.int64]:
    """Register value of an angle: 0…1023, 512 at 0°."""
    code: NDArray[np.int64] = np.clip(np.rint(angle_deg / STEP_DEG) + CENTRE, 0, 1023).astype(np.int64)
    return code


def to_deg(code: NDArray[np.int64]) -> F64:
    """The angle a register value stands for."""
    return STEP_DEG * np.asarray(code - CENTRE, np.float64)


@dataclass(frozen=True)
class ServoSpec:
    """One servo as built. `lag_s` is how far it runs behind its profile; `stop_short_deg` is the friction's part
    of where it comes to rest, `stop_scatter_deg` the part that differs from stop to stop."""

    part: str
    dps_per_volt: float
    supply_V: float = 12.1
    lag_s: float = 0.04
    speed_error: float = 0.0
    stop_short_deg: float = 0.08
    stop_scatter_deg: float = 0.03

    @property
    def top_rate_dps(self) -> float:
        return self.dps_per_volt * self.supply_V


RX28 = ServoSpec("RX-28", dps_per_volt=27.0, lag_s=0.040)
RX64 = ServoSpec("RX-64", dps_per_volt=21.0, lag_s=0.050)


@dataclass(slots=True)
class _Piece:
    """From `start_s` the profile is profile_deg + rate_dps·s; the shaft is that − lag + (a + b·s)·exp(−ωs)."""

    start_s: float
    profile_deg: float
    rate_dps: float
    a: float
    b: float


class Servo:
    """One shaft. Times are true seconds and may only go forward between calls of `command` and `stop`."""

    def __init__(self, spec: ServoSpec, rng: np.random.Generator, start_deg: float = 0.0) -> None:
        self.spec = spec
        self.torque_on = False
        self.jammed = False
        self._omega = 2.0 / spec.lag_s
        self._rng = rng
        self._scatter_deg = 0.0
        self._pieces = [_Piece(-math.inf, start_deg, 0.0, 0.0, 0.0)]
        self._starts = [-math.inf]

    def command(self, goals: Iterable[tuple[float, float, float]]) -> None:
        """Queue (time_s, goal_deg, rate_dps), in time order; they replace what was queued after the first of them.

        Goal and speed are rounded to the registers' steps, as the real servo takes them.
        """
        self.torque_on = True
        for time_s, goal_deg, rate_dps in goals:
            if self.jammed:
                return
            at_deg = self._cut(time_s)
            if self._pieces[-1].rate_dps == 0.0:  # a goal that finds it moving only prolongs the same motion
                self._scatter_deg = float(np.clip(self._rng.normal(0.0, self.spec.stop_scatter_deg), -0.06, 0.06))
            rate = max(1, round(rate_dps / SPEED_DPS)) * SPEED_DPS * (1.0 + self.spec.speed_error)
            rate = min(rate, self.spec.top_rate_dps)
            goal = float(to_deg(to_code(goal_deg))) + self._scatter_deg
            way = goal - at_deg
            way -= math.copysign(min(self.spec.stop_short_deg, abs(way)), way)
            if way:
                self._append(time_s, at_deg, math.copysign(rate, way))
            self._append(time_s + abs(way) / rate, at_deg + way, 0.0)

    def stop(self, time_s: float, *, jam: bool = False) -> None:
        """Torque off: what was queued is forgotten, the shaft coasts to rest. `jam`: it stops dead and stays."""
        self._cut(time_s)
        angle, rate = self._state(time_s)
        coast = 0.0 if jam else rate / self._omega
        self._push(_Piece(time_s, angle + coast, 0.0, -coast, 0.0))
        self.torque_on = False
        self.jammed = self.jammed or jam

    def motion(self, time_s: F64) -> tuple[F64, F64]:
        """Angle (deg) and rate (deg/s) of the shaft at increasing times (n,)."""
        angle, rate = np.empty_like(time_s), np.empty_like(time_s)
        if not len(time_s):
            return angle, rate
        first, last = bisect_right(self._starts, time_s[0]) - 1, bisect_right(self._starts, time_s[-1])
        edges = [0, *np.searchsorted(time_s, self._starts[first + 1 : last]).tolist(), len(time_s)]
        for piece, (start, stop) in zip(self._pieces[first:last], pairwise(edges), strict=True):
            if start == stop:
                continue
            if piece.a == piece.b == piece.rate_dps == 0.0:
                angle[start:stop], rate[start:stop] = piece.profile_deg, 0.0
                continue
            s = time_s[start:stop] - piece.start_s
            decay = np.exp(-self._omega * s)
            swing = piece.a + piece.b * s
            lagged = piece.profile_deg - self.spec.lag_s * piece.rate_dps
            angle[start:stop] = lagged + piece.rate_dps * s + swing * decay
            rate[start:stop] = piece.rate_dps + (piece.b - self._omega * swing) * decay
        return angle, rate

    def forget(self, before_s: float) -> None:
        """Drop pieces that end before this time."""
        past = bisect_right(self._starts, before_s) - 1
        if past > 256:
            del self._pieces[:past], self._starts[:past]

    def _state(self, time_s: float) -> tuple[float, float]:
        """Angle and rate now, in the last piece."""
        piece = self._pieces[-1]
        if piece.a == piece.b == piece.rate_dps == 0.0:
            return piece.profile_deg, 0.0
        s = time_s - piece.start_s
        decay, swing = math.exp(-self._omega * s), piece.a + piece.b * s
        angle = piece.profile_deg + piece.rate_dps * (s - self.spec.lag_s) + swing * decay
        return angle, piece.rate_dps + (piece.b - self._omega * swing) * decay

    def _cut(self, time_s: float) -> float:
        """Forget pieces from `time_s` on; where the profile is then."""
        while self._starts[-1] >= time_s:
            self._pieces.pop()
            self._starts.pop()
        piece = self._pieces[-1]
        return piece.profile_deg + (piece.rate_dps * (time_s - piece.start_s) if piece.rate_dps else 0.0)

    def _append(self, time_s: float, profile_deg: float, rate_dps: float) -> None:
        """The profile goes on at another rate; the shaft's angle and rate go on unbroken."""
        angle, rate = self._state(time_s)
        a = angle - profile_deg + self.spec.lag_s * rate_dps
        self._push(_Piece(time_s, profile_deg, rate_dps, a, rate - rate_dps + self._omega * a))

    def _push(self, piece: _Piece) -> None:
        self._pieces.append(piece)
        self._starts.append(piece.start_s)
