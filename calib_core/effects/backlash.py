"""The gears have play: the encoder moves before, or after, the plate."""

import numpy as np

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class Backlash(Effect):
    """The gears have play: the encoder moves before, or after, the plate.

    Equation:      encoder = angle + (b/2) sign(last motion)
    Cause:         clearance between teeth
    Signature:     the error in angle jumps at each reversal
    Confused with: hysteresis, dead_band
    Excite it:     reversals
    Source:        METHOD 4; the servos' gear trains
    """

    name, stage, acts, needs = "backlash", Stage.TABLE, Acts.ANGLE, ()
    b = Param("deg", 0.5, (-10.0, 10.0))

    start = Param("1", 0.0, (-1.0, 1.0), grid=(-1.0, 0.0, 1.0))  # the sign before the first rotation

    @classmethod
    def columns(cls, c: Covariates, **nonlinear: float) -> dict[str, F64]:
        return {"b": np.where(c.direction == 0.0, nonlinear["start"], c.direction) / 2.0}
