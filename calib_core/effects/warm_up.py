"""The bias settles after switching on."""

import numpy as np

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage

COOLING_DEGC, BEGINNING_S = 10.0, 600.0
"""A gyro's 20 mW warm it by 3 °C (150 °C/W). Where the first minutes cool it by three times that it is no cold start:
what settles then follows the temperature."""


class WarmUp(Effect):
    """The bias settles after switching on.

    Equation:      V += a exp(-t / tau)
    Cause:         the part heats itself until it is in balance with its surroundings
    Signature:     residual starts away from zero and dies out, at any rate
    Confused with: bias_drift, bias_temperature
    Excite it:     a cold start, held still
    Source:        IEEE Std 528, warm-up time
    """

    name, stage, acts, needs = "warm_up", Stage.ELECTRICS, Acts.OUTPUT, ()
    a = Param("{out}", 4.5e-3, (-0.5, 0.5), code="exp(-time_s / tau)")
    tau = Param("s", 40.0, (3.0, 2000.0), grid=(8.0, 16.0, 32.0, 64.0, 128.0, 256.0), log=True)

    @classmethod
    def missing(cls, c: Covariates) -> bool:
        """Whether the record begins hot, and cools, where a cold start is needed."""
        t = c.temperature_c
        return t is not None and float(t[0] - t[c.time_s <= BEGINNING_S].min()) > COOLING_DEGC

    @classmethod
    def columns(cls, c: Covariates, **nonlinear: float) -> dict[str, F64]:
        return {"a": np.exp(-c.time_s / nonlinear["tau"])}
