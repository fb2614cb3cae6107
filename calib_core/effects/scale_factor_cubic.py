"""The output falls behind, or runs ahead, at high rates."""

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class ScaleFactorCubic(Effect):
    """The output falls behind, or runs ahead, at high rates.

    Equation:      S k rate**3
    Cause:         springs stiffen, drive and sense electrodes lose linearity
    Signature:     residual is an S in rate: opposite signs for opposite directions
    Confused with: saturation, scale_factor_temperature, dead_band
    Excite it:     a staircase of rates to the rig's top speed
    Source:        IEEE Std 528, scale-factor non-linearity; thesis tables 5.3 to 5.6 show it on all four axes
    """

    name, stage, acts, needs = "scale_factor_cubic", Stage.SENSOR, Acts.RATE, ()
    k = Param("1/(deg/s)^2", 1.2e-6, (-1e-3, 1e-3), code="rate_dps**3")

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        return {"k": c.rate_dps**3}
