"""From motions to servo goals: a `Move` is one goal with a speed, a `Wave` is a stream of them at 50 Hz.

There is no watchdog on the bus: with the host gone a servo finishes its last goal. So a stream leads by 40 ms at most.
"""

from calib_core.sequence import Motion, Move

PERIOD_S = 0.02
LEAD_S = 0.04


def goal(motion: Motion, time_s: float) -> tuple[float, float]:
    """Goal (deg) and speed (deg/s) to command `time_s` after the step of this motion began."""
    if isinstance(motion, Move):
        return motion.to_deg, motion.rate_dps
    ahead = motion.angle_deg(0.0, time_s + LEAD_S)
    return ahead, abs(ahead - motion.angle_deg(0.0, time_s)) / LEAD_S


def times(motion: Motion) -> list[float]:
    """When, after the step began, this motion needs a command."""
    if isinstance(motion, Move):
        return [motion.start_s]
    return [motion.start_s + i * PERIOD_S for i in range(round(motion.duration_s / PERIOD_S) + 1)]
