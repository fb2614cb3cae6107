"""The axis feels rotation about the other axis."""

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class CrossAxis(Effect):
    """The axis feels rotation about the other axis.

    Equation:      S k rate_other
    Cause:         the sensor is not mounted square: input-axis misalignment
    Signature:     residual moves when the other axis moves, at rest of its own
    Confused with: nothing in this library
    Excite it:     move the other axis
    Source:        IEEE Std 528, input-axis misalignment; thesis 4.1.4
    """

    name, stage, acts, needs = "cross_axis", Stage.TABLE, Acts.RATE, ("other_rate_dps",)
    k = Param("1", 8e-3, (-0.5, 0.5), code="other_rate_dps")

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        assert c.other_rate_dps is not None
        return {"k": c.other_rate_dps}
