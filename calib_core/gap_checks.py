"""What is wrong with a recording before any model is fitted to it (METHOD 3, step 1).

Everything here is counted or compared, nothing is tested for significance: a channel that stands still while the table
turns, samples that pile up at a limit, time that jumps, a gyro that answers the other axis. A check that blocks makes
the diagnosis ``not_testable``; its sentence says what is wrong and what would make the recording testable.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib_core.encoder_noise import step_of
from calib_core.gap_blocks import Blocks
from calib_core.gap_spikes import spikes
from calib_core.integral_fit import MOVED_STEPS
from calib_core.recording import Recording
from calib_core.rows import GAP

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

SHORTEST_S = 8.0
"""Less holds no block to hold out and no noise to know."""
FEWEST = 64
BROKEN = 0.02
"""More interruptions than this share of the samples make a record of pieces."""
OWN_CLOCK_S = 0.5
"""Encoder times of their own wander no further than this from their rows'."""
COARSE_V = 4e-3
"""A converter step above this is an effect whatever the noise."""
COARSE_NOISES = 1.5
"""So is a step of this many standard deviations of the noise: rounding is no longer dithered away."""
COARSE_ENCODER_DEG = 1.0
HELD_S, HELD_SAMPLES = 0.5, 24
"""Equal samples for so long are a stuck channel, unless the table stands too and the converter is coarse."""
PILE, HEAP = 8, 24
"""So many equal samples in a row, or in all, at one end of the range are a limit."""
RAILED = 0.4
"""At a limit for more of the motion than this, the record no longer determines its base."""
ANSWERS = 0.5
"""Share of the output's motion that the reference must explain."""
PER_DPS = {"V": (1e-4, 0.2), "deg/s": (0.3, 3.0), "counts": (0.2, 2e4)}
"""Scale factors of gyros that are sold, with room."""
MULTIPLES = 50
"""Counts that are all multiples of more than this have been multiplied."""
LARGEST = {"V": 50.0, "deg/s": 2e4, "counts": 9e9}
COVARIATES = {"temperature_c": (-80.0, 250.0), "supply_v": (-60.0, 60.0)} | {
    f"{axis}_acceleration_g": (-500.0, 500.0) for axis in "xyz"
}


@dataclass(frozen=True)
class Check:
    """One finding; ``code`` is the key of its sentence, ``values`` fill it."""

    name: str
    ok: bool
    code: str
    values: Mapping[str, object] = field(default_factory=dict)
    blocking: bool = False
    """Whether nothing can be concluded from this recording."""


def checks(recording: Recording, axis: str) -> list[Check]:
    """Every check of ``axis`` in order; ends early where what follows could not be computed."""
    if axis not in recording.axes:
        return [_bad("channel", "no_gyro", True, axis=axis, axes=", ".join(recording.axes))]
    output = recording.gyro(axis).values
    index = np.flatnonzero(np.isfinite(output))
    duration = float(np.ptp(recording.time_s[index])) if len(index) else 0.0
    if len(index) < FEWEST or duration < SHORTEST_S:
        return [_bad("length", "too_short", True, duration_s=duration, samples=len(index), needed_s=SHORTEST_S)]
    out = [_good("length", duration_s=duration, samples=len(index)), _time(recording, axis, index)]
    if out[-1].blocking:
        return out
    look = _Look(recording, axis, index, output[index])
    out += [*_covariates(recording, index), look.motion()]
    if look.kind:
        out += [look.converter(), *look.encoder(), *look.spikes(), *look.levels(), *look.answer()]
    return out


def _good(_name: str, _case: str = "", /, **values: object) -> Check:
    return Check(_name, True, f"check.record.{_case or _name + '_ok'}", values)


def _bad(_name: str, _case: str, _blocking: bool, /, **values: object) -> Check:
    return Check(_name, False, f"check.record.{_case}", values, _blocking)


