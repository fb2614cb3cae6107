"""The thesis' Kalman filter (2.5-2.14, 3.5-3.9): smooths the gyro's output V; the states are [dV/dt, V].

The continuous observer dx = A x + K (v - H x), A = [[0,0],[1,0]], H = [0,1], has the steady-state gain of the
Riccati equation. What runs is its discrete twin: the Kalman filter of the same model sampled every dt, exact from
the first sample on, and a constant-gain recursion (done as matrix products over blocks) once its gain has arrived.
State 1 is the slope of V. The thesis calls it beta; it is not the bias.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
BLOCK = 128  # samples to a matrix product
ARRIVED = 3e-12  # relative distance at which the running gain counts as the steady one


@dataclass(frozen=True)
class Gain:
    """Steady-state gain K = [k1 (1/s²), k2 (1/s)] and the densities it comes from.

    Process noise q1 (V²/s³, of the slope) and q2 (V²/s, of V); measurement noise r (V²·s).
    """

    k1: float
    k2: float
    q1: float
    q2: float
    r: float


def steady_gain(q1: float, q2: float, r: float) -> Gain:
    """K = P Hᵀ R⁻¹ with P from A P + P Aᵀ - P Hᵀ R⁻¹ H P + Q = 0 (thesis 2.12-2.14).

    Raises ValueError unless q1 > 0, q2 >= 0, r > 0.
    """
    if not (q1 > 0 and q2 >= 0 and r > 0):
        raise ValueError(f"the Riccati equation needs q1 > 0, q2 >= 0, r > 0; got {q1}, {q2}, {r}")
    from scipy.linalg import solve_continuous_are

    # Only q/r matters to the gain. Time in units of T = (r/q1)^(1/4) makes every entry of order one.
    t = (r / q1) ** 0.25
    a = np.array([[0.0, 1.0], [0.0, 0.0]])  # Aᵀ: the filter's equation is the regulator's dual
    p = solve_continuous_are(a, np.array([[0.0], [1.0]]), np.diag([1.0, q2 / r * t * t]), np.eye(1))
    return Gain(k1=float(p[0, 1]) / t**2, k2=float(p[1, 1]) / t, q1=q1, q2=q2, r=r)


def tuning(rest_density: float, omega_n: float = 10.0) -> Gain:
    """METHOD 1's choice, as the thesis prints no Q and R: q2 = 0 and q1 such that √K1 = omega_n (rad/s).

    ``rest_density`` is the density of V at rest, V²·s (variance of a white sample times its period).
    """
    return steady_gain(rest_density * omega_n**4, 0.0, rest_density)


def noise_density(v: F64, dt: float) -> float:
    """Density (V²·s) of the white noise in v (n,), from second differences: motion below about 4 Hz cancels."""
    second = np.diff(v, 2)
    return float(np.nanmean(second * second)) / 6.0 * dt


@dataclass(frozen=True, eq=False)
class _Twin:
    """The discrete model and its steady recursion; covariances are in units of one sample's variance r/dt."""

    dt: float
    q: tuple[float, float, float]  # [slope², slope·V, V²] added each step
    prior: tuple[float, float, float]  # steady covariance before an update
    k1: float  # steady gain after a prediction; k2 likewise
    k2: float
    respond: F64  # (BLOCK, BLOCK): filtered block from measured block, starting at rest
    carry: F64  # (BLOCK, 2): its last state
    recall: F64  # (2, BLOCK): filtered block from the state before it
    powers: F64  # (BLOCK + 1, 2, 2): what is left of a state i samples later


@lru_cache(maxsize=32)
def _twin(gain: Gain, dt: float) -> _Twin:
    a, b = gain.q1 / gain.r * dt, gain.q2 / gain.r * dt
    q = (a * dt, a * dt * dt / 2, a * dt**3 / 3 + b * dt)
    phi = np.array([[1.0, 0.0], [dt, 1.0]])
    prior = _doubling(phi, np.array([[q[0], q[1]], [q[1], q[2]]]))
    k = prior[:, 1] / (prior[1, 1] + 1.0)
    closed = phi - np.outer(k, phi[1])  # (I - K H) Φ
    powers = np.empty((BLOCK + 1, 2, 2))
    powers[0] = np.eye(2)
    for i in range(BLOCK):
        powers[i + 1] = closed @ powers[i]
    impulse = powers[:-1] @ k  # (BLOCK, 2): state i steps after a unit sample
    lag = np.subtract.outer(np.arange(BLOCK), np.arange(BLOCK))
    return _Twin(
        dt=dt, q=q, prior=(prior[0, 0], prior[0, 1], prior[1, 1]), k1=float(k[0]), k2=float(k[1]),
        respond=np.where(lag >= 0, impulse[np.maximum(lag, 0), 1], 0.0).T.copy(),
        carry=impulse[::-1].copy(), recall=powers[1:, 1].T.copy(), powers=powers,
    )  # fmt: skip


