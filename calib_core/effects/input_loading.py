"""The converter's input loads the sensor's output."""

from calib_core.effects.base import Acts, Chain, Effect, Param, Stage


class InputLoading(Effect):
    """The converter's input loads the sensor's output.

    Equation:      V = g V_source + (1 - g) V_input, g = 144 kΩ / (144 kΩ + R_source)
    Cause:         a source resistance in front of an input of 144 kΩ to about 1.4 V
    Signature:     none in a recording: it hides in bias and scale factor
    Confused with: bias and scale factor themselves
    Excite it:     compare with the datasheet, or with the source resistance bridged
    Source:        HARDWARE; METHOD 4
    """

    name, stage, acts = "input_loading", Stage.ACQUISITION, Acts.OUTPUT
    loss = Param("1", 0.0, (0.0, 1.0))
    V_input = Param("{out}", 1.4, (-10.0, 10.0))

    def apply(self, chain: Chain) -> None:
        loss = self.values["loss"]
        chain.output = (1.0 - loss) * chain.output + loss * self.values["V_input"]
