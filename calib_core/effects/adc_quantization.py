"""The converter knows only so many levels."""

import numpy as np

from calib_core.effects.base import Acts, Chain, Effect, Param, Stage


class AdcQuantization(Effect):
    """The converter knows only so many levels.

    Equation:      V rounded to multiples of step
    Cause:         12 bit differential (1.22 mV) or 11 bit single-ended (9.77 mV) conversion
    Signature:     few distinct values; a histogram with empty places, not a shape in the residual
    Confused with: nothing in this library
    Excite it:     any
    Source:        HARDWARE; METHOD 4
    """

    name, stage, acts = "adc_quantization", Stage.ACQUISITION, Acts.OUTPUT
    step = Param("{out}", 9.77e-3, (0.0, 1.0))

    def apply(self, chain: Chain) -> None:
        if self.values["step"] > 0.0:
            chain.output = np.round(chain.output / self.values["step"]) * self.values["step"]
