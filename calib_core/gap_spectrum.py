"""Mains hum: one line near 50 or 60 Hz, or wherever sampling puts it, in the spectrum of the gyro's output (METHOD 4).

Motion is slow and hum is fast, so a high-pass filter leaves the noise, the hum and short jerks; samples near jerks
weigh less. At each frequency the line's gain is that of a sine and a cosine fitted with these weights. What counts as
noise is the median of that gain beside the band, so noise of any colour is known where it matters. Records longer than
``COHERENT_S`` are cut into pieces that share the frequency, not the phase: the mains wander.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calib_core.rows import Samples

F64 = NDArray[np.float64]
C128 = NDArray[np.complex128]

MAINS_HZ = (50.0, 60.0)
BAND_HZ = 0.5
"""Mains stay this close to their nominal frequency."""
BESIDE_HZ = (0.6, 3.0)
"""Where the noise beside a line is taken from."""
FALSE_ALARM = 5e-4
"""Of a record without hum being given one; 0.1 % is promised."""
SLOWEST_HZ = 20.0
MOTION_HZ, STILL_HZ = 5.0, 1.0
"""Tables move at up to 4.1 Hz: below the first a line may be motion, below the second drift."""
DEAF = 0.1
"""Samples that are means over nearly whole periods of the mains, and keep less than this of it, cannot show it."""
ALONE, LASTING = 1.4, 0.35
"""Over the strongest line beside the band; the share of the gain without a quarter of the record, 0.75 in the mean."""
COHERENT_S = 300.0
SMOOTH_S = 0.02
"""Motion at 4 Hz keeps a hundredth of its size, noise at 20 Hz nearly all."""
BIN_S = 0.05
CALM_S, CALM_SAMPLES = 1.0, 32
"""Weights follow the record's unrest over the longer of these."""
OVERSAMPLING = 4


@dataclass(frozen=True)
class Hum:
    """The strongest line near a mains frequency, whether it counts or not."""

    found: bool
    """Improbable without hum, and ``steady``."""
    steady: bool
    """Whether it is there throughout and alone, unlike harmonics of a motion that a coarse converter sees."""
    two_delta_lnL: float
    p: float
    """Probability of such a line somewhere in the bands of a record without hum."""
    frequency_hz: float
    frequency_uncertainty_hz: float
    alias_hz: float
    """Where the line lies in the recording's own spectrum."""
    also_hz: tuple[float, ...]
    """Other mains frequencies that this sampling shows at the same place."""
    amplitude: float
    """In the output's unit, before any averaging of samples."""
    amplitude_uncertainty: float
    A: float
    B: float
    """A·sin(2πft) + B·cos(2πft), t from the first sample; nan where pieces do not share a phase."""


def visible(s: Samples, *, moving: bool = True) -> tuple[float, ...]:
    """The mains frequencies that these samples could show.

    Not those that sampling puts among the motion (when ``moving``) or on zero, or that averaging took out; none at all
    below 20 Hz.
    """
    if s.interval_s > 1.001 / SLOWEST_HZ or len(s.time_s) < 2 * CALM_SAMPLES:
        return ()
    lowest = MOTION_HZ if moving else STILL_HZ
    return tuple(f for f in MAINS_HZ if _alias(f, s) >= lowest and abs(_kept(f, s)) >= DEAF)


