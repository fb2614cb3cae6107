"""The rigs: a small protocol for tables and DAQs, and what implements it.

`open_rig(url)` is the one door; a new device is one file and one line there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from calib_core.problem import Problem

if TYPE_CHECKING:
    from server.devices.rig import Rig


class DeviceError(Problem):
    """A device did not do what it should; the sentence says which and what to do."""


def open_rig(url: str) -> Rig:
    """The rig that `url` names, not yet connected: nothing is sent to hardware before `Rig.open`.

    Raises `Problem` for an address that is not understood, `DeviceError` for a port that is not there.
    """
    from server.devices.address import make_rig

    return make_rig(url)
