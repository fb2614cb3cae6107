"""The encoder's potentiometer is not linear."""

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class EncoderNonlinearity(Effect):
    """The encoder's potentiometer is not linear.

    Equation:      encoder = angle + k2 angle**2 + k3 angle**3 (its gain is inseparable from S)
    Cause:         the resistive track is not uniform
    Signature:     the error in angle depends on the angle alone, the same whatever the speed
    Confused with: encoder_eccentricity, g_sensitivity in slow motion
    Excite it:     strokes over the whole range
    Source:        thesis 4.1.2 (the encoder is a potentiometer); METHOD 4
    """

    name, stage, acts, needs = "encoder_nonlinearity", Stage.TABLE, Acts.ANGLE, ()
    k2 = Param("1/deg", 2e-5, (-1e-2, 1e-2))
    k3 = Param("1/deg^2", 2e-7, (-1e-4, 1e-4))

    degree = Param("1", 3.0, (2.0, 3.0), grid=(2.0, 3.0), discrete=True)

    @classmethod
    def columns(cls, c: Covariates, **nonlinear: float) -> dict[str, F64]:
        return {f"k{power}": c.position_deg**power for power in range(2, round(nonlinear["degree"]) + 1)}
