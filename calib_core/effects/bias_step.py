"""The bias jumps once."""

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class BiasStep(Effect):
    """The bias jumps once.

    Equation:      V += a [t > t1]
    Cause:         a contact, a knock, a relaxed stress, a supply that was switched
    Signature:     residual is level before t1 and level after it
    Confused with: bias_drift, when t1 is in the middle of a short record
    Excite it:     time: return to rest again and again
    Source:        METHOD 4
    """

    name, stage, acts, needs = "bias_step", Stage.ELECTRICS, Acts.OUTPUT, ()
    a = Param("{out}", 1.2e-3, (-0.5, 0.5), code="where(time_s > t1, 1, 0)")
    t1 = Param("s", 100.0, (0.0, 1e6), grid=(100.0,))

    @classmethod
    def columns(cls, c: Covariates, **nonlinear: float) -> dict[str, F64]:
        return {"a": (c.time_s > nonlinear["t1"]).astype(float)}
