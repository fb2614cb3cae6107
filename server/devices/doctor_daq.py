"""What `gyrobench doctor` looks at in a DAQ: its driver, its devices, and whether samples come. Nothing moves."""

from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from calib_core.problem import Problem
from server.devices import DeviceError
from server.devices.check import Check
from server.devices.ni_daq import NiDaq
from server.devices.ni_faults import fault
from server.devices.ni_session import devices

LOOK_S = 1.0


def checks(address: str) -> Iterator[Check]:
    """Checks of the DAQ at `address` (what stands after `nidaq:`); each that fails ends them."""
    from nidaqmx.errors import Error

    try:
        daq = NiDaq.from_url(address)
    except Problem as problem:
        yield Check("daq", False, problem.code, dict(problem.values))
        return
    where = daq.where()
    try:
        version, found = devices(daq.server)
    except Error as error:
        absent = fault(error, **where)
        yield Check("daq driver", False, absent.code, dict(absent.values))
        return
    names = [f"{name} ({product})" for name, product in found.items()]
    yield Check("daq driver", True, "check.daq_driver", {**where, "version": version, "devices": names or ["–"]})
    try:
        daq.open()
        daq.start()
        yield _samples(daq)
    except DeviceError as problem:
        cure = "cure.daq_name" if problem.code == "daq.no_device" and found else ""
        yield Check("daq", False, problem.code, {**problem.values, "devices": names}, cure)
    finally:
        with suppress(DeviceError):
            daq.close()


def _samples(daq: NiDaq) -> Check:
    """A second of samples: their rate by this computer's clock, and what stands on each input."""
    n = round(daq.rate_hz * LOOK_S)
    first = daq.read(round(daq.rate_hz / 10))
    samples = daq.read(n)
    rate_hz = n / (samples.host_time_s - first.host_time_s)
    noise_mV = 1e3 * np.std(samples.volts, axis=0)
    inputs = [
        f"{name} {volts:.3f} V ± {noise:.1f} mV"
        for name, volts, noise in zip(daq.inputs, samples.volts.mean(axis=0), noise_mV, strict=True)
    ]
    return Check("daq", True, "check.daq_samples", {"part": daq.part, "rate_hz": rate_hz, "inputs": inputs})
