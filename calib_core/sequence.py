"""The six states as data: profiles, expanded to steps of motion, and the check that walks them first.

Thesis chapter 3 and METHOD 1. A *step* is a stretch of bench time with one segment name; its motions
start together, each after its own `start_s`. Nothing here moves anything or knows a device.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from calib_core.gyro_models import PRESETS, GyroModel, Ranges, ranges_from_json
from calib_core.problem import Problem

STATES = ("estimate_x", "rate_x", "position_x", "estimate_z", "rate_z", "position_z")
MAX_FREQUENCY_HZ = 4.1  # the thesis' scope is 4 Hz (1.3); the margin is for METHOD 2's unlocked frequencies


@dataclass(frozen=True)
class Move:
    """Turn one axis to an angle at constant rate, `start_s` after the step began."""

    axis: str
    to_deg: float
    rate_dps: float
    start_s: float = 0.0

    def angle_deg(self, from_deg: float, time_s: float) -> float:
        """The commanded angle, `time_s` after the step began at `from_deg`."""
        travelled = self.rate_dps * max(0.0, time_s - self.start_s)
        way = self.to_deg - from_deg
        return from_deg + math.copysign(min(abs(way), travelled), way)

    @property
    def peak_rate_dps(self) -> float:
        return self.rate_dps


@dataclass(frozen=True)
class Wave:
    """Swing one axis about 0°: a sum of sines, for `duration_s`."""

    axis: str
    amplitudes_deg: tuple[float, ...]
    frequencies_hz: tuple[float, ...]
    duration_s: float
    start_s: float = 0.0

    def angle_deg(self, from_deg: float, time_s: float) -> float:
        """The commanded angle, `time_s` after the step began; before `start_s` that is `from_deg`."""
        if time_s < self.start_s:
            return from_deg
        t = min(time_s - self.start_s, self.duration_s)
        terms = zip(self.amplitudes_deg, self.frequencies_hz, strict=True)
        return sum(a * math.sin(2.0 * math.pi * f * t) for a, f in terms)

    @property
    def peak_deg(self) -> float:
        return sum(abs(a) for a in self.amplitudes_deg)

    @property
    def peak_rate_dps(self) -> float:
        terms = zip(self.amplitudes_deg, self.frequencies_hz, strict=True)
        return sum(abs(a) * 2.0 * math.pi * f for a, f in terms)


Motion = Move | Wave


@dataclass(frozen=True)
class Step:
    """One segment's motions; without any it is a hold. `keep_fast`: keep its samples at 1 kHz too.

    `heater`: the board is heated meanwhile, by the twin itself, on a bench by whoever stands there.
    """

    segment: str
    motions: tuple[Motion, ...]
    duration_s: float
    keep_fast: bool = False
    heater: bool = False


@dataclass(frozen=True)
class State:
    """One of the six: its name, axis, kind (estimate, rate, position) and steps."""

    name: str
    axis: str
    kind: str
    steps: tuple[Step, ...]

    @cached_property
    def duration_s(self) -> float:
        return sum(step.duration_s for step in self.steps)

    @cached_property
    def readings(self) -> int:
        """How many test readings it takes (segments with slashes)."""
        return sum("/" in step.segment for step in self.steps)


@dataclass(frozen=True)
class Axis:
    """What one servo of a rig can do. `step_deg` is its encoder's step, `supply_V` what its top speed follows from."""

    name: str
    min_deg: float
    max_deg: float
    max_rate_dps: float
    step_deg: float
    part: str = ""
    supply_V: float = math.nan

    def check(self, angle_deg: float, rate_dps: float) -> None:
        """Raise `Problem` where an angle or a rate is past this axis; the only limit test there is."""
        if not self.min_deg <= angle_deg <= self.max_deg:
            raise Problem("plan.angle_past_rig", axis=self.name, asked=angle_deg, lowest=self.min_deg,
                          highest=self.max_deg, part=self.part)  # fmt: skip
        if rate_dps > self.max_rate_dps:
            raise Problem("plan.rate_past_rig", axis=self.name, asked=rate_dps, highest=self.max_rate_dps,
                          part=self.part, supply_V=self.supply_V)  # fmt: skip


