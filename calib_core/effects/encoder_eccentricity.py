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

    a2 = Param("deg", 0.1, (-10.0, 10.0))
    b2 = Param("deg", 0.1, (-10.0, 10.0))
    harmonics = Param("1", 1.0, (1.0, 2.0), grid=(1.0, 2.0), discrete=True)

    @classmethod
    def columns(cls, c: Covariates, **nonlinear: float) -> dict[str, F64]:
        angle = np.radians(c.position_deg)
        shapes = {"a": np.sin(angle), "b": np.cos(angle) - 1.0}
        if nonlinear["harmonics"] > 1.5:
            shapes |= {"a2": np.sin(2.0 * angle), "b2": np.cos(2.0 * angle) - 1.0}
        return shapes
