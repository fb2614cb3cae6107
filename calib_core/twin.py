"""The twin: a simulated rig whose gyro is a `Model`. Turn the table and the voltage moves.

Physics only: true time goes forward by whole samples in `advance`, nothing sleeps, every draw comes from the seed.
The devices in front of it (`server/devices/twin_rig.py`) see what the real ones would: servo registers, codes, and
readings stamped by the host's clock and by the DAQ's.
"""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from calib_core.effects.base import Acts
from calib_core.excitation import HEAT_DEGC, HEAT_S
from calib_core.gyro_models import PRESETS, GyroModel
from calib_core.model import Model, Noise, Truth
from calib_core.twin_daq import Daq, DaqSpec
from calib_core.twin_servo import RX28, RX64, Servo, ServoSpec, to_code, to_deg

F64 = NDArray[np.float64]

HOST_EPOCH_S = 5000.0  # the host's clock when true time is 0: nothing may rely on the clocks agreeing
POLL_S = 0.0101  # the bus thread asks both servos at about 99 Hz, so rows at 100 Hz always have room for a reading
ASK_S = 0.002  # one servo after the other
POLL_JITTER_S = 0.0002
LATCH_S = -0.0002  # when the servo looks at its encoder, from the middle of the transaction that the host stamps
LATCH_JITTER_S = 0.0001


def board_truth(seed: int, board: str = "", gyro_model: GyroModel = PRESETS["LPY503AL-OUT"]) -> dict[str, Model]:
    """The gyro of a simulated board: realistic, and different for each seed and board id.

    As the thesis found its four axes: bias up to 50 mV above the datasheet and scale factor 27 to 31 % below it, which
    is 1.23–1.28 V and 5.7–6.1 mV/(deg/s) on OUT; white noise of 1.2 mV there at 100 Hz (0.12 mV/√Hz).
    """
    rng = np.random.default_rng([seed, zlib.crc32(board.encode()), 1])
    usual = PRESETS["LPY503AL-OUT"].axes
    truth = {}
    for axis in "xz":
        sheet = gyro_model.axes.get(axis, usual[axis])
        gain = sheet.scale_factor_V_per_dps / 8.3e-3
        bias = sheet.bias_V + rng.uniform(0.0, 0.05)
        truth[axis] = Model(bias, gain * rng.uniform(5.7e-3, 6.1e-3), noise=Noise(white=abs(gain) * 1.2e-3))
    return truth


@dataclass(frozen=True)
class Samples:
    """n samples: (n,) by the DAQ's own clock, (n, channels) in V, and when the host had them."""

    time_s: F64
    volts: F64
    host_time_s: float