def _time(recording: Recording, axis: str, index: Ints) -> Check:
    """Samples in order, without more interruptions than a record can bear, and on the encoder's clock."""
    time = recording.time_s[index]
    step = np.diff(time)
    back = np.flatnonzero(step <= 0.0)
    if len(back):
        return _bad("time", "time_repeats", True, count=len(back), at_s=float(time[back[0]]))
    own = recording.columns.get(f"{axis}_position_time_s")
    if own is not None and np.isfinite(own).any():
        apart = own - recording.time_s
        apart = np.abs(apart - np.nanmedian(apart))
        worst = int(np.nanargmax(apart))
        if apart[worst] > OWN_CLOCK_S:
            told = {"axis": axis, "apart_s": float(apart[worst]), "at_s": float(recording.time_s[worst])}
            return _bad("time", "time_two_clocks", True, **told)
    interval = float(np.median(step))
    jumps = np.flatnonzero(step > GAP * interval)
    if not len(jumps):
        return _good("time", interval_ms=1e3 * interval)
    false = _false_jumps(recording, axis, time, jumps)
    broken, shown = len(jumps) > BROKEN * len(step), false if len(false) else jumps
    case = "time_in_pieces" if broken else "time_jumps" if len(false) else "time_gaps"
    told = {"count": len(shown), "at_s": float(time[shown[0]]), "longest_s": float(step[shown].max())}
    return _bad("time", case, case != "time_gaps", **told)


def _false_jumps(recording: Recording, axis: str, time: F64, jumps: Ints) -> Ints:
    """Those jumps of the clock over which the table turned on as if no time had passed."""
    when, angle = recording.position(axis)
    if f"{axis}_position_time_s" in recording.columns or len(when) < 16:
        return jumps[:0]
    at = np.clip(np.searchsorted(when, time[jumps], side="right") - 1, 6, len(when) - 8)
    gap = when[at + 1] - when[at]

    def pace(first: Ints, last: Ints) -> F64:
        first, last = np.maximum(first, 0), np.minimum(last, len(when) - 1)
        return np.asarray((angle[last] - angle[first]) / (when[last] - when[first]))

    # Motion that is steady for as long as the jump is no oscillation that came round to where it was.
    whole = np.clip(gap / np.median(np.diff(when)), 6, 100).astype(np.int64)
    near = pace(at - 6, at), pace(at + 1, at + 7)
    far = pace(at - whole, at), pace(at + 1, at + 1 + whole)
    mean = (near[0] + near[1]) / 2.0
    close = [np.abs(x - mean) < 0.3 * np.abs(mean) for x in (*near, *far)]
    steady = close[0] & close[1] & (close[2] | close[3]) & (np.abs(mean * gap) > 3.0)
    return jumps[steady & (np.abs(angle[at + 1] - angle[at]) < 0.3 * np.abs(mean * gap))]


def _covariates(recording: Recording, index: Ints) -> list[Check]:
    out = []
    for name, (low, high) in COVARIATES.items():
        values = recording.columns.get(name, np.empty(0))[index] if name in recording.columns else np.empty(0)
        known = values[np.isfinite(values)]
        least, most = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
        told = {"column": name, "least": least, "most": most, "low": low, "high": high}
        if least < low or most > high:
            out.append(_bad("covariates", "covariate_impossible", True, **told))
        elif name == "temperature_c":
            out.append(_good("temperature", **told) if len(known) > 1 else _bad("temperature", "no_temperature", False))
    return out


