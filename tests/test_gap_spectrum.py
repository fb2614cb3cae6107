"""Mains hum is found where sampling puts it, sized rightly, and not found where there is none."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from calib_core.gap_spectrum import Hum, find_hum, visible
from calib_core.recording import Recording
from calib_core.rows import Samples, samples
from server.bench.gap_records import first_plan, record

F64 = NDArray[np.float64]
NOISE_V = 1.2e-3


@cache
def motion() -> F64:
    return first_plan("x", locked=False).rate_dps["x"]


def made(
    seed: int,
    *,
    rate_hz: float = 100.0,
    seconds: float = 220.0,
    amplitude: float = 0.0,
    frequency_hz: float = 50.1,
    phi: float = 0.0,
    moving: bool = True,
    average_s: float = 0.0,
    wander: bool = False,
) -> Samples:
    """A gyro's record with white or AR(1) noise (``phi`` at 100 Hz), over the mixed motion or still, and one line."""
    rng = np.random.default_rng(seed)
    time = np.arange(int(seconds * rate_hz)) / rate_hz
    output = 1.25 + rng.normal(0.0, NOISE_V, len(time))
    if phi:
        from scipy.signal import lfilter

        keep = phi ** (100.0 / rate_hz)
        output += lfilter([1], [1, -keep], rng.normal(0.0, NOISE_V * np.sqrt(1 - keep**2), len(time)))
    if moving:
        rate = motion()
        output += 0.0059 * np.interp(time, np.arange(len(rate)) / 1e3, rate)
    phase = 2.0 * np.pi * frequency_hz * time + 1.0
    if wander:
        phase += np.cumsum(rng.normal(0.0, 2e-3, len(time)))
    line = amplitude * np.sin(phase)
    if average_s:
        line *= np.sinc(frequency_hz * average_s)
    codes = np.zeros(len(time), np.int32)
    header = {"gyro_average_s": str(average_s)}
    volts = np.round((output + line) / (5.0 / 4096.0)) * 5.0 / 4096.0
    return samples(Recording(time, {"x_gyro_v": volts}, codes, ("hold",), header), "x")


def found(s: Samples, **options: bool) -> Hum:
    hum = find_hum(s, **options)
    assert hum is not None
    return hum


@pytest.mark.parametrize("seed", range(4))
def test_a_tenth_of_a_millivolt_of_hum_is_found_beneath_ten_times_the_noise_and_motion(seed: int) -> None:
    made_by_others = record(seed, {"mains_hum": 0.1})
    n = len(made_by_others.segments)
    columns = {"x_gyro_v": made_by_others.columns["x_gyro_v"]}
    hum = found(samples(Recording(made_by_others.columns["time_s"], columns, np.zeros(n, np.int32), ("",)), "x"))
    assert hum.found
    assert min(abs(f - 50.0) for f in (hum.frequency_hz, *hum.also_hz)) < 0.2
    assert hum.amplitude == pytest.approx(1.1e-4, abs=4.0 * hum.amplitude_uncertainty)


@pytest.mark.parametrize(
    ("rate_hz", "frequency_hz", "alias_hz"),
    [(20.0, 50.13, 9.87), (25.0, 60.2, 10.2), (64.0, 49.9, 14.1), (100.0, 59.8, 40.2), (285.7, 50.05, 50.05)],
)
def test_the_line_is_found_under_its_alias_and_called_by_its_name(
    rate_hz: float, frequency_hz: float, alias_hz: float
) -> None:
    hum = found(made(1, rate_hz=rate_hz, amplitude=4e-4, frequency_hz=frequency_hz))
    assert hum.found
    assert hum.alias_hz == pytest.approx(alias_hz, abs=0.005)
    assert min(abs(f - frequency_hz) for f in (hum.frequency_hz, *hum.also_hz)) < 5.0 * hum.frequency_uncertainty_hz


def test_amplitude_and_frequency_keep_to_their_uncertainties() -> None:
    hums = [found(made(seed, amplitude=3e-4, frequency_hz=59.9, seconds=60.0, phi=0.9)) for seed in range(24)]
    for values in (
        [(h.amplitude - 3e-4) / h.amplitude_uncertainty for h in hums],
        [(h.frequency_hz - 59.9) / h.frequency_uncertainty_hz for h in hums],
    ):
        assert np.sqrt(np.mean(np.square(values))) == pytest.approx(1.0, abs=0.5)
    assert all(np.hypot(h.A, h.B) == pytest.approx(h.amplitude) for h in hums)


def test_sine_and_cosine_give_the_line_back() -> None:
    s = made(3, amplitude=2e-3, frequency_hz=60.2)
    hum = found(s)
    phase = 2.0 * np.pi * hum.frequency_hz * s.time_s
    line = 2e-3 * np.sin(2.0 * np.pi * 60.2 * s.time_s + 1.0)
    assert np.std(hum.A * np.sin(phase) + hum.B * np.cos(phase) - line) < 0.03 * np.std(line)


def test_averaging_over_10_ms_is_undone_and_over_whole_periods_makes_it_invisible() -> None:
    hum = found(made(5, amplitude=5e-4, average_s=0.01))
    assert hum.amplitude == pytest.approx(5e-4, abs=4.0 * hum.amplitude_uncertainty)
    assert visible(made(5, average_s=0.02)) == (60.0,)


def test_mains_that_wander_are_found_in_a_long_record() -> None:
    hum = found(made(6, seconds=900.0, amplitude=2e-4, moving=False, wander=True))
    assert hum.found
    assert hum.amplitude == pytest.approx(2e-4, rel=0.25)
    assert np.isnan(hum.A)


@pytest.mark.parametrize("phi", [0.0, 0.95, 0.995])
def test_without_hum_the_stated_probability_is_kept(phi: float) -> None:
    p = [found(made(seed, rate_hz=rate, phi=phi)).p for seed in range(10) for rate in (20.0, 100.0)]
    assert min(p) > 1e-3
    assert np.sum(np.array(p) < 0.1) <= 6  # of 20; 7 or more would happen once in 400


def test_a_strong_line_of_one_stretch_or_one_of_many_is_not_hum() -> None:
    rng = np.random.default_rng(8)
    time = np.arange(20000) / 100.0
    noise = 1.25 + rng.normal(0.0, NOISE_V, len(time))
    passing = 1e-3 * np.sin(2.0 * np.pi * 40.0 * time) * ((time > 60.0) & (time < 100.0))
    many = sum(4e-4 * np.sin(2.0 * np.pi * f * time + f) for f in np.arange(37.0, 44.0, 0.5))
    for line in (passing, many):
        codes = np.zeros(len(time), np.int32)
        hum = found(samples(Recording(time, {"x_gyro_v": noise + line}, codes, ("",)), "x"))
        assert hum.p < 1e-5
        assert not hum.found


def test_a_line_among_the_motion_or_on_zero_is_not_looked_for() -> None:
    assert visible(made(7, rate_hz=19.0)) == ()
    assert visible(made(7, rate_hz=20.0)) == (50.0,)
    assert visible(made(7, rate_hz=30.0)) == (50.0,)
    assert visible(made(7, rate_hz=23.0)) == (60.0,)
    assert visible(made(7, rate_hz=23.0), moving=False) == (50.0, 60.0)
    assert find_hum(made(7, rate_hz=10.0)) is None
