"""Slow rotation is not felt at all."""

import numpy as np

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class DeadBand(Effect):
    """Slow rotation is not felt at all.

    Equation:      0 for |rate| < d, rate - d sign(rate) above
    Cause:         stiction, or a comparator's threshold in the loop
    Signature:     residual is a step between the two directions, with a ramp for the slowest rates
    Confused with: hysteresis, backlash
    Excite it:     slow rates of both signs
    Source:        IEEE Std 528, dead band
    """

    name, stage, acts = "dead_band", Stage.SENSOR, Acts.RATE
    d = Param("deg/s", 2.0, (0.005, 20.0), grid=(0.03, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0), log=True)

    @classmethod
    def columns(cls, c: Covariates, **nonlinear: float) -> dict[str, F64]:
        return {"": -np.clip(c.rate_dps, -nonlinear["d"], nonlinear["d"])}