def find_hum(s: Samples, *, moving: bool = True) -> Hum | None:
    """The strongest mains line in the samples; None where none is ``visible``."""
    bands = visible(s, moving=moving)
    if not bands:
        return None
    record = _Record(s)
    strongest, start, density, beside = max(record.scan(nominal) for nominal in bands)
    start = min(_images(start, s), key=lambda f: (round(min(abs(f - nominal) for nominal in MAINS_HZ), 6), f))
    frequency, gain, _ = record.refined(start)
    two_delta_lnL = gain / (density * record.response(frequency) ** 2)
    # The sum over pieces against noise that is itself estimated; about four frequencies a resolution element count.
    from scipy.special import fdtrc

    pieces = record.pieces
    single = float(fdtrc(2 * pieces, 2 * record.duration_s, two_delta_lnL / (2 * pieces)))
    trials = OVERSAMPLING * len(bands) * 2.0 * BAND_HZ * record.duration_s / pieces
    p = float(-np.expm1(trials * np.log1p(-min(single, 0.5))))
    steady = strongest > ALONE * beside and record.lasting(frequency) > LASTING
    # The estimate has weights that neither the line nor the noise that rides on it has a part in.
    record.weigh(frequency)
    _, _, density, _ = record.scan(min(MAINS_HZ, key=lambda nominal: abs(nominal - frequency)))
    frequency, _, bend = record.refined(frequency)
    lines, covariance = record.lines(frequency)
    noise = density * record.response(frequency) ** 2
    undo = 1.0 / (record.response(frequency) * _kept(frequency, s))
    # Noise adds its variance to the mean square of the pieces' lines.
    power = float(np.mean(np.abs(lines) ** 2)) - (2.0 * noise * float(covariance.mean()) if pieces > 1 else 0.0)
    first = complex(lines[0] * undo) if pieces == 1 else complex(np.nan, np.nan)
    return Hum(
        found=p < FALSE_ALARM and steady,
        steady=steady,
        two_delta_lnL=two_delta_lnL,
        p=p,
        frequency_hz=frequency,
        frequency_uncertainty_hz=float(np.sqrt(2.0 * noise / bend)) if bend > 0.0 else float("nan"),
        alias_hz=float(_alias(frequency, s)),
        also_hz=tuple(f for f in _images(frequency, s) if abs(f - frequency) > 1e-6),
        amplitude=float(np.sqrt(max(power, 0.0)) * abs(undo)),
        amplitude_uncertainty=float(np.sqrt(noise * covariance.mean() / pieces) * abs(undo)),
        A=-first.imag,
        B=first.real,
    )


