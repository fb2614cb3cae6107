"""The encoder's track is not centred on the axis."""

import numpy as np

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class EncoderEccentricity(Effect):
    """The encoder's track is not centred on the axis.

    Equation:      encoder = angle + a sin(angle) + b (cos(angle) - 1) + a2 sin(2 angle) + b2 (cos(2 angle) - 1)
    Cause:         a disc or a potentiometer's wiper off its centre
    Signature:     the error in angle comes back every turn, the same whatever the speed
    Confused with: g_sensitivity in slow motion, encoder_nonlinearity over short strokes
    Excite it:     long strokes, at several speeds
    Source:        METHOD 4
    """

    name, stage, acts, needs = "encoder_eccentricity", Stage.TABLE, Acts.ANGLE, ()
    a = Param("deg", 0.5, (-10.0, 10.0))
    b = Param("deg", 0.5, (-10.0, 10.0))

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        angle = np.radians(c.position_deg)
        return {"a": np.sin(angle), "b": np.cos(angle) - 1.0}
