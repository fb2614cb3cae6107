"""The output follows the supply."""

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class SupplySensitivity(Effect):
    """The output follows the supply.

    Equation:      V += k (Vdd - V0), and ratiometric S (1 + s (Vdd - V0))
    Cause:         the zero and the gain are derived from the supply
    Signature:     residual follows the supply, at rest and in proportion to rate
    Confused with: whatever moves with the supply's own load
    Excite it:     a supply swing
    Source:        IEEE Std 528, power-supply sensitivity
    """

    name, stage, acts, needs = "supply_sensitivity", Stage.ELECTRICS, Acts.OUTPUT, ("supply_v",)
    k = Param("{out}/V", 0.04, (-10.0, 10.0), code="supply_v - reference_supply_v")

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        assert c.supply_v is not None
        return {"k": c.supply_v - c.reference["supply_v"]}