class _Record:
    """The output without its slow part, weighted, binned for each band, in pieces."""

    def __init__(self, s: Samples) -> None:
        self.samples = s
        kernel = _high_pass(s.interval_s)
        half = len(kernel) // 2
        self.kernel = kernel[half:]
        self.time = (s.time_s - s.time_s[0])[half:-half]
        breaks = np.cumsum(s.start)
        self.whole = breaks[2 * half :] == breaks[: len(breaks) - 2 * half]
        from scipy.signal import oaconvolve

        self.quick = np.where(self.whole, oaconvolve(s.output - s.output.mean(), kernel, mode="valid"), 0.0)
        self.duration_s = float(s.time_s[-1] - s.time_s[0])
        self.pieces = int(np.ceil(self.duration_s / COHERENT_S))
        along = self.time * self.pieces / self.duration_s
        self.piece = np.minimum(along.astype(np.int64), self.pieces - 1)
        self.taper = _taper(along - self.piece)
        self.weigh()

    def response(self, frequency: float) -> float:
        """What the high-pass filter leaves of a line."""
        phase = 2.0 * np.pi * frequency * self.samples.interval_s * np.arange(1, len(self.kernel))
        return float(self.kernel[0] + 2.0 * self.kernel[1:] @ np.cos(phase))

    def weigh(self, frequency: float | None = None) -> None:
        """Weights from the unrest around each sample, the line at ``frequency`` taken out."""
        rest = self.quick
        if frequency is not None:
            turn = np.exp(2j * np.pi * frequency * self.time)
            rest = rest - np.where(self.whole, (self.lines(frequency)[0][self.piece] * turn).real, 0.0)
        span = max(CALM_SAMPLES, round(CALM_S / self.samples.interval_s))
        part = np.minimum(np.arange(len(rest)) // span, max(len(rest) // span - 1, 0))
        unrest = np.bincount(part, rest**2) / np.maximum(np.bincount(part, self.whole), 1.0)
        typical = float(np.median(unrest[unrest > 0.0])) if (unrest > 0.0).any() else 1.0
        # A stretch that seems far quieter than the rest is stuck, not good.
        self.weight = self.taper * self.whole / np.maximum(unrest, 0.1 * typical)[part] / len(rest)

    def scan(self, nominal: float) -> tuple[float, float, float, float]:
        """Of the strongest line in the band: gain over noise and frequency; beside the band: noise density, and the
        strongest line's gain over noise."""
        width = self.samples.interval_s * max(1, int(BIN_S / self.samples.interval_s))
        bins = (self.time / width).astype(np.int64)
        turn = np.exp(-2j * np.pi * nominal * self.time)
        each = [
            self.weight * x for x in (self.quick * turn.real, self.quick * turn.imag, (turn**2).real, (turn**2).imag)
        ]
        weighted = [np.bincount(bins, x) for x in (*each, self.weight)]
        z, c, total = weighted[0] + 1j * weighted[1], weighted[2] + 1j * weighted[3], weighted[4]
        edges = np.linspace(0, len(total), self.pieces + 1).round().astype(int)
        size = OVERSAMPLING * 2 ** int(np.ceil(np.log2(np.diff(edges).max())))
        offset = np.asarray(np.fft.fftfreq(size, width), np.float64)
        gain = np.zeros(size)
        for a, b in pairwise(edges):
            double = np.tile(np.fft.fft(c[a:b], size // 2), 2)
            gain += _line(np.fft.fft(z[a:b], size), double, float(total[a:b].sum()))[1]
        kept = np.abs(offset) < BESIDE_HZ[1]
        near, frequency = np.abs(offset[kept]), nominal + offset[kept]
        ratio = gain[kept] / self._responses(frequency) ** 2
        beside = (near > BESIDE_HZ[0]) & (_alias(frequency, self.samples) > STILL_HZ)
        from scipy.special import gammaincinv

        density = float(np.median(ratio[beside]) / (2.0 * gammaincinv(self.pieces, 0.5)))
        inside = np.flatnonzero(near <= BAND_HZ)
        best = inside[np.argmax(ratio[inside])]
        return float(ratio[best] / density), float(frequency[best]), density, float(ratio[beside].max() / density)

    def lasting(self, frequency: float) -> float:
        """The share of the line's gain that is left without the two strongest of eight parts of equal weight."""
        z = self.weight * self.quick * np.exp(-2j * np.pi * frequency * self.time)
        along = np.cumsum(self.weight)
        part = np.minimum((8.0 * along / along[-1]).astype(np.int64), 7)
        parts = np.bincount(part, z.real, 8) + 1j * np.bincount(part, z.imag, 8)
        if self.pieces > 1:
            parts = np.abs(parts)
        # In the phase of the whole, what each part adds to its size; the gain goes with the square of the size.
        size = np.sort((parts * np.exp(-1j * np.angle(parts.sum()))).real)
        return float((max(size[:6].sum(), 0.0) / size.sum() * 8.0 / 6.0) ** 2 * 6.0 / 8.0)

    def _responses(self, frequency: F64) -> F64:
        """(k,) by interpolation: the response is smooth."""
        grid = np.linspace(frequency.min(), frequency.max(), 201)
        return np.interp(frequency, grid, [self.response(f) for f in grid])

    def refined(self, frequency: float) -> tuple[float, float, float]:
        """The best frequency near one of the scan's, the gain there and its curvature (per Hz²)."""
        from scipy.optimize import minimize_scalar

        width = self.pieces / self.duration_s

        def gain(f: float) -> float:
            lines = [_line(*sums) for sums in self._sums(f)]
            return float(sum(g for _, g, _ in lines))

        bounds = (frequency - 0.5 * width, frequency + 0.5 * width)
        best = minimize_scalar(lambda f: -gain(f), bounds=bounds, method="bounded", options={"xatol": 1e-3 * width})
        h = 0.1 * width
        bend = (2.0 * -best.fun - gain(best.x - h) - gain(best.x + h)) / h**2
        return float(best.x), float(-best.fun), float(bend)

    def lines(self, frequency: float) -> tuple[C128, F64]:
        """(pieces,) lines in what the filter left, a in Re(a·exp(2πift)), and the variance of their size."""
        found = [_line(*sums) for sums in self._sums(frequency)]
        return np.array([a for a, _, _ in found]), np.array([v for _, _, v in found], float)

    def _sums(self, frequency: float) -> list[tuple[C128, C128, float]]:
        sums = []
        for a, b in pairwise([*np.searchsorted(self.piece, np.arange(self.pieces)).tolist(), len(self.piece)]):
            w, turn = self.weight[a:b], np.exp(-2j * np.pi * frequency * self.time[a:b])
            sums.append((np.asarray((w * self.quick[a:b]) @ turn), np.asarray(w @ turn**2), float(w.sum())))
        return sums


def _line(z: C128, c: C128, total: float) -> tuple[C128, F64, F64]:
    """Least squares of a line Re(a·exp(iωt)): a, its gain, and the variance of |a| for noise of density 1.

    z = Σ w·r·exp(-iωt), c = Σ w·exp(-2iωt), total = Σ w. Near half the sampling rate sine and cosine are hardly two
    columns; then the one that is left is used alone.
    """
    turn = np.exp(0.5j * np.angle(c))
    along = z / turn
    strong, weak = total + np.abs(c), total - np.abs(c)
    usable = weak > 1e-2 * total
    per_weak = np.where(usable, 1.0 / np.where(usable, weak, 1.0), 0.0)
    per_strong = 1.0 / np.where(strong > 0.0, strong, np.inf)
    a = 2.0 * (along.real * per_strong + 1j * along.imag * per_weak)
    gain = 2.0 * (along.real**2 * per_strong + along.imag**2 * per_weak)
    size = np.maximum(np.abs(a) ** 2, 1e-300)
    return a * turn, gain, 2.0 * (a.real**2 * per_strong + a.imag**2 * per_weak) / size


def _taper(x: F64) -> F64:
    """Rises and falls over a tenth of 0…1 at either end, so that motion does not leak through the ends."""
    edge = np.clip(np.minimum(x, 1.0 - x) / 0.1, 0.0, 1.0)
    return np.asarray(np.sin(np.pi / 2.0 * edge) ** 2)


def _high_pass(interval_s: float) -> F64:
    """(2k+1,) one less a Gaussian mean, twice."""
    steps = np.arange(-np.ceil(4.0 * SMOOTH_S / interval_s), np.ceil(4.0 * SMOOTH_S / interval_s) + 1)
    mean = np.exp(-0.5 * (steps * interval_s / SMOOTH_S) ** 2)
    once = np.where(steps == 0, 1.0, 0.0) - mean / mean.sum()
    return np.convolve(once, once)


def _alias(frequency: float | F64, s: Samples) -> F64:
    rate = 1.0 / s.interval_s
    return np.asarray(np.abs(frequency - rate * np.round(np.asarray(frequency) / rate)))


def _kept(frequency: float, s: Samples) -> float:
    """What averaging has left of a line, with its sign."""
    return float(np.sinc(frequency * s.average_s))


def _images(frequency: float, s: Samples) -> list[float]:
    """Every frequency within the mains' bands that sampling shows where it shows this one."""
    rate = 1.0 / s.interval_s
    images = [
        k * rate + sign * float(_alias(frequency, s)) for k in range(int(62.0 / rate) + 2) for sign in (1.0, -1.0)
    ]
    return sorted({f for f in images if any(abs(f - nominal) <= BAND_HZ + 1e-6 for nominal in MAINS_HZ)})
