"""What NI's driver and its gRPC server say when something is wrong, as a sentence with a cure.

Facts: HARDWARE. All errors of nidaqmx are an `errors.Error`: the driver's carry a code, the server's a gRPC status.
"""

from typing import Any

from server.devices import DeviceError

BY_CODE = {
    -200220: "daq.no_device",
    -200170: "daq.no_channel",
    -200279: "daq.overrun",
    -200284: "daq.late",
    -201003: "daq.unplugged",
    -50405: "daq.unplugged",
    -88710: "daq.unplugged",
    -50103: "daq.reserved",
    -200022: "daq.reserved",
    -200587: "daq.reserved",
    -200088: "daq.taken",
    -200278: "daq.taken",
}
BY_STATUS = {
    "UNAVAILABLE": "daq.server_gone",
    "DEADLINE_EXCEEDED": "daq.server_silent",
    "NOT_FOUND": "daq.no_driver_there",  # the server runs, NI-DAQmx is not installed beside it
    "UNIMPLEMENTED": "daq.server_old",
}
NO_DRIVER = ("DaqNotFoundError", "DaqNotSupportedError")


def fault(error: Exception, **where: Any) -> DeviceError:
    """The `DeviceError` of a `nidaqmx.errors.Error`; `where` goes into its sentence."""
    if type(error).__name__ in NO_DRIVER:
        return DeviceError("daq.no_driver", **where)
    number = getattr(error, "error_code", None)
    if number in BY_CODE:
        return DeviceError(BY_CODE[number], **where)
    status = getattr(getattr(error, "rpc_code", None), "name", "")
    if status in BY_STATUS:
        return DeviceError(BY_STATUS[status], **where)
    said = " ".join(str(error).split())
    return DeviceError("daq.error", **where, number=number if number is not None else status, said=said)
