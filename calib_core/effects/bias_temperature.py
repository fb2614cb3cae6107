"""Zero-rate output that moves with temperature."""

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class BiasTemperature(Effect):
    """Zero-rate output that moves with temperature.

    Equation:      V += k1 (T - T0) + k2 (T - T0)**2 + k3 (T - T0)**3
    Cause:         stress and stiffness of the vibrating structure change with temperature
    Signature:     residual follows temperature at any rate, the same in both directions
    Confused with: bias_drift and warm_up, when temperature rises steadily; thermal_lag
    Excite it:     hold still, heat, then cool
    Source:        IEEE Std 528, bias temperature sensitivity; thesis 6.2 (5)
    """

    name, stage, acts, needs = "bias_temperature", Stage.ELECTRICS, Acts.OUTPUT, ("temperature_c",)
    k1 = Param("{out}/degC", 2e-4, (-1e-2, 1e-2), code="warmth")
    k2 = Param("{out}/degC^2", 5e-6, (-1e-3, 1e-3), code="warmth**2")
    k3 = Param("{out}/degC^3", 1e-7, (-1e-4, 1e-4), code="warmth**3")

    degree = Param("1", 1.0, (1.0, 3.0), grid=(1.0, 2.0, 3.0), discrete=True)

    @classmethod
    def columns(cls, c: Covariates, **nonlinear: float) -> dict[str, F64]:
        return {f"k{power}": c.warmth**power for power in range(1, round(nonlinear["degree"]) + 1)}
