"""The rig's own check (thesis 4.1.3): a step of the table, and how well it kept its commanded rate and angle."""

from dataclasses import dataclass

import numpy as np

from calib_core.position_test import rests
from calib_core.problem import Problem
from calib_core.rate_test import code_weight, steady
from calib_core.recording import Recording, Segment
from calib_core.strokes import collect

TO_DEG = 120.0
RATE_DPS = 60.0


@dataclass(frozen=True)
class StepCheck:
    """What the encoder says of a step to ``to_deg`` at ``rate_dps``; the thesis' rig had 3.18 % and 0.29 %."""

    to_deg: float
    rate_dps: float
    measured_deg: float
    measured_dps: float

    @property
    def rate_error_pct(self) -> float:
        return 100.0 * abs(self.measured_dps - self.rate_dps) / self.rate_dps

    @property
    def position_error_pct(self) -> float:
        return 100.0 * abs(self.measured_deg - self.to_deg) / abs(self.to_deg)

    def to_json(self) -> dict[str, float]:
        names = ("to_deg", "rate_dps", "measured_deg", "measured_dps", "rate_error_pct", "position_error_pct")
        return {name: getattr(self, name) for name in names}


def step(recording: Recording, axis: str, to_deg: float = TO_DEG, rate_dps: float = RATE_DPS) -> StepCheck | None:
    """The last ``step_<axis>`` of a recording, from rest at 0 to rest at ``to_deg`` at ``rate_dps``; None without one.

    Raises Problem ``rig_check.no_step`` where the table did not turn or did not come to rest.
    """
    run = next((run for run in reversed(recording.runs()) if run.name == f"step_{axis}"), None)
    if run is None:
        return None
    segment = Segment("rate", axis, "step", rate_dps, 1)
    strokes = collect(recording, axis, {segment: (run.start, run.stop - 1)})
    slope, _, _ = strokes.slope(strokes.angle_deg, code_weight(strokes, steady(strokes)))
    rest = rests(strokes)
    if not (np.isfinite(slope[0]) and rest.leave_s[0] < rest.arrive_s[0] < rest.until_s[0]):
        raise Problem("rig_check.no_step", axis=axis, to_deg=to_deg, rate_dps=rate_dps)
    return StepCheck(to_deg, rate_dps, float(rest.after_deg[0] - rest.before_deg[0]), abs(float(slope[0])))
