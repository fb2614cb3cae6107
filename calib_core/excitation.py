"""Motions for an experiment, as CONTRACT 3 writes them: what a rig could do, its steps, and the path that results.

A list of excitations, done one after another, is one experiment. The menu holds METHOD 4's "excite it with" column for
a rig's own limits, at frequencies that do not repeat the same encoder codes each cycle (METHOD 2).
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_core.gyro_models import PRESETS, GyroModel
from calib_core.problem import Problem
from calib_core.sequence import PROFILES, Axis, Motion, Move, Plan, State, Step, Wave

F64 = NDArray[np.float64]

KINDS = ("sine", "multisine", "staircase", "hold", "poses", "heat")
LISTS = ("amplitude_deg", "frequency_hz", "rates_dps", "angles_deg")
BETWEEN_DPS, POSE_DPS = 60.0, 50.0
STROKE_S, REST_S = 1.8, 0.5
FAR_DEG = 120.0
"""As far as the six states go; the table's wiring is known to bear it."""
NEAR_TOP = 0.97
"""Of the top speed that sensor and servo share: a servo is a per cent or two off its speed."""
HEAT_DEGC, HEAT_S = 10.0, 25.0
"""A hair dryer at arm's length: so much warmer in the end, with this time constant, up as well as down."""


@dataclass(frozen=True)
class Excitation:
    """One entry of CONTRACT 3's ``motion``. ``axis`` also names where to look in a hold."""

    axis: str
    kind: str
    duration_s: float
    amplitude_deg: tuple[float, ...] = ()
    frequency_hz: tuple[float, ...] = ()
    rates_dps: tuple[float, ...] = ()
    angles_deg: tuple[float, ...] = ()

    def to_json(self) -> dict[str, Any]:
        lists = {name: list(getattr(self, name)) for name in LISTS if getattr(self, name)}
        return {"axis": self.axis, "kind": self.kind, **lists, "duration_s": self.duration_s}

    @classmethod
    def from_json(cls, given: Mapping[str, Any]) -> "Excitation":
        """Raises Problem for a kind that does not exist, a list it needs that is missing, or what is no number."""
        kind, axis = str(given.get("kind")), str(given.get("axis"))
        needed = {"sine": LISTS[:2], "multisine": LISTS[:2], "staircase": LISTS[2:3], "poses": LISTS[3:]}.get(kind, ())
        if kind not in KINDS or axis not in ("x", "z"):
            raise Problem("experiment.motion", kind=kind, axis=axis, allowed=", ".join(KINDS))
        try:
            lists = {name: tuple(float(value) for value in given.get(name) or ()) for name in LISTS}
            duration = float(given.get("duration_s", math.nan))
        except (TypeError, ValueError):
            raise Problem("experiment.numbers", kind=kind) from None
        numbers = [duration, *(value for values in lists.values() for value in values)]
        lengths = {len(lists[name]) for name in needed}
        if not all(map(math.isfinite, numbers)) or not 0.0 < duration <= 3600.0 or (needed and lengths & {0}):
            raise Problem("experiment.numbers", kind=kind)
        if len(lengths) > 1 or min(lists["rates_dps"], default=1.0) <= 0.0:
            raise Problem("experiment.numbers", kind=kind)
        return cls(axis, kind, duration, **lists)

    def steps(self, segment: str, at_deg: Mapping[str, float]) -> Iterator[Step]:
        """Its steps, all of one segment; ``at_deg``: where the axes stand. Ends wherever its last motion does."""
        here = at_deg.get(self.axis, 0.0)
        if self.kind in ("hold", "heat"):
            yield Step(segment, (), _rows(self.duration_s), keep_fast=self.kind == "hold", heater=self.kind == "heat")
        elif self.kind in ("sine", "multisine"):
            if here:
                yield _go(segment, self.axis, here, 0.0, POSE_DPS)
            wave = Wave(self.axis, self.amplitude_deg, self.frequency_hz, self.duration_s)
            yield Step(segment, (wave,), _rows(self.duration_s + REST_S))
        elif self.kind == "poses":
            travel = sum(abs(a - b) for a, b in zip(self.angles_deg, (here, *self.angles_deg), strict=False))
            dwell = max(REST_S, (self.duration_s - travel / POSE_DPS) / len(self.angles_deg))
            for angle in self.angles_deg:
                yield _go(segment, self.axis, here, angle, POSE_DPS, dwell)
                here = angle
        else:
            left = self.duration_s
            for rate in cycle(self.rates_dps):
                end = min(rate * STROKE_S / 2.0, FAR_DEG)
                ways = ((-end, BETWEEN_DPS), (end, rate), (-end, rate))
                strokes = [_go(segment, self.axis, a, b, v) for a, (b, v) in zip((here, -end, end), ways, strict=True)]
                left -= sum(step.duration_s for step in strokes)
                if left < -1e-6:
                    return
                yield from strokes
                here = -end


