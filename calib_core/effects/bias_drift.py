"""The bias creeps at a steady pace."""

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class BiasDrift(Effect):
    """The bias creeps at a steady pace.

    Equation:      V += r t
    Cause:         ageing, slow warming or leakage; over minutes any slow change looks straight
    Signature:     residual is a straight line in time, at any rate
    Confused with: warm_up, bias_temperature when temperature rises steadily, bias_random_walk
    Excite it:     time: return to rest again and again
    Source:        IEEE Std 528, drift rate
    """

    name, stage, acts, needs = "bias_drift", Stage.ELECTRICS, Acts.OUTPUT, ()
    r = Param("{out}/s", 8e-6, (-1e-2, 1e-2), code="time_s")

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        return {"r": c.time_s}
