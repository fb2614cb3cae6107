"""The sensor or its filter answers late."""

from calib_core.effects.base import F64, Acts, Chain, Covariates, Effect, Param, Stage


class BandwidthLag(Effect):
    """The sensor or its filter answers late, and damps fast motion.

    Equation:      tau d(rate_s)/dt = rate - rate_s
    Cause:         the sensor's own bandwidth; 33 kΩ and 0.1 µF on the common breakout board are 3.3 ms
    Signature:     residual follows angular acceleration, and fast sines come out smaller
    Confused with: time_offset, angular_acceleration: the same to first order
    Excite it:     several frequencies to 4 Hz together; one alone never separates them
    Source:        IEEE Std 528, bandwidth; HARDWARE
    """

    name, stage, acts = "bandwidth_lag", Stage.SENSOR, Acts.RATE
    positive, curvature, about = True, 0.0, True
    tau = Param("s", 6e-3, (0.0, 0.2))

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        return {"tau": -c.acceleration_dps2}

    def apply(self, chain: Chain) -> None:
        if self.values["tau"] > 0.0:
            chain.rate_dps = chain.covariates.lagged(chain.rate_dps, self.values["tau"], "bandwidth_lag")