@dataclass(frozen=True)
class Profile:
    """How a profile runs the six states. Set-points are at the thesis' ranges and scale with the operator's."""

    name: str
    sine_hz: float
    sine_cycles: int
    shuffle_linearity: bool
    hold_s: float = 3.0
    rate_linearity: tuple[float, ...] = (-100, -80, -60, -40, -20, -10, 10, 20, 40, 60, 80, 100)
    rate_repeat: tuple[float, ...] = (20, 60, 100, -20, -60, -100)
    position_linearity: tuple[float, ...] = tuple(angle for angle in range(-120, 121, 10) if angle)
    position_repeat: tuple[float, ...] = (30, 60, 90, 120, -120, -90, -60, -30)
    linearity_readings: int = 3
    repeat_readings: int = 22
    stroke_s: float = 1.8
    between_dps: float = 120.0
    out_dps: float = 50.0
    back_dps: float = 100.0
    step_dps: float = 60.0
    before_s: float = 0.2
    after_s: float = 0.4


# 0.2513 Hz does not repeat the same encoder codes every cycle (METHOD 2); 25 whole cycles are about 100 s.
PROFILES: Mapping[str, Profile] = {
    "standard": Profile("standard", sine_hz=0.2513, sine_cycles=25, shuffle_linearity=True),
    "thesis": Profile("thesis", sine_hz=0.25, sine_cycles=25, shuffle_linearity=False),
}
_REFERENCE = Ranges()
_TRAVEL_DEG = 120.0  # a stroke stays inside ±120° however fast it is


@dataclass(frozen=True)
class Plan:
    """What will be run: everything it was made from, and the states with their steps."""

    profile: str
    seed: int
    readings: int
    ranges: Mapping[str, Ranges]
    states: tuple[State, ...]
    gyro_model: GyroModel = field(compare=False)
    experiment: Mapping[str, Any] | None = None
    """What an experiment's plan was made from (`excitation.plan_of`); None for the six states."""

    @cached_property
    def duration_s(self) -> float:
        return sum(state.duration_s for state in self.states)

    @property
    def short(self) -> bool:
        """Fewer or more readings than the profile's: a certificate has to say so."""
        return self.readings != PROFILES[self.profile].repeat_readings

    def to_json(self) -> dict[str, Any]:
        """What `from_json` makes the same plan from."""
        return {
            "profile": self.profile,
            "seed": self.seed,
            "readings": self.readings,
            "ranges": {axis: asdict(ranges) for axis, ranges in self.ranges.items()},
            "states": [state.name for state in self.states],
            "gyro_model": self.gyro_model.to_json(),
            "duration_s": round(self.duration_s, 3),
            **({"experiment": dict(self.experiment)} if self.experiment else {}),
        }

    @classmethod
    def from_json(cls, given: Mapping[str, Any]) -> "Plan":
        if "experiment" in given:
            from calib_core import excitation  # which is made of this module's steps

            return excitation.plan_from_json(given)
        return make_plan(
            given["profile"],
            seed=given["seed"],
            states=given["states"],
            readings=given["readings"],
            ranges=given["ranges"],
            gyro_model=GyroModel.from_json(given["gyro_model"]),
        )