def steps(motion: Sequence[Excitation], experiment: str) -> list[Step]:
    """All steps of an experiment with the segments ``experiment/<id>/<number>-<kind>``; the axes come back to 0."""
    at_deg: dict[str, float] = {}
    found: list[Step] = []
    for number, excitation in enumerate(motion, 1):
        for step in excitation.steps(f"experiment/{experiment}/{number}-{excitation.kind}", at_deg):
            found.append(step)
            at_deg |= {m.axis: float(_angle(m, at_deg.get(m.axis, 0.0), np.array([np.inf]))[0]) for m in step.motions}
    found += [_go("move", axis, angle, 0.0, POSE_DPS) for axis, angle in at_deg.items() if abs(angle) > 1e-6]
    return [*found, Step("hold", (), 1.0)]


def plan_of(
    motion: Sequence[Excitation],
    *,
    experiment: str,
    axis: str,
    gyro_model: GyroModel = PRESETS["LPY503AL-OUT"],
    seed: int = 0,
) -> Plan:
    """The plan of one state, ``experiment``: both axes to 0, a rest, the motion. ``axis`` is the one in question."""
    home = tuple(Move(name, 0.0, POSE_DPS) for name in ("x", "z"))
    begin = [Step("move", home, _rows(150.0 / POSE_DPS + REST_S)), Step("hold", (), 3.0, keep_fast=True)]
    state = State("experiment", axis, "experiment", (*begin, *steps(motion, experiment)))
    asked = {"id": experiment, "axis": axis, "motion": [e.to_json() for e in motion]}
    return Plan("standard", seed, PROFILES["standard"].repeat_readings, {}, (state,), gyro_model, asked)


def plan_from_json(given: Mapping[str, Any]) -> Plan:
    """The inverse of such a plan's ``to_json``."""
    asked = given["experiment"]
    return plan_of(
        [Excitation.from_json(e) for e in asked["motion"]],
        experiment=asked["id"],
        axis=asked["axis"],
        gyro_model=GyroModel.from_json(given["gyro_model"]),
        seed=given["seed"],
    )


def commanded(steps: Sequence[Step], rate_hz: float) -> dict[str, F64]:
    """(n,) the angle that each axis is sent to, deg, at ``rate_hz`` from when the first step begins at 0."""
    axes = sorted({motion.axis for step in steps for motion in step.motions} | {"x", "z"})
    parts: dict[str, list[F64]] = {axis: [] for axis in axes}
    for step in steps:
        time = np.arange(round(step.duration_s * rate_hz)) / rate_hz
        moving = {motion.axis: motion for motion in step.motions}
        for axis, before in parts.items():
            here = float(before[-1][-1]) if before else 0.0
            before.append(_angle(moving[axis], here, time) if axis in moving else np.full(len(time), here))
    return {axis: np.concatenate(angles) for axis, angles in parts.items()}


