"""A small generator of recordings with a known truth, written apart from the twin and the library under test."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib_core.recording import Recording

F64 = NDArray[np.float64]
STEP_DEG = 300 / 1023
ADC_V = 0.0012207


@dataclass(frozen=True)
class Board:
    """A recording and what it was made from."""

    recording: Recording
    scale_factor: float
    bias: float


def recording(time_s: F64, columns: dict[str, F64], header: dict[str, str] | None = None) -> Recording:
    return Recording(time_s, columns, np.zeros(len(time_s), np.int32), ("estimate_x",), header or {})


def coloured(n: int, interval_s: float, deviation: float, tau_s: float, rng: np.random.Generator) -> F64:
    """AR(1) noise, one sample after the other."""
    phi = np.exp(-interval_s / tau_s)
    drive = deviation * np.sqrt(1.0 - phi**2) * rng.standard_normal(n)
    out = np.empty(n)
    last = deviation * rng.standard_normal()
    for k in range(n):
        last = out[k] = phi * last + drive[k]
    return out


def thesis(seed: int, *, frequency_hz: float = 0.25, phase: float = 0.0, noise_V: float = 0.0012) -> Board:
    """Thesis 4.2: sine of ±30°, 100 s, 100 Hz, white noise, the encoder's codes read with each sample."""
    rng = np.random.default_rng(seed)
    time = np.arange(10_000) * 0.01
    turn = 2.0 * np.pi * frequency_hz
    angle = 30.0 * np.sin(turn * time + phase)
    v = 1.25 + 0.005 * 30.0 * turn * np.cos(turn * time + phase) + noise_V * rng.standard_normal(len(time))
    return Board(recording(time, {"x_gyro_v": v, "x_position_deg": np.round(angle / STEP_DEG) * STEP_DEG}), 0.005, 1.25)


@dataclass(frozen=True)
class Bench:
    """The rig: 1 kHz converter codes averaged by ten, encoder readings at their own jittered times, a late gyro."""

    frequency_hz: float = 0.2513
    seconds: float = 100.0
    rest_s: float = 3.0
    delay_s: float = 0.003
    noise_V: float = 0.0012
    coloured_V: float = 0.0
    tau_s: float = 0.5
    reading_noise_deg: float = 0.0
    step_deg: float = STEP_DEG
    header: dict[str, str] = field(default_factory=lambda: {"gyro_average_s": "0.01"})

    def angle(self, time_s: F64) -> F64:
        """A hold, then a sine that swells within its first second."""
        since = np.clip(time_s - self.rest_s, 0.0, None)
        swell = np.clip(since, 0.0, 1.0)
        return 30.0 * np.sin(2.0 * np.pi * self.frequency_hz * since) * swell**2 * (3.0 - 2.0 * swell)

    def board(self, seed: int) -> Board:
        rng = np.random.default_rng(seed)
        scale_factor, bias = rng.uniform(0.0057, 0.0061), rng.uniform(1.23, 1.28)
        n = int((self.seconds + self.rest_s) * 100) * 10
        fine = np.arange(n) * 1e-3
        late = fine - self.delay_s
        v = bias + scale_factor * (self.angle(late + 1e-4) - self.angle(late - 1e-4)) / 2e-4
        v += self.noise_V * np.sqrt(10.0) * rng.standard_normal(n)
        if self.coloured_V:
            v += np.repeat(coloured(n // 10, 0.01, self.coloured_V, self.tau_s, rng), 10)
        v = (np.round(v / ADC_V) * ADC_V).reshape(-1, 10).mean(axis=1)
        time = fine.reshape(-1, 10).mean(axis=1)
        read = time + rng.uniform(-0.004, 0.004, len(time))
        angle = (
            self.angle(read) + rng.uniform(0.0, self.step_deg) + self.reading_noise_deg * rng.standard_normal(len(read))
        )
        codes = np.round(np.round(angle / self.step_deg) * self.step_deg, 4)
        columns = {"x_gyro_v": np.round(v, 6), "x_position_deg": codes, "x_position_time_s": np.round(read, 6)}
        return Board(recording(np.round(time, 6), columns, self.header), scale_factor, bias)


def moves(seed: int, n: int = 12, rest_s: float = 0.8) -> Board:
    """Rests and smooth moves between random angles, as a position test has them."""
    rng = np.random.default_rng(seed)
    knots = [0.0, rest_s]
    angles = [0.0, 0.0]
    for _ in range(n):
        angles += [rng.uniform(-100.0, 100.0)] * 2
        knots += [knots[-1] + abs(angles[-1] - angles[-3]) / 60.0 + 0.3]
        knots += [knots[-1] + rest_s]
    time = np.arange(0.0, knots[-1], 0.01)

    def angle(at: F64) -> F64:
        k = np.clip(np.searchsorted(knots, at) - 1, 0, len(knots) - 2)
        t0, t1 = np.asarray(knots)[k], np.asarray(knots)[k + 1]
        a0, a1 = np.asarray(angles)[k], np.asarray(angles)[k + 1]
        u = np.clip((at - t0) / (t1 - t0), 0.0, 1.0)
        return np.asarray(a0 + (a1 - a0) * u**3 * (10.0 - 15.0 * u + 6.0 * u**2))

    rate = (angle(time + 1e-4) - angle(time - 1e-4)) / 2e-4
    v = 1.25 + 0.0059 * rate + 0.0012 * rng.standard_normal(len(time))
    read = time + rng.uniform(-0.004, 0.004, len(time))
    codes = np.round(angle(read) / STEP_DEG) * STEP_DEG
    columns = {"x_gyro_v": v, "x_position_deg": codes, "x_position_time_s": read}
    return Board(recording(time, columns), 0.0059, 1.25)