class _Look:
    """One axis' samples, compared with its reference in means over blocks."""

    def __init__(self, recording: Recording, axis: str, index: Ints, output: F64) -> None:
        self.recording, self.axis, self.output = recording, axis, output
        self.unit = recording.gyro(axis).unit
        self.time = recording.time_s[index]
        self.interval = float(np.median(np.diff(self.time)))
        self.low, self.high = float(output.min()), float(output.max())
        rate, (_, angle) = recording.reference_rate(axis), recording.position(axis)
        self.reference = angle if rate is None else rate[np.isfinite(rate)]
        self.kind = "stationary" if recording.stationary else "encoder" if rate is None else "rate"
        if len(self.reference) < FEWEST:
            self.kind = ""
        self.encoder_step = step_of(recording.codes(axis)[1]) if self.kind == "encoder" else 0.0
        inside = (output > self.low) & (output < self.high)
        self.step, self.noise = _step(output[inside]), _noise(output, inside, self.interval)
        self.coarse = self.step**2 > COARSE_NOISES**2 * (self.noise**2 - self.step**2 / 12.0)
        self.blocks = Blocks.of(recording, axis, index, self.encoder_step)

    def motion(self) -> Check:
        """Something to compare with, that moves or is known to stand."""
        if not self.kind:
            return _bad("motion", "no_reference", True, axis=self.axis)
        if self.kind == "stationary":
            return _good("motion", "stationary")
        span, needed = float(np.ptp(self.reference)), max(1.0, MOVED_STEPS * self.encoder_step)
        told = {"axis": self.axis, "span": span, "needed": needed, "unit": "deg" if self.kind == "encoder" else "deg/s"}
        if span > needed:
            return _good("motion", **told)
        still = max(self.noise, self.step) * np.sqrt(2.0 * self.interval / self.blocks.width_s)
        return _bad(
            "motion", "reference_stands" if self.blocks.restlessness > 10.0 * still else "no_motion", True, **told
        )

    def converter(self) -> Check:
        """The spacing of the output's codes beside its noise."""
        told = {"step": self.step, "noise": self.noise, "unit": self.unit}
        if self.coarse or (self.unit == "V" and self.step > COARSE_V):
            return _bad("adc_step", "adc_coarse", False, **told)
        return _good("adc_step", "" if self.step else "adc_step_none", **told)

    def encoder(self) -> list[Check]:
        if self.kind != "encoder":
            return []
        told = {"step_deg": self.encoder_step}
        if self.encoder_step > COARSE_ENCODER_DEG:
            return [_bad("encoder_step", "encoder_coarse", False, **told)]
        return [_good("encoder_step", "" if self.encoder_step else "encoder_step_none", **told)]

    def spikes(self) -> list[Check]:
        """Single samples far out of line, which the diagnosis leaves out; nothing is said where there are none."""
        at = spikes(self.output)
        told = {"axis": self.axis, "count": len(at)}
        return [_bad("spikes", "spikes", False, at_s=float(self.time[at[0]]), **told)] if len(at) else []

    def levels(self) -> list[Check]:
        """Stretches in which the output stays on one value: a limit at the ends of its range, else a stuck channel."""
        if self.low == self.high:
            return [_bad("stuck", "never_changes", True, axis=self.axis, level=self.low, unit=self.unit)]
        first = np.flatnonzero(np.diff(self.output, prepend=np.nan) != 0.0)
        last = np.append(first[1:], len(self.output)) - 1
        value, length, begin, end = self.output[first], last - first + 1, self.time[first], self.time[last]
        held = (length >= HELD_SAMPLES) & (end - begin >= HELD_S)
        piled = ((value == self.low) | (value == self.high)) & (length >= PILE)
        # Standing still, a coarse converter gives one value for ever: there only what the motion contradicts counts.
        asked = piled if self.coarse else piled & held
        if asked.any():
            predicted = self.blocks.past(begin[piled], end[piled], asked[piled])
            if predicted is not None:
                past = np.where(value[piled] == self.high, predicted - self.high, self.low - predicted)
                needed = 1.5 * self.step + 3.0 * self.noise if self.coarse else -3.0 * self.noise
                piled[piled] = ~(past <= needed)
        held &= ~piled
        if self.coarse and held.any():
            held[held] = self.blocks.changed(begin[held], end[held])
        limits = [v for v in (self.low, self.high) if (piled & (value == v)).any() or self._heaped(v)]
        return [self._stuck(value[held], begin[held], end[held]), self._clipped(limits)]

    def _stuck(self, value: F64, begin: F64, end: F64) -> Check:
        if not len(value):
            return _good("stuck")
        k = int(np.argmax(end - begin))
        told = {"at_s": float(begin[k]), "span_s": float(end[k] - begin[k]), "level": float(value[k])}
        return _bad("stuck", "stuck", True, axis=self.axis, count=len(value), unit=self.unit, **told)

    def _heaped(self, end: float) -> bool:
        """Whether far more samples lie at this end of the range than beside it: noise was cut off there."""
        apart = np.abs(self.output - end)
        at, beside = int((apart == 0.0).sum()), int((apart <= max(1.5 * self.step, self.noise)).sum())
        return not self.coarse and at >= HEAP and at > 2 * (beside - at)

    def _clipped(self, limits: list[float]) -> Check:
        if not limits:
            return _good("clipping", low=self.low, high=self.high, unit=self.unit)
        clipped, moving = np.isin(self.output, limits), self.blocks.moving(self.time)
        share = float((clipped & moving).sum() / moving.sum())
        told = {"percent": 100.0 * share, "at_s": float(self.time[clipped.argmax()]), "levels": limits}
        case = "railed" if share > RAILED else "clipped"
        return _bad("clipping", case, share > RAILED, axis=self.axis, unit=self.unit, **told)

    def answer(self) -> list[Check]:
        """Whether the output follows its own axis, with the right sign and a plausible size."""
        top, limit = max(abs(self.low), abs(self.high)), LARGEST[self.unit]
        if top > limit:
            return [_bad("unit", "out_of_range", True, top=top, unit=self.unit, limit=limit)]
        if self.kind == "stationary":
            return [_good("unit", "unit_range_ok", top=top, unit=self.unit)]
        blocks, (own, other) = self.blocks, self.blocks.shares
        told = {"axis": self.axis, "other": blocks.other_axis, "percent": 100.0 * max(own, 0.0)}
        seen = blocks.trust > 0.2
        if not seen or own < ANSWERS * blocks.trust:
            if blocks.follows_other and other > ANSWERS:
                return [_bad("axis", "axes_swapped", True, **told)]
            return [_bad("axis", "does_not_answer", True, **told) if seen else _good("axis", "axis_untold", **told)]
        scale, (least, most) = blocks.scale_factor, PER_DPS[self.unit]
        told |= {"scale_factor": scale, "unit": self.unit, "least": least, "most": most}
        sign = _good("sign") if scale > 0.0 else _bad("sign", "reversed", True, **told)
        fits = least <= abs(scale) <= most and not (self.unit == "counts" and _multiples(self.output) > MULTIPLES)
        unit = _good("unit", **told) if fits else _bad("unit", "unit_implausible", True, **told)
        return [_good("axis", **told), sign, unit]