def menu(axis: str, rig: Mapping[str, Axis], sensor_dps: Mapping[str, float], *, heat: bool) -> list[list[Excitation]]:
    """What this rig could do to tell effects on ``axis`` apart, each within its limits and those of the sensor."""
    offered = []
    own, other = rig[axis], next((name for name in rig if name != axis), None)
    top = NEAR_TOP * min(own.max_rate_dps, sensor_dps.get(axis, math.inf))
    reach = _reach(own)

    def waves(kind: str, hz: tuple[float, ...], shares: tuple[float, ...], seconds: float, on: str) -> Excitation:
        fastest = top if on == axis else NEAR_TOP * min(rig[on].max_rate_dps, sensor_dps.get(on, math.inf))
        far = _reach(rig[on])
        sizes = [
            math.floor(1e3 * min(s * fastest / (2.0 * math.pi * f), s * min(far, 30.0))) / 1e3
            for f, s in zip(hz, shares, strict=True)
        ]
        return Excitation(on, kind, seconds, amplitude_deg=tuple(sizes), frequency_hz=hz)

    fast = (1.0137, 2.0171, 4.0313)
    # A stroke at full speed needs its way: where the axis cannot go far it is slower.
    quick = top if reach == FAR_DEG else min(top, 2.0 * reach / STROKE_S)
    rates = tuple(math.floor(10.0 * quick * part) / 10.0 for part in (0.1, 0.25, 0.45, 0.65, 0.85, 1.0))
    poses = tuple(math.trunc(reach * part) for part in (-1.0, -0.5, 0.25, 0.75, 1.0, 0.5, -0.25, -0.75, 0.0))
    slow = tuple(min(rate, quick) for rate in (4.0, 9.0, 19.0))
    offered += [
        [waves("multisine", fast, (0.34, 0.33, 0.33), 100.0, axis)],
        [waves("multisine", fast, (0.05, 0.1, 0.85), 100.0, axis)],
        [waves("sine", (0.2513,), (1.0,), 99.5, axis)],
        [waves("multisine", (0.1037, 0.7193), (0.3, 0.1), 100.0, axis)],
        [Excitation(axis, "sine", 98.5, amplitude_deg=(math.floor(1e3 * reach) / 1e3,), frequency_hz=(0.0203,))],
        [Excitation(axis, "staircase", 100.0, rates_dps=rates)],
        [Excitation(axis, "staircase", 100.0, rates_dps=rates[2:])],
        [Excitation(axis, "staircase", 100.0, rates_dps=slow)],
        [Excitation(axis, "poses", 100.0, angles_deg=poses)],
        [Excitation(axis, "hold", 100.0)],
    ]
    if axis != "x" and "x" in rig:
        offered.append(
            [Excitation("x", "poses", 100.0, angles_deg=tuple(math.trunc(_reach(rig["x"]) * p / reach) for p in poses))]
        )
    if other is not None:
        offered.append([waves("sine", (0.4019,), (1.0,), 100.0, other)])
    if heat:
        warmed = [Excitation(axis, "hold", 20.0), Excitation(axis, "heat", 60.0)]
        offered += [
            [*warmed, Excitation(axis, "hold", 60.0)],
            [*warmed[1:], Excitation(axis, "staircase", 80.0, rates_dps=rates[2:])],
        ]
    return offered


def warming(steps: Sequence[Step], rate_hz: float) -> F64:
    """(n,) by how much a heater has warmed the board, °C, from none."""
    warm, parts = 0.0, []
    for step in steps:
        time = np.arange(round(step.duration_s * rate_hz)) / rate_hz
        goal = HEAT_DEGC if step.heater else 0.0
        parts.append(goal + (warm - goal) * np.exp(-time / HEAT_S))
        warm = float(goal + (warm - goal) * math.exp(-step.duration_s / HEAT_S))
    return np.concatenate(parts)


def _reach(axis: Axis) -> float:
    return min(-axis.min_deg, axis.max_deg, FAR_DEG)


def _go(segment: str, axis: str, here: float, to_deg: float, rate_dps: float, rest_s: float = REST_S) -> Step:
    return Step(segment, (Move(axis, to_deg, rate_dps),), _rows(abs(to_deg - here) / rate_dps + rest_s))


def _rows(duration_s: float) -> float:
    """A whole number of rows."""
    return math.ceil(duration_s * 100.0 - 1e-6) / 100.0


def _angle(motion: Motion, from_deg: float, time_s: F64) -> F64:
    """``motion.angle_deg`` at many times (n,)."""
    t = np.maximum(time_s - motion.start_s, 0.0)
    if isinstance(motion, Move):
        way = motion.to_deg - from_deg
        return from_deg + np.copysign(np.minimum(abs(way), motion.rate_dps * t), way)
    t = np.minimum(t, motion.duration_s)
    angle = np.zeros_like(t)
    for amplitude, frequency in zip(motion.amplitudes_deg, motion.frequencies_hz, strict=True):
        angle += amplitude * np.sin(2.0 * math.pi * frequency * t)
    return np.where(time_s < motion.start_s, from_deg, angle)
