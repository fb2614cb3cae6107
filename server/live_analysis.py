"""What a viewer sees while a state runs: rates, the filtered signal, the adaptive parameters, and points as they come.

The same filter, law and test functions as the analysis of the stored recording, fed in blocks. Nothing from here is
certified.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from calib_core import position_test, rate_test
from calib_core.adaptation import GAMMA_1, Adapter, compensate, encoder_rate
from calib_core.kalman import Filter, tuning
from calib_core.recording import Recording, parse_segment
from calib_core.sequence import Plan, State, Wave

F64 = npt.NDArray[np.float64]
DT = 0.01
PLOTTED_ROWS = 2  # every second row is drawn: 50 a second
TRACED_ROWS = 10
WAIT_S = 0.3  # a row waits this long for the encoder reading after it
GAIN_DENSITY = 1e-8  # V²·s; the gain in use depends on omega_n alone


class LiveAnalyser:
    """One state at a time. ``parameters``: bias (V) and scale factor (V per deg/s) of each axis, as known so far."""

    def __init__(self, plan: Plan, parameters: Mapping[str, tuple[float, float]]) -> None:
        self._plan = plan
        self.parameters = {
            axis: (sheet.bias_V, sheet.scale_factor_V_per_dps) for axis, sheet in plan.gyro_model.axes.items()
        } | dict(parameters)

    def begin(self, state: State) -> None:
        self._state = state
        self._axis = state.axis
        gain = tuning(GAIN_DENSITY)
        self._output, self._rate = Filter(gain, DT), Filter(gain, DT)
        self._adapter = self._adaptive(state)
        self._rows = _nothing(3)  # time, V, 1 in the estimate's motion: rows that wait for the encoder
        self._readings = _nothing(2)
        self._counted = 0
        self._stroke: list[Recording] = []

    def _adaptive(self, state: State) -> Adapter | None:
        waves = [motion for step in state.steps for motion in step.motions if isinstance(motion, Wave)]
        if state.kind != "estimate" or not waves:
            return None
        terms = zip(waves[0].amplitudes_deg, waves[0].frequencies_hz, strict=True)
        mean_square = sum((2.0 * math.pi * f * a) ** 2 / 2.0 for a, f in terms)
        bias, scale_factor = self.parameters[state.axis]
        return Adapter(GAMMA_1, GAMMA_1 / mean_square, DT, bias, scale_factor)

    def rows(self, block: Recording) -> tuple[dict[str, F64], list[dict[str, Any]]]:
        """Arrays to plot and test points that were completed, after one more block of rows."""
        points = self._points(block)
        in_motion = block.where(lambda segment: segment == self._state.name)
        new = np.array([block.time_s, block.gyro(self._axis).values, in_motion])
        self._rows = np.concatenate([self._rows, new], axis=1)
        self._readings = np.concatenate([self._readings, np.array(block.position(self._axis))], axis=1)
        return self._arrays(), points

    def _arrays(self) -> dict[str, F64]:
        time, angle = self._readings
        if len(time) < 3 or not self._rows.shape[1]:
            return {}
        waiting = self._rows[0]
        ready = (waiting + DT / 2 <= time[-1]) | (waiting < waiting[-1] - WAIT_S)
        done = int(np.argmin(ready)) if not ready.all() else len(ready)
        (row_time, v, in_motion), self._rows = self._rows[:, :done], self._rows[:, done:]
        if not done:
            return {}
        rate = self._rate.update(encoder_rate(time, angle, row_time, DT))
        filtered = self._output.update(v)
        self._readings = self._readings[:, time > row_time[-1] - WAIT_S]

        bias, scale_factor = self.parameters[self._axis]
        of_rows: dict[str, F64] = {}
        if self._adapter is not None:
            learning = np.where(in_motion > 0, filtered, np.nan)
            biases, scales = self._adapter.update(learning, rate)
            gyro_rate = (filtered - biases) / scales
            traced = self._every(TRACED_ROWS, done) & (in_motion > 0)
            of_rows = {"trace_time_s": row_time, "adaptive_bias_V": biases, "adaptive_scale_factor": scales}
            of_rows = {name: values[traced] for name, values in of_rows.items()}
        else:
            gyro_rate = compensate(filtered, bias, scale_factor)
        plotted = self._every(PLOTTED_ROWS, done)
        columns = {
            "time_s": row_time,
            "encoder_rate_dps": rate,
            "gyro_rate_dps": gyro_rate,
            "filtered_V": filtered,
            "gyro_V": v,
        }
        of_rows |= {name: values[plotted] for name, values in columns.items()}
        self._counted += done
        return {f"{self._axis}.{name}": values for name, values in of_rows.items()}

    def _every(self, step: int, rows: int) -> npt.NDArray[np.bool_]:
        chosen: npt.NDArray[np.bool_] = (self._counted + np.arange(rows)) % step == 0
        return chosen

    def _points(self, block: Recording) -> list[dict[str, Any]]:
        """The readings whose stroke has ended with this block."""
        found = []
        for run in block.runs():
            if self._stroke and self._stroke[0].segment_names != (run.name,):
                found += self.stroke_ended()
            if parse_segment(run.name):
                part = block.take(run.rows)
                codes = np.zeros(len(part), np.int32)
                self._stroke.append(Recording(part.time_s, part.columns, codes, (run.name,), part.header))
        return found

    def stroke_ended(self) -> list[dict[str, Any]]:
        """The reading of the stroke so far, if it is one; also to be called as a state ends."""
        if not self._stroke:
            return []
        stroke, self._stroke = Recording.join(self._stroke), []
        test = {"rate": rate_test, "position": position_test}[self._state.kind]
        found = test.points(stroke, self._axis, *self.parameters[self._axis], self._plan.profile)
        return [
            {
                "state": self._state.name,
                "test": str(found.test[i]),
                "set_point": float(found.set_point[i]),
                "reading": int(found.reading[i]),
                "reference": float(found.reference[i]),
                "gyro": float(found.gyro[i]),
            }
            for i in range(len(found))
        ]


def _nothing(columns: int) -> F64:
    return np.empty((columns, 0))