def make_plan(
    profile: str = "standard",
    *,
    seed: int,
    states: Sequence[str] | None = None,
    readings: int | None = None,
    ranges: Mapping[str, Any] | None = None,
    gyro_model: GyroModel = PRESETS["LPY503AL-OUT"],
) -> Plan:
    """The plan of a run.

    `seed` decides the order of set-points. `states` takes some of the six, always in their order.
    `readings` replaces the 22 of every repeat test. `ranges` ({"x": {"rate_dps": 100, …}}) goes before
    the gyro model's own; set-points, strokes and the speeds of moves scale with it.
    Raises `Problem` for an unknown profile or state, fewer than 3 readings, or ranges that are not positive.
    """
    if profile not in PROFILES:
        raise Problem("plan.profile", given=profile, allowed=", ".join(PROFILES))
    shape = PROFILES[profile]
    wanted = STATES if states is None else tuple(states)
    for name in wanted:
        if name not in STATES:
            raise Problem("plan.state", given=name, allowed=", ".join(STATES))
    if not wanted:
        raise Problem("plan.no_state", allowed=", ".join(STATES))
    count = shape.repeat_readings if readings is None else readings
    if not 3 <= count <= 1000:
        raise Problem("plan.readings", given=count, lowest=3, highest=1000)
    if not 0 <= seed < 2**63:
        raise Problem("plan.seed", given=seed)
    asked = ranges or {}
    names = [name for name in STATES if name in wanted]
    of_axis: dict[str, Ranges] = {}
    for axis in sorted({name[-1] for name in names}):
        if axis not in gyro_model.axes:
            raise Problem("plan.axis", axis=axis, gyro_model=gyro_model.id, allowed=", ".join(gyro_model.axes))
        of_axis[axis] = ranges_from_json(asked.get(axis), gyro_model.ranges.get(axis, _REFERENCE))
    built = []
    for name in names:
        kind, axis = name.split("_")
        # Each state has its own generator, so that repeating one state alone keeps its order.
        rng = np.random.default_rng([seed, STATES.index(name)])
        build = _Builder(shape, axis, of_axis[axis], count, gyro_model.axes[axis].range_dps, rng)
        built.append(State(name, axis, kind, build.state(kind, first=name == names[0])))
    return Plan(profile, seed, count, of_axis, tuple(built), gyro_model)


