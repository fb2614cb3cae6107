"""The scale factor changes with temperature."""

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class ScaleFactorTemperature(Effect):
    """The scale factor changes with temperature.

    Equation:      S (1 + k (T - T0))
    Cause:         drive amplitude, quality factor and gain of the electronics depend on temperature
    Signature:     residual proportional to rate, with a factor that follows temperature
    Confused with: scale_factor_cubic, when fast strokes fall together with warm stretches
    Excite it:     the same rates at several temperatures
    Source:        IEEE Std 528, scale factor temperature sensitivity
    """

    name, stage, acts, needs = "scale_factor_temperature", Stage.SENSOR, Acts.RATE, ("temperature_c",)
    k = Param("1/degC", 8e-4, (-0.05, 0.05), code="warmth * rate_dps")

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        return {"k": c.warmth * c.rate_dps}