def _doubling(phi: F64, q: F64) -> F64:
    """Steady covariance before an update, H = [0,1], R = 1: each pass doubles the steps taken.

    Structure-preserving doubling (Anderson 1978). Waiting for the one-step recursion to stop moving is a trap:
    with a small dt it barely moves long before it has arrived.
    """
    a, g, p = phi.T, np.diag([0.0, 1.0]), q
    for _ in range(60):
        w = np.linalg.inv(np.eye(2) + g @ p)
        step = a.T @ p @ w @ a
        a, g, p = a @ w @ a, g + a @ w @ g @ a.T, p + (step + step.T) / 2
        if np.abs(step).max() <= 1e-17 * np.abs(p).max():
            return p
    raise ArithmeticError("the doubling iteration of the Riccati equation did not converge")


def discrete_gain(gain: Gain, dt: float) -> tuple[float, float]:
    """Steady gain [1/s, 1] of the filter sampled every dt (s), applied to z - HΦx (thesis 2.5-2.9)."""
    twin = _twin(gain, dt)
    return twin.k1, twin.k2


class Filter:
    """Streaming filter; blocks may have any length and give what the whole record gives, to 1e-9.

    Starts at the first sample with slope 0, that sample's variance for V, and the steady variance for the slope.
    A NaN sample is a prediction only: the output goes on along the slope, and the gain grows until it has settled.
    """

    def __init__(self, gain: Gain, dt: float) -> None:
        self._twin = _twin(gain, dt)
        self._state: tuple[float, float] | None = None  # slope, V; None before the first sample
        self._covariance = (self._twin.prior[0], 0.0, 1.0)
        self._settled = False

    def update(self, v: F64) -> F64:
        """Filtered block (n,) of the next measured block v (n,), same unit."""
        out = np.empty(len(v))
        v = np.asarray(v, dtype=np.float64)
        missing = np.flatnonzero(np.isnan(v))
        done = 0
        while done < len(v):
            if self._settled:
                later = missing[np.searchsorted(missing, done) :]
                stop = int(later[0]) if len(later) else len(v)
                self._steady(v[done:stop], out[done:stop])
                done = stop
                self._settled = stop == len(v)
            else:
                done += self._transient(v[done:], out[done:])
        return out

    def _transient(self, v: F64, out: F64) -> int:
        """Kalman steps, one by one, until the gain has arrived; returns how many."""
        twin, dt = self._twin, self._twin.dt
        q1, q12, q2 = twin.q
        a, b, c = self._covariance
        taken = 0
        for z in map(float, v):
            measured = z == z
            if self._state is None:
                out[taken] = z
                taken += 1
                if measured:
                    self._state = (0.0, z)
                continue
            slope, value = self._state
            value += dt * slope
            c += dt * (2 * b + dt * a) + q2
            b += dt * a + q12
            a += q1
            if measured:
                k1, k2 = b / (c + 1.0), c / (c + 1.0)
                error = z - value
                slope += k1 * error
                value += k2 * error
                a -= k1 * b
                b -= k2 * b
                c -= k2 * c
                self._settled = abs(k1 - twin.k1) <= ARRIVED * twin.k1 and abs(k2 - twin.k2) <= ARRIVED * twin.k2
            self._state = (slope, value)
            out[taken] = value
            taken += 1
            if self._settled:
                break
        self._covariance = (a, b, c)
        return taken

    def _steady(self, v: F64, out: F64) -> None:
        """The constant-gain recursion: every block from the state before it, all blocks at once."""
        twin = self._twin
        assert self._state is not None
        slope, value = self._state
        blocks = len(v) // BLOCK
        whole = v[: blocks * BLOCK].reshape(blocks, BLOCK)
        (p, q), (r, s) = twin.powers[BLOCK].tolist()
        before = []
        for to_slope, to_value in (whole @ twin.carry).tolist():
            before.append((slope, value))
            slope, value = p * slope + q * value + to_slope, r * slope + s * value + to_value
        if blocks:
            filtered = out[: blocks * BLOCK].reshape(blocks, BLOCK)
            np.matmul(whole, twin.respond, out=filtered)
            filtered += np.array(before) @ twin.recall
        rest = v[blocks * BLOCK :]
        if m := len(rest):
            state = np.array([slope, value])
            out[blocks * BLOCK :] = rest @ twin.respond[:m, :m] + state @ twin.recall[:, :m]
            slope, value = (twin.powers[m] @ state + rest @ twin.carry[BLOCK - m :]).tolist()
        self._state = (slope, value)