def _step(values: F64) -> float:
    """The spacing of the output's codes; 0 where it lies on no grid."""
    levels = np.unique(np.round(values, 9))
    gaps = np.diff(levels)
    if len(gaps) < 2:
        return 0.0
    # Printed values are rounded: the smallest gap is off by that, the mean of its like less, the slope over all not.
    step = float(gaps[gaps < 1.5 * gaps.min()].mean())
    for _ in range(2):
        codes = np.round((levels - levels[0]) / step)
        step = float(codes @ (levels - levels[0]) / (codes @ codes))
    off = np.abs(levels - levels[0] - step * codes)
    return step if np.quantile(off, 0.99) < 0.2 * step else 0.0


def _multiples(values: F64) -> int:
    """The greatest integer that divides all differences of ``values``; 0 where they are no integers."""
    levels = np.unique(values)
    return 0 if np.any(levels != np.round(levels)) else int(np.gcd.reduce(np.diff(levels).astype(np.int64)))


def _noise(values: F64, inside: Mask, interval_s: float) -> float:
    """Standard deviation of the white part, from second differences in the quietest quarter of the record's pieces.

    Samples at the ends of the range, which may be its limits, and pieces without any change do not count.
    """
    bend = np.diff(values, 2)[inside[2:] & inside[1:-1] & inside[:-2]]
    size = max(16, round(0.5 / interval_s))
    if len(bend) < size:
        return float(np.std(bend) / np.sqrt(6.0)) if len(bend) else 0.0
    squares = np.mean(bend[: len(bend) // size * size].reshape(-1, size) ** 2, axis=1)
    return float(np.sqrt(np.quantile(squares[squares > 0.0], 0.25) / 6.0)) if squares.any() else 0.0
