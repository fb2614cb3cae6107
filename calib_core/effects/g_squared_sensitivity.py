"""The zero-rate output moves with the square of specific force."""

import numpy as np

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class GSquaredSensitivity(Effect):
    """The zero-rate output moves with the square of specific force.

    Equation:      V += k_s sin(2 tilt) + k_c (cos(2 tilt) - 1), or k_xx fx² + ... with a measured specific force
    Cause:         anisoelasticity: the suspension gives more in one direction than in another
    Signature:     residual at rest follows the pose of x twice per turn
    Confused with: g_sensitivity over short tilts
    Excite it:     static poses all around
    Source:        IEEE Std 528, acceleration-squared-sensitive drift rate
    """

    name, stage, acts = "g_squared_sensitivity", Stage.SENSOR, Acts.OUTPUT
    k_s = Param("{out}", 4e-4, (-0.1, 0.1), code="sin(radians(2 * tilt_deg))")
    k_c = Param("{out}", 4e-4, (-0.1, 0.1), code="cos(radians(2 * tilt_deg)) - 1")
    k_xx = Param("{out}/g^2", 4e-4, (-0.1, 0.1), code="x_acceleration_g**2")
    k_yy = Param("{out}/g^2", 4e-4, (-0.1, 0.1), code="y_acceleration_g**2")
    k_zz = Param("{out}/g^2", 4e-4, (-0.1, 0.1), code="z_acceleration_g**2")

    @classmethod
    def missing(cls, c: Covariates) -> bool:
        return c.tilt_deg is None and not c.specific_force_g

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        if c.specific_force_g:
            return {f"k_{axis}{axis}": force**2 for axis, force in c.specific_force_g.items()}
        assert c.tilt_deg is not None
        tilt = np.radians(2.0 * c.tilt_deg)
        return {"k_s": np.sin(tilt), "k_c": np.cos(tilt) - 1.0}
