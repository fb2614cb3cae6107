"""The gyro's samples are stamped late, or early."""

import numpy as np

from calib_core.effects.base import F64, Acts, Chain, Covariates, Effect, Param, Stage


class TimeOffset(Effect):
    """The gyro's samples are stamped early or late against the encoder's.

    Equation:      V(t) = V0(t - delay)
    Cause:         two clocks, a buffer, a bus
    Signature:     residual follows angular acceleration; fast sines keep their size
    Confused with: bandwidth_lag, angular_acceleration: the same to first order
    Excite it:     several frequencies to 4 Hz together; one alone never separates them
    Source:        METHOD 2, 4
    """

    name, stage, acts = "time_offset", Stage.ACQUISITION, Acts.RATE
    curvature, third, about = 0.5, 1.0 / 6.0, True
    delay = Param("s", 6e-3, (-0.2, 0.2))

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        return {"delay": -c.acceleration_dps2}

    def apply(self, chain: Chain) -> None:
        """Delays the output; the signal before the first block counts as settled on its first value."""
        c, delay = chain.covariates, self.values["delay"]
        if delay < 0.0:
            raise ValueError("time_offset: a simulated gyro cannot answer before it moves; give a delay >= 0")
        count = int(np.ceil(delay / c.interval_s)) + 1
        before = c.memory.get("time_offset", np.full(count, chain.output[0]))
        line = np.concatenate([before, chain.output])
        c.memory["time_offset"] = line[-count:]
        at = np.arange(len(before), len(line))
        chain.output = np.interp(at - delay / c.interval_s, np.arange(len(line)), line)
