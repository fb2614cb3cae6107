"""The mains' frequency rides on the output."""

import numpy as np

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class MainsHum(Effect):
    """The mains' frequency rides on the output.

    Equation:      V += A sin(2 pi f t) + B cos(2 pi f t), f near 50 or 60 Hz or its alias
    Cause:         loops and fields in the wiring, a supply's ripple
    Signature:     one line in the spectrum of V, whatever the motion
    Confused with: nothing in this library
    Excite it:     any hold
    Source:        METHOD 4
    """

    name, stage, acts = "mains_hum", Stage.ELECTRICS, Acts.OUTPUT
    A = Param("{out}", 1e-3, (-1.0, 1.0))
    B = Param("{out}", 1e-3, (-1.0, 1.0))
    f = Param("Hz", 50.0, (40.0, 70.0), grid=(50.0, 60.0))

    @classmethod
    def columns(cls, c: Covariates, **nonlinear: float) -> dict[str, F64]:
        phase = 2.0 * np.pi * nonlinear["f"] * c.time_s
        return {"A": np.sin(phase), "B": np.cos(phase)}