class Plant:
    """Table, gyro and DAQ.

    `models` is the gyro's truth by axis (default: `board_truth(seed)`); `servos` and `daq` are the parts as built
    (default: servos half a per cent off in speed, a DAQ clock within 50 ppm, drawn from the seed). `tilt`: the sensor's
    z sees a turn of the table's z times cos θ_x. `covariates`: a third and fourth channel, an LM35 (10 mV/°C) and half
    of the supply.
    """

    def __init__(
        self,
        seed: int,
        models: Mapping[str, Model] | None = None,
        *,
        servos: Mapping[str, ServoSpec] | None = None,
        daq: DaqSpec | None = None,
        start_deg: Mapping[str, float] = MappingProxyType({"x": -3.0, "z": 8.0}),
        tilt: bool = True,
        covariates: bool = False,
    ) -> None:
        servo_rng, daq_rng, self._poll, self._noise = np.random.default_rng([seed, 2]).spawn(4)
        if servos is None:
            parts = {"x": RX28, "z": RX64}
            servos = {a: replace(part, speed_error=servo_rng.normal(0.0, 0.005)) for a, part in parts.items()}
        self.servos = {axis: Servo(spec, servo_rng, start_deg[axis]) for axis, spec in servos.items()}
        self.daq = Daq(daq or DaqSpec(clock_error=daq_rng.uniform(-5e-5, 5e-5)), daq_rng)
        self.tilt, self.covariates = tilt, covariates
        self.now_s = 0.0
        self._polls = 0
        self.warming_degC_per_s = 0.0  # of the room, beside its slow way to 26 °C
        self._heater = (0.0, 0.0, 0.0)  # since when, how warm then (°C above the room), to where
        self.mount(models or board_truth(seed))

    def mount(self, models: Mapping[str, Model]) -> None:
        """Put this gyro on the table; its axes are wired to the channels in their order."""
        self.models = dict(sorted(models.items()))
        rate_hz = self.daq.spec.rate_hz
        self._output = {a: model.simulator(a, rate_hz, self._noise.spawn(1)[0]) for a, model in self.models.items()}
        self._encoder = {
            a: model.encoder(a, 1.0 / POLL_S, self._noise.spawn(1)[0])
            for a, model in self.models.items()
            if any(effect.acts is Acts.ANGLE for effect in model.effects)
        }
        self._feels = any(effect.needs for model in self.models.values() for effect in model.effects)

    def wait(self, until_s: float) -> None:
        """Nothing is asked of the rig until it has been on for so long; what is queued goes on."""
        self.now_s = max(self.now_s, until_s)
        self._polls = max(self._polls, int(self.now_s / POLL_S))

    def heat(self, on: bool) -> None:
        """Blow warm air at the board, or leave it to the room, from now on."""
        goal = HEAT_DEGC if on else 0.0
        if goal != self._heater[2]:
            self._heater = (self.now_s, float(self._warmth(np.array([self.now_s]))[0]), goal)

    def _warmth(self, true_s: F64) -> F64:
        since, warm, goal = self._heater
        return np.asarray(goal + (warm - goal) * np.exp(-np.maximum(true_s - since, 0.0) / HEAT_S))

    @property
    def host_time_s(self) -> float:
        return HOST_EPOCH_S + self.now_s

    def advance(self, n: int) -> Samples:
        """The next n samples of every channel; true time goes on to when the last of them was taken."""
        own, true = self.daq.times(n)
        delay = self.daq.spec.channel_delay_s
        at = {axis: true + i * delay for i, axis in enumerate(self._output)}
        moved = {axis: servo.motion(at.get(axis, true)) for axis, servo in self.servos.items()}
        rates = {axis: rate for axis, (_, rate) in moved.items()}
        angles = {axis: angle for axis, (angle, _) in moved.items()}
        if self.tilt and rates["z"].any():
            rates["z"] = rates["z"] * np.cos(np.radians(angles["x"]))
        temperature, supply = self._surroundings(true) if self.covariates or self._feels else (None, None)
        columns = [output(Truth(at[axis], rates, angles, temperature, supply)) for axis, output in self._output.items()]
        if self.covariates and temperature is not None and supply is not None:
            noise = self._noise.standard_normal((2, n))
            columns += [0.01 * (temperature + 0.1 * noise[0]), 0.5 * (supply + 0.001 * noise[1])]
        volts = self.daq.convert(np.column_stack(columns))
        self.now_s = float(true[-1])
        return Samples(own, volts, self.host_time_s + self.daq.latency_s(n))

    def _surroundings(self, true_s: F64) -> tuple[F64, F64]:
        """Temperature (°C) and supply (V) around the board: a bench that warms by a degree in half an hour."""
        room = 26.0 - np.exp(-true_s / 1800.0) + self.warming_degC_per_s * true_s
        return room + self._warmth(true_s), np.full(len(true_s), 3.0)

    def encoders(self) -> dict[str, tuple[F64, F64]]:
        """What the bus thread has read since the last call: per axis host times (m,) and angles (m,)."""
        until = int((self.now_s - 2.0 * ASK_S) / POLL_S)
        n = max(0, until - self._polls)
        asked = (self._polls + 1 + np.arange(n)) * POLL_S + POLL_JITTER_S * self._poll.random(n)
        self._polls += n
        read = {}
        for i, (axis, servo) in enumerate(self.servos.items()):
            middle = asked + (i + 0.5) * ASK_S
            latched = middle + LATCH_S + LATCH_JITTER_S * self._poll.standard_normal(n)
            # The jitter is far below the 10 ms between polls, so these times increase.
            angle, rate = servo.motion(latched)
            if axis in self._encoder:
                angle = angle + self._encoder[axis](Truth(latched, {axis: rate}, {axis: angle}))
            read[axis] = HOST_EPOCH_S + middle, to_deg(to_code(angle))
            servo.forget(self._polls * POLL_S)
        return read