def filter_record(v: F64, dt: float, gain: Gain) -> F64:
    """The whole record v (n,) sampled every dt (s) at once; what ``Filter`` gives in pieces."""
    return Filter(gain, dt).update(v)


def reference_filter(gain: Gain, dt: float, first: float) -> Any:
    """filterpy's filter of the same model, started as ``Filter`` is at its first sample (V)."""
    from filterpy.kalman import KalmanFilter

    twin = _twin(gain, dt)
    variance = gain.r / dt
    reference = KalmanFilter(dim_x=2, dim_z=1)
    reference.x = np.array([[0.0], [first]])
    reference.P = np.diag([twin.prior[0], 1.0]) * variance
    reference.F = np.array([[1.0, 0.0], [dt, 1.0]])
    reference.H = np.array([[0.0, 1.0]])
    reference.Q = np.array([[twin.q[0], twin.q[1]], [twin.q[1], twin.q[2]]]) * variance
    reference.R = np.array([[variance]])
    return reference


def filterpy_difference(v: F64, dt: float, gain: Gain) -> float:
    """Largest difference (V) from filterpy's filter, from the same start: the check of record (METHOD 1).

    Meant for the first 1000 samples of an estimate state, which hold the whole transient; past 1e-9 is a warning.
    """
    v = v[np.argmax(~np.isnan(v)) :]
    reference = reference_filter(gain, dt, float(v[0]))
    expected = [v[0]]
    for z in v[1:].tolist():
        reference.predict()
        reference.update(None if z != z else z)
        expected.append(float(reference.x[1, 0]))
    return float(np.max(np.abs(filter_record(v, dt, gain) - expected)))


@dataclass(frozen=True)
class Whiteness:
    """Ljung-Box portmanteau of the innovations, and their variance over the one the gain was made for.

    A ratio well above 1 means more noise, or more motion, than the fixed gain expects (the thesis' warning).
    """

    statistic: float
    lags: int
    p: float
    variance_ratio: float

    @property
    def ok(self) -> bool:
        return self.p >= 0.01


def whiteness(v: F64, filtered: F64, dt: float, gain: Gain, lags: int = 20) -> Whiteness:
    """Tests the innovations of ``filtered = filter_record(v, dt, gain)``, both (n,), after the transient.

    Ljung and Box (1978): n(n+2) Σ ρ²/(n-h) is chi-square with ``lags`` degrees of freedom for white innovations.
    At least 10 samples a lag, so a short record is tested at fewer lags.
    """
    from scipy.special import gammaincc

    twin = _twin(gain, dt)
    innovation = (v - filtered) / (1.0 - twin.k2)
    innovation = innovation[int(10 / (gain.k2 * dt)) :]
    innovation = innovation[~np.isnan(innovation)]
    n = len(innovation)
    lags = min(lags, n // 10)
    power = float(innovation @ innovation) / n
    h = np.arange(1, lags + 1)
    correlation = np.array([innovation[k:] @ innovation[:-k] for k in h]) / (n * power)
    statistic = float(n * (n + 2) * np.sum(correlation**2 / (n - h)))
    expected = (twin.prior[2] + 1.0) * gain.r / dt
    return Whiteness(statistic, lags, float(gammaincc(lags / 2, statistic / 2)), float(power / expected))
