"""The output feels angular acceleration."""

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class AngularAcceleration(Effect):
    """The output feels angular acceleration.

    Equation:      S k d(rate)/dt
    Cause:         the proof mass hangs off its axis, or the amplifier differentiates
    Signature:     residual at reversals and fast sines, growing with frequency
    Confused with: bandwidth_lag, time_offset: to first order the same column
    Excite it:     several frequencies to 4 Hz
    Source:        IEEE Std 528, angular-acceleration sensitivity
    """

    name, stage, acts, needs = "angular_acceleration", Stage.SENSOR, Acts.RATE, ()
    curvature, third, about = 1.0, 1.0, True
    k = Param("s", 6e-3, (-0.2, 0.2))

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        return {"k": c.acceleration_dps2}
