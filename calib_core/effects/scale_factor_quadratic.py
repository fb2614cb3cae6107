"""The output bends the same way for both directions of rotation."""

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class ScaleFactorQuadratic(Effect):
    """The output bends the same way for both directions of rotation.

    Equation:      S k rate**2; on this table the same column as centripetal g-sensitivity
    Cause:         an asymmetric spring or amplifier, or the centripetal acceleration of a sensor off the axis
    Signature:     residual grows with the square of rate, with one sign
    Confused with: scale_factor_asymmetry
    Excite it:     rates to full scale, both signs, many steps
    Source:        IEEE Std 528, scale-factor non-linearity
    """

    name, stage, acts, needs = "scale_factor_quadratic", Stage.SENSOR, Acts.RATE, ()
    k = Param("1/(deg/s)", 6e-5, (-0.01, 0.01), code="rate_dps**2")

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        return {"k": c.rate_dps**2}
