"""The thesis' adaptive compensator (3.10-3.23): bias and scale factor by the MIT rule, and what uses them.

Reference ω̂_g is the filtered gyro output (V), the model ω̂_en = Ŝ·ω_en + β̂; with e = ω̂_g - ω̂_en the rule is
dβ̂/dt = γ₁·e, dŜ/dt = γ₂·e·ω_en. Where ω_en comes from decides the answer (METHOD 1), hence two forms:

matched   differences over one row, centred on it, and the same Kalman filter on both paths, where lag and
          attenuation cancel; the instrument's law and the live plot
thesis    0.1 s differences of held readings, the filter on the gyro's path only
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib_core.kalman import F64, Gain, Whiteness, filter_record, noise_density, tuning, whiteness
from calib_core.problem import Problem

Form = Literal["matched", "thesis"]
GAMMA_1 = 0.3  # 1/s
SETTLING = 5.0  # time constants 1/γ₁ before the trace counts
THESIS_SPAN_S = 0.1
LEAST_RATE_DPS = 1.0  # RMS below which there is no motion to learn the scale factor from


def encoder_rate(time_s: F64, angle_deg: F64, at_s: F64, span_s: float, *, held: bool = False) -> F64:
    """Rates (deg/s) at the rows ``at_s`` (n,) from encoder readings at their own times, ``time_s`` (m,) increasing.

    Mean rate over span_s centred on the row, the angle between two readings taken as the straight line: no lag, and
    the rates add up to the angle that was read. ``held``: the thesis' way, the newest reading at the row less the
    newest one span_s earlier, which lags by span_s/2 and steps by the encoder's step over span_s.
    NaN where the readings do not reach, or stop for longer than 0.1 s (or five reading intervals, if longer).
    """
    if len(time_s) < 2:
        return np.full(len(at_s), np.nan)
    reach = 5e-7  # half the resolution of recorded times: a reading at the row's own time counts as read
    ends = at_s + (0.0 if held else span_s / 2)
    span = np.stack([ends - span_s, ends])
    start, end = np.searchsorted(time_s, span + reach, side="right") - 1  # the newest reading at either end
    interval = np.diff(time_s)
    gap = np.append(interval > max(0.1, 5.0 * float(np.median(interval))), False)  # after each reading
    passed = np.cumsum(gap)
    known = (start >= 0) & (passed[end] == (passed - gap)[start]) & (ends <= time_s[-1] + reach)
    angle = (angle_deg[start], angle_deg[end]) if held else np.interp(span, time_s, angle_deg)
    return np.where(known, (angle[1] - angle[0]) / span_s, np.nan)


def compensate(v: F64, bias: float, scale_factor: float) -> F64:
    """Rate (deg/s) from output v (V) or filtered output, thesis 3.23."""
    return (v - bias) / scale_factor


class Adapter:
    """Streaming MIT rule, sampled every dt (s); γ₁ in 1/s, γ₂ in 1/s per (deg/s)². NaN rows change nothing."""

    def __init__(self, gamma1: float, gamma2: float, dt: float, bias: float, scale_factor: float) -> None:
        self._steps = gamma1 * dt, gamma2 * dt
        self.bias = bias
        self.scale_factor = scale_factor

    def update(self, output: F64, rate: F64) -> tuple[F64, F64]:
        """Traces of bias and scale factor, (n,) each, over the next block of output (n,) and rate (n,)."""
        g1, g2 = self._steps
        bias, scale = self.bias, self.scale_factor
        biases, scales = [], []
        for y, w in zip(output.tolist(), rate.tolist(), strict=True):
            e = y - scale * w - bias
            if e == e:
                bias += g1 * e
                scale += g2 * e * w
            biases.append(bias)
            scales.append(scale)
        self.bias, self.scale_factor = bias, scale
        return np.array(biases), np.array(scales)


def adapt(
    output: F64, rate: F64, dt: float, *, gamma1: float, gamma2: float, bias: float, scale_factor: float
) -> tuple[F64, F64]:
    """The whole record at once: traces of bias and scale factor, (n,) each; what ``Adapter`` gives in pieces.

    The rule is linear in what it adapts, so its trace solves one lower-banded system, unknowns β̂₀, Ŝ₀, β̂₁, Ŝ₁ …
    """
    from scipy.linalg.lapack import dtbtrs

    missing = np.isnan(output) | np.isnan(rate)
    y, w = np.where(missing, 0.0, output), np.where(missing, 0.0, rate)
    of_bias, of_scale = gamma1 * dt * ~missing, gamma2 * dt * w  # the gains of each row
    known = np.stack([of_bias * y, of_scale * y], axis=1)
    known[0] += bias, scale_factor
    known[0] -= (scale_factor * w[0] + bias) * np.array([of_bias[0], of_scale[0]])
    band = np.zeros((2 * len(y), 4))  # each row an unknown: its diagonal and where it enters the next three equations
    band[1:-1:2, 1] = (of_bias * w)[1:]
    band[:-2:2, 2] = of_bias[1:] - 1.0
    band[1:-2:2, 2] = (of_scale * w)[1:] - 1.0
    band[:-2:2, 3] = of_scale[1:]
    trace, _ = dtbtrs(band.T, known.reshape(-1, 1), uplo="L", diag="U", overwrite_b=True)
    return trace[::2, 0], trace[1::2, 0]


def adapt_many(
    output: F64, rate: F64, dt: float, *, gamma1: float, gamma2: F64, bias: F64, scale_factor: F64, first: int = 0
) -> tuple[F64, F64]:
    """Many boards side by side: output and rate (n, boards) without gaps, γ₂ and the starts (boards,).

    Returns the means of bias and scale factor, (boards,) each, over their traces from row ``first`` on.
    """
    # The scale factor is carried as Ŝ·γ₁/γ₂, so that both parameters move by γ₁·e; every product goes into place.
    ratio = gamma2 / gamma1
    step = np.full(len(ratio), gamma1 * dt)
    state = np.stack([bias, scale_factor / ratio])
    beta, scale = state
    total = np.zeros_like(state)
    e = np.empty(len(ratio))
    for k, (y, w) in enumerate(zip(output, rate, strict=True)):
        np.multiply(scale, ratio, e)
        np.multiply(e, w, e)
        np.subtract(y, e, e)
        np.subtract(e, beta, e)
        np.multiply(e, step, e)
        np.add(beta, e, beta)
        np.multiply(e, w, e)
        np.add(scale, e, scale)
        if k >= first:
            np.add(total, state, total)
    total /= len(output) - first
    return total[0], total[1] * ratio


@dataclass(frozen=True, eq=False)
class Adaptive:
    """The adaptive estimate of one record with its trace (n,) each on a regular grid, and the filter behind it."""

    form: Form
    bias_V: float
    scale_factor_V_per_dps: float
    time_s: F64
    bias_trace: F64
    scale_factor_trace: F64
    gain: Gain
    whiteness: Whiteness


def estimate(
    time_s: F64,
    v: F64,
    position_time_s: F64,
    position_deg: F64,
    *,
    form: Form = "matched",
    frequency_hz: float | None = None,
    start: tuple[float, float] | None = None,
    rest_density: float | None = None,
    omega_n: float = 10.0,
) -> Adaptive:
    """Bias and scale factor of one estimate state: the mean of the settled trace over whole sine periods.

    Output v (V) at rows time_s (n,), NaN where missing; encoder readings at their own times (m,).
    ``frequency_hz`` of the sine (None: everything settled is averaged). ``start``: bias and scale factor to begin
    with, the datasheet's (None: the mean output, and 0). ``rest_density`` of V at rest in V²·s (None: from the
    record's second differences). Raises Problem: adaptation.too_short, adaptation.no_motion.
    """
    dt = float(np.median(np.diff(time_s)))
    period = dt if frequency_hz is None else 1.0 / frequency_hz
    settled = SETTLING / GAMMA_1
    periods = math.floor((time_s[-1] - time_s[0] + dt - settled) / period + 1e-6)
    if periods < 1:
        raise Problem("adaptation.too_short", duration_s=time_s[-1] - time_s[0], needed_s=settled + period)

    matched = form == "matched"
    rate = encoder_rate(position_time_s, position_deg, time_s, dt if matched else THESIS_SPAN_S, held=not matched)
    time_s, output, rate = _regular(time_s, dt, v, rate)
    missing = np.isnan(output) | np.isnan(rate)
    if missing.all():
        raise Problem("adaptation.no_motion", rate_dps=0.0, least_dps=LEAST_RATE_DPS)
    output[missing] = rate[missing] = np.nan
    gain = tuning(noise_density(output, dt) if rest_density is None else rest_density, omega_n)
    filtered = filter_record(output, dt, gain)
    regressor = filter_record(rate, dt, gain) if matched else rate
    mean_square = float(np.mean(regressor[~missing] ** 2))
    if mean_square < LEAST_RATE_DPS**2:
        raise Problem("adaptation.no_motion", rate_dps=math.sqrt(mean_square), least_dps=LEAST_RATE_DPS)

    bias, scale_factor = start or (float(np.nanmean(output)), 0.0)
    biases, scales = adapt(
        np.where(missing, np.nan, filtered), regressor, dt,
        gamma1=GAMMA_1, gamma2=GAMMA_1 / mean_square, bias=bias, scale_factor=scale_factor,
    )  # fmt: skip
    first = round(settled / dt)
    window = slice(first, first + round(periods * period / dt))
    return Adaptive(
        form, float(np.mean(biases[window])), float(np.mean(scales[window])), time_s, biases, scales,
        gain, whiteness(output, filtered, dt, gain),
    )  # fmt: skip


def _regular(time_s: F64, dt: float, *columns: F64) -> tuple[F64, ...]:
    """Time and columns on the regular grid the filter needs, NaN where the record has no row."""
    row = np.rint((time_s - time_s[0]) / dt).astype(np.intp)
    grid = [time_s[0] + dt * np.arange(row[-1] + 1)]
    for column in columns:
        grid.append(np.full(row[-1] + 1, np.nan))
        grid[-1][row] = column
    return tuple(grid)
