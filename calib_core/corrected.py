"""A recording as an ideal gyro would have made it: what a model's effects did to one axis is taken out of its output.

The corrected output is bias + scale factor × the rate that ``Compensation`` finds, so that everything made for a
linear gyro (estimates, rate and position tests) takes it as it is.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_core import covariates
from calib_core.compensation import Compensation
from calib_core.effects.base import Covariates
from calib_core.problem import Problem
from calib_core.recording import Recording

F64 = NDArray[np.float64]


def corrected(recording: Recording, compensation: Compensation) -> Recording:
    """The recording with the output of the model's axis corrected, and its delay in the header.

    Samples that mean no rate (at a limit) become NaN. Raises Problem ``compensation.…`` where the model needs what the
    recording has not, or is of another axis, unit or board.
    """
    axis, model = compensation.axis, compensation.model
    if axis not in recording.axes:
        raise Problem("compensation.other_axis", axis=axis, axes=", ".join(recording.axes))
    gyro, board = recording.gyro(axis), recording.header.get("board", "")
    if gyro.unit != model.unit:
        raise Problem("compensation.other_unit", unit=model.unit, given=gyro.unit)
    if compensation.board and board and compensation.board != board:
        raise Problem("compensation.other_board", board=compensation.board, given=board)
    index = np.flatnonzero(np.isfinite(gyro.values))
    c = _covariates(recording, axis, index, compensation)
    for effect in compensation.effects:
        for need in effect.needs:
            if getattr(c, need) is None:
                raise Problem("compensation.not_recorded", effect=effect.name, column=need)
    output = np.full(len(recording), np.nan)
    output[index] = model.predict(compensation.rate(gyro.values[index], c))
    late = compensation.delay_s + (0.5 * c.interval_s if compensation.halved else 0.0)
    header = {**recording.header, f"{axis}_gyro_delay_s": repr(gyro.delay_s - late)} if late else recording.header
    name = next(column for column in recording.columns if column.startswith(f"{axis}_gyro_"))
    return replace(recording, columns={**recording.columns, name: output}, header=dict(header))


def _covariates(recording: Recording, axis: str, index: NDArray[np.int64], compensation: Compensation) -> Covariates:
    """What the model's effects depend on, at the samples ``index``; rate and direction are what is sought."""
    time = recording.time_s[index]
    interval = float(np.median(np.diff(time)))

    def angle(of: str) -> F64 | None:
        return covariates._angle(recording, of, time) if f"{of}_position_deg" in recording.columns else None

    none, position, other = np.zeros(len(time)), angle(axis), angle("z" if axis == "x" else "x")
    force = {a: recording.columns.get(f"{a}_acceleration_g") for a in "xyz"}
    return Covariates(
        axis=axis,
        time_s=time - time[0],
        rate_dps=none,
        position_deg=none if position is None else position,
        acceleration_dps2=none,
        direction=none,
        interval_s=interval,
        temperature_c=covariates._slow(recording, "temperature_c", index, interval),
        supply_v=covariates._slow(recording, "supply_v", index, interval),
        other_rate_dps=None
        if other is None
        else np.gradient(covariates._smooth(other, covariates.OTHER_S / interval), interval),
        tilt_deg=angle("x"),
        specific_force_g={a: np.nan_to_num(f[index]) for a, f in force.items() if f is not None} or None,
        reference=compensation.reference,
    )
