"""A simulated NI USB-6008: one multiplexed 12-bit converter with its own clock behind a USB cable."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

PIECE = 50  # samples in one USB transfer


@dataclass(frozen=True)
class DaqSpec:
    """Differential ±2.5 V: 1.2207 mV a step. Channels are converted `channel_delay_s` one after another."""

    rate_hz: float = 1000.0
    step_V: float = 5.0 / 4096.0
    limit_V: float = 2.5
    channel_delay_s: float = 1e-4
    clock_error: float = 0.0  # its second is 1 + clock_error true seconds
    transfer_s: float = 0.0015  # the least time from conversion to the host
    transfer_scatter_s: float = 0.001  # exponential, on top
    hiccup_s: float = 0.015  # one transfer in a hundred is this late


class Daq:
    """Sample times and codes. Sampling starts at true time `start_s`; its own clock is 0 there."""

    def __init__(self, spec: DaqSpec, rng: np.random.Generator) -> None:
        self.spec, self._rng = spec, rng
        self.start_s = 0.0
        self.taken = 0

    def start(self, true_s: float) -> None:
        self.start_s, self.taken = true_s, 0

    def times(self, n: int) -> tuple[F64, F64]:
        """The next n samples' times of the first channel, (n,) by its own clock and (n,) true."""
        own = np.arange(self.taken, self.taken + n) / self.spec.rate_hz
        self.taken += n
        return own, self.start_s + own * (1.0 + self.spec.clock_error)

    def convert(self, volts: F64) -> F64:
        """What the converter gives for these volts."""
        codes = np.rint(volts * (1.0 / self.spec.step_V))
        half = round(self.spec.limit_V / self.spec.step_V)
        np.clip(codes, -half, half - 1, out=codes)
        codes *= self.spec.step_V
        return codes

    def latency_s(self, n: int) -> float:
        """How long after its last sample a transfer of ``n`` reaches the host.

        A long one comes in pieces, of which the promptest tells of the clocks: it stands for all.
        """
        pieces = max(1, n // PIECE)
        late = self._rng.exponential(self.spec.transfer_scatter_s / pieces)
        hiccup = self.spec.hiccup_s if self._rng.random() < 0.01**pieces else 0.0
        return self.spec.transfer_s + float(late) + hiccup
