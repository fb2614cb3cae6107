"""The scale factor is not the same clockwise and anticlockwise."""

import numpy as np

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class ScaleFactorAsymmetry(Effect):
    """The scale factor is not the same clockwise and anticlockwise.

    Equation:      S k |rate|
    Cause:         an asymmetric element or amplifier
    Signature:     residual is a V in rate
    Confused with: scale_factor_quadratic; in position tests a bias that has moved since it was estimated
    Excite it:     slow and fast rates of both signs
    Source:        IEEE Std 528, scale-factor asymmetry
    """

    name, stage, acts, needs = "scale_factor_asymmetry", Stage.SENSOR, Acts.RATE, ()
    k = Param("1", 4e-3, (-0.5, 0.5), code="abs(rate_dps)")

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        return {"k": np.abs(c.rate_dps)}