class _Builder:
    """Expands one state into steps, following where the axis is."""

    def __init__(
        self, shape: Profile, axis: str, ranges: Ranges, readings: int, sensor_dps: float, rng: np.random.Generator
    ) -> None:
        self.shape, self.axis, self.ranges, self.readings, self.rng = shape, axis, ranges, readings, rng
        self.rate_scale = ranges.rate_dps / _REFERENCE.rate_dps
        self.angle_scale = ranges.position_deg / _REFERENCE.position_deg
        self.sensor_dps = sensor_dps
        self.at_deg = 0.0
        self.steps: list[Step] = []

    def state(self, kind: str, *, first: bool) -> tuple[Step, ...]:
        if first:
            self._home()
        self.steps.append(Step("hold", (), self.shape.hold_s, keep_fast=True))
        {"estimate": self._estimate, "rate": self._rate, "position": self._position}[kind]()
        return tuple(self.steps)

    def _speed(self, dps: float) -> float:
        """A speed of the profile, slower where the set-points are, and inside the sensor's range."""
        return min(dps * min(self.rate_scale, 1.0), self.sensor_dps)

    def _home(self) -> None:
        """Both axes to 0° from wherever the last run left them: 150° away at most."""
        speed = self._speed(self.shape.out_dps)
        moves = tuple(Move(axis, 0.0, speed) for axis in ("x", "z"))
        self.steps.append(Step("move", moves, _round(150.0 / speed + self.shape.after_s)))

    def _move(self, to_deg: float, rate_dps: float) -> None:
        """To where the next reading starts, with `before_s` for the servo to settle there."""
        way = abs(to_deg - self.at_deg)
        if way > 0.0:
            duration = way / rate_dps + self.shape.before_s
            self.steps.append(Step("move", (Move(self.axis, to_deg, rate_dps),), _round(duration)))
        self.at_deg = to_deg

    def _reading(self, segment: str, to_deg: float, rate_dps: float, before_s: float = 0.0) -> None:
        """One reading: `before_s` of rest, a stroke at constant rate, rest."""
        duration = before_s + abs(to_deg - self.at_deg) / rate_dps + self.shape.after_s
        self.steps.append(Step(segment, (Move(self.axis, to_deg, rate_dps, before_s),), _round(duration)))
        self.at_deg = to_deg

    def _estimate(self) -> None:
        shape = self.shape
        duration = shape.sine_cycles / shape.sine_hz
        wave = Wave(self.axis, (self.ranges.sine_deg,), (shape.sine_hz,), duration)
        self.steps.append(Step(f"estimate_{self.axis}", (wave,), _round(duration + shape.after_s)))
        self._reading(f"step_{self.axis}", self.ranges.position_deg, self._speed(shape.step_dps), shape.before_s)
        self._move(0.0, self._speed(shape.back_dps))

    def _rate(self) -> None:
        shape = self.shape
        for test, rate in self._order(shape.rate_linearity, shape.rate_repeat):
            set_point = rate * self.rate_scale
            end = math.copysign(min(abs(set_point) * shape.stroke_s / 2.0, _TRAVEL_DEG), set_point)
            self._move(-end, self._speed(shape.between_dps))
            self._reading(f"rate_{self.axis}/{test.format(set_point)}", end, abs(set_point))
        self._move(0.0, self._speed(shape.between_dps))

    def _position(self) -> None:
        shape = self.shape
        for test, angle in self._order(shape.position_linearity, shape.position_repeat):
            set_point = angle * self.angle_scale
            segment = f"position_{self.axis}/{test.format(set_point)}"
            self._reading(segment, set_point, self._speed(shape.out_dps), shape.before_s)
            self._move(0.0, self._speed(shape.back_dps))

    def _order(self, linearity: Sequence[float], repeat: Sequence[float]) -> list[tuple[str, float]]:
        """Every reading of a rate or position state: a pattern of its segment name, and its set-point."""
        shape, listed = self.shape, []
        for test, points, count, shuffled in (
            ("linearity", linearity, shape.linearity_readings, shape.shuffle_linearity),
            ("repeat", repeat, self.readings, True),
        ):
            ordered = [point for point in points for _ in range(count)]
            if shuffled:
                ordered = [ordered[i] for i in self.rng.permutation(len(ordered))]
            taken = dict.fromkeys(points, 0)
            for point in ordered:
                taken[point] += 1
                listed.append((f"{test}/{{:+g}}/{taken[point]}", point))
        return listed


def _round(duration_s: float) -> float:
    """A whole number of rows."""
    return math.ceil(duration_s * 100.0 - 1e-6) / 100.0


def check(plan: Plan, axes: Mapping[str, Axis], gyro_model: GyroModel | None = None) -> None:
    """Walk the whole plan before anything moves; raise `Problem` at the first thing sensor or rig cannot do."""
    model = gyro_model or plan.gyro_model
    for state in plan.states:
        for motion in (motion for step in state.steps for motion in step.motions):
            if motion.axis not in axes:
                raise Problem("plan.axis_absent", axis=motion.axis, allowed=", ".join(axes))
            if isinstance(motion, Wave):
                highest = max(motion.frequencies_hz)
                if highest > MAX_FREQUENCY_HZ:
                    raise Problem("plan.frequency", axis=motion.axis, asked=highest, highest=MAX_FREQUENCY_HZ)
                angles = (motion.peak_deg, -motion.peak_deg)
            else:
                angles = (motion.to_deg, motion.to_deg)
            rate = motion.peak_rate_dps
            sensor = model.axes.get(motion.axis)
            if sensor is not None and rate > sensor.range_dps:
                raise Problem("plan.rate_past_sensor", axis=motion.axis, asked=rate, highest=sensor.range_dps,
                              gyro_model=model.id)  # fmt: skip
            for angle in angles:
                axes[motion.axis].check(angle, rate)
