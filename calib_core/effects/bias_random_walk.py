"""The bias wanders without a pattern."""

import numpy as np

from calib_core.effects.base import Acts, Chain, Effect, Param, Stage


class BiasRandomWalk(Effect):
    """The bias wanders without a pattern.

    Equation:      the variance of the bias grows by k**2 a second (Allan slope +1/2)
    Cause:         flicker and slow relaxation in element and electronics
    Signature:     residual drifts smoothly, now up, now down; its Allan deviation rises with averaging time
    Confused with: bias_drift, warm_up
    Excite it:     a long hold
    Source:        IEEE Std 952, rate random walk
    """

    name, stage, acts = "bias_random_walk", Stage.ELECTRICS, Acts.OUTPUT
    k = Param("{out}/sqrt(s)", 5e-5, (0.0, 1.0))

    def apply(self, chain: Chain) -> None:
        c = chain.covariates
        steps = self.values["k"] * np.sqrt(c.interval_s) * chain.rng.standard_normal(len(chain.output))
        walk = c.memory.get("bias_random_walk", np.zeros(1))[-1] + np.cumsum(steps)
        c.memory["bias_random_walk"] = walk[-1:]
        chain.output = chain.output + walk
