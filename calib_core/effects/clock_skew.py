"""The gyro's clock runs faster or slower than the encoder's."""

from calib_core.effects.base import F64, Acts, Chain, Covariates, Effect, Param, Stage


class ClockSkew(Effect):
    """The gyro's clock runs faster or slower than the encoder's.

    Equation:      V(t) = V0(t - skew t)
    Cause:         two oscillators
    Signature:     residual follows angular acceleration, more and more as time goes on
    Confused with: time_offset in short records
    Excite it:     a long record with fast motion at both ends
    Source:        METHOD 4
    """

    name, stage, acts, about = "clock_skew", Stage.ACQUISITION, Acts.RATE, True
    skew = Param("1", 2e-5, (-1e-2, 1e-2))

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        return {"skew": -c.time_s * c.acceleration_dps2}

    def apply(self, chain: Chain) -> None:
        """To first order, which is enough where the clocks part by milliseconds."""
        skewed = self.values["skew"] * self.columns(chain.covariates)["skew"]
        chain.output = chain.output + chain.scale_factor * skewed
