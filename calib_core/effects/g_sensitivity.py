"""Gravity, or any specific force, moves the zero-rate output."""

import numpy as np

from calib_core.effects.base import F64, Acts, Covariates, Effect, Param, Stage


class GSensitivity(Effect):
    """Gravity, or any specific force, moves the zero-rate output.

    Equation:      V += k_s sin(tilt) + k_c (cos(tilt) - 1), or K · f with a measured specific force
    Cause:         the proof mass is not balanced about its axis
    Signature:     residual at rest depends on the pose of x, and comes back with it
    Confused with: encoder_eccentricity in slow motion; lag and delay until those are in the model
    Excite it:     static poses and slow tilts of x; turning z never shows it
    Source:        IEEE Std 528, acceleration-sensitive drift rate; thesis 4.1.4
    """

    name, stage, acts = "g_sensitivity", Stage.SENSOR, Acts.OUTPUT
    k_s = Param("{out}", 8e-4, (-0.1, 0.1), code="sin(radians(tilt_deg))")
    k_c = Param("{out}", 8e-4, (-0.1, 0.1), code="cos(radians(tilt_deg)) - 1")
    k_x = Param("{out}/g", 8e-4, (-0.1, 0.1), code="x_acceleration_g")
    k_y = Param("{out}/g", 8e-4, (-0.1, 0.1), code="y_acceleration_g")
    k_z = Param("{out}/g", 8e-4, (-0.1, 0.1), code="z_acceleration_g")

    @classmethod
    def missing(cls, c: Covariates) -> bool:
        return c.tilt_deg is None and not c.specific_force_g

    @classmethod
    def columns(cls, c: Covariates, **_: float) -> dict[str, F64]:
        if c.specific_force_g:
            return {f"k_{axis}": force for axis, force in c.specific_force_g.items()}
        assert c.tilt_deg is not None
        tilt = np.radians(c.tilt_deg)
        return {"k_s": np.sin(tilt), "k_c": np.cos(tilt) - 1.0}
