"""The sensor is warmed later than the thermometer beside it."""

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class ThermalLag(Effect):
    """The sensor is warmed later than the thermometer beside it.

    Equation:      V += k T_slow, tau dT_slow/dt = (T - T0) - T_slow
    Cause:         heat takes time to reach the sensing element
    Signature:     residual against temperature opens into a loop: one branch heating, one cooling
    Confused with: bias_temperature, bias_drift
    Excite it:     heat and cool, faster than tau
    Source:        IEEE Std 528, temperature-gradient sensitivity; METHOD 4
    """

    name, stage, acts, needs = "thermal_lag", Stage.ELECTRICS, Acts.OUTPUT, ("temperature_c",)
    k = Param("{out}/degC", 4e-4, (-1e-2, 1e-2), code="lagged(warmth, tau)")
    tau = Param("s", 25.0, (2.0, 3000.0), grid=(6.0, 12.0, 24.0, 48.0, 96.0, 200.0, 500.0), log=True)

    @classmethod
    def columns(cls, c: Covariates, **nonlinear: float) -> dict[str, F64]:
        return {"k": c.lagged(c.warmth, nonlinear["tau"], f"thermal_lag {nonlinear['tau']}")}
