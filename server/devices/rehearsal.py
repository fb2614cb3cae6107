"""Before an unknown board a table turns once, slowly, on each axis: what hangs on it may catch, and its gyro may lie.

A board is unknown until it was rehearsed on this rig since the rig was connected. The simulated rig has nothing that
could catch.
"""

from calib_core.gyro_models import GyroModel
from server.devices import DeviceError, start_checks
from server.devices.rig import Rig


def rehearse(rig: Rig, board: str, gyro_model: GyroModel, abort: start_checks.Abort) -> None:
    """Raises DeviceError where the table does not follow, or `rig.rehearsal` where the gyro does not answer as it has
    to; the caller then makes the rig safe. Else it is safe, and has to be begun anew."""
    if rig.simulated or rig.rehearsed == board:
        return
    rig.begin()
    for check in start_checks.gyro_answers(rig, gyro_model, abort=abort):
        if check.ok is False:
            cure = {"code": check.cure, "values": check.values}
            raise DeviceError("rig.rehearsal", found={"code": check.code, "values": check.values}, cure=cure)
    rig.safe()
    rig.rehearsed = board
