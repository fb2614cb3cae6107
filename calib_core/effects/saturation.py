"""The output stops at a limit."""

import numpy as np

from calib_core.effects.base import Acts, Chain, Effect, Param, Stage


class Saturation(Effect):
    """The output stops at a limit.

    Equation:      V clipped to [V_lo, V_hi]
    Cause:         the amplifier's rail, the converter's range, a supply too low
    Signature:     at high rates the output stays on one level whatever the rate
    Confused with: scale_factor_cubic, when only the fastest strokes are cut
    Excite it:     rates past the limit, at more than one speed
    Source:        METHOD 4
    """

    name, stage, acts = "saturation", Stage.ACQUISITION, Acts.OUTPUT
    V_lo = Param("{out}", 0.7, (-1e9, 1e9))
    V_hi = Param("{out}", 1.8, (-1e9, 1e9))

    def __init__(self, **values: float) -> None:
        super().__init__(**{"V_lo": -np.inf, "V_hi": np.inf} | values)

    def apply(self, chain: Chain) -> None:
        chain.output = np.clip(chain.output, self.values["V_lo"], self.values["V_hi"])
