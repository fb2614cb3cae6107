"""The zero depends on which way the gyro turned last."""

import numpy as np

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class Hysteresis(Effect):
    """The zero depends on which way the gyro turned last.

    Equation:      V += h sign(last rotation)
    Cause:         friction and stress left behind in package and mounting
    Signature:     residual at rest takes one of two levels
    Confused with: backlash, dead_band
    Excite it:     reversals, with rests after both directions
    Source:        IEEE Std 528, hysteresis error
    """

    name, stage, acts, needs = "hysteresis", Stage.SENSOR, Acts.OUTPUT, ()
    h = Param("{out}", 6e-4, (-0.1, 0.1), code="where(direction == 0, start, direction)")

    start = Param("1", 0.0, (-1.0, 1.0), grid=(-1.0, 0.0, 1.0))  # the sign before the first rotation

    @classmethod
    def columns(cls, c: Covariates, **nonlinear: float) -> dict[str, F64]:
        return {"h": np.where(c.direction == 0.0, nonlinear["start"], c.direction)}
