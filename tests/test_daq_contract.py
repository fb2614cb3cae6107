"""What every DAQ must do: the same assertions on the twin's converter and on the real driver."""

from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from ni_bench import bench

from calib_core.twin import Plant
from server.devices import DeviceError
from server.devices.clock import ClockRelation
from server.devices.ni_daq import NiDaq
from server.devices.protocols import Daq
from server.devices.rig import Rig
from server.devices.twin_rig import TwinDaq, TwinTable
from server.emulators.plant import PlantClient
from server.emulators.process import Child


@pytest.fixture(params=["twin", "nidaq"])
def daq(request: pytest.FixtureRequest) -> Iterator[Daq]:
    if request.param == "twin":
        yield TwinDaq(TwinTable(Plant(1, covariates=True)))
        return
    with bench() as ni, closing(ni.daq("Dev1?channels=ai0,ai1,ai2,ai3")) as made:
        yield made


def test_it_says_what_its_columns_and_its_clock_are_before_it_is_opened(daq: Daq) -> None:
    assert daq.channels == ("x_gyro_v", "z_gyro_v", "temperature_c", "supply_v")
    assert daq.rate_hz == 1000.0
    assert 0.0 <= daq.channel_delay_s < 1.0 / daq.rate_hz / len(daq.channels)
    assert daq.part


def test_samples_follow_each_other_by_its_own_clock_from_0(daq: Daq) -> None:
    daq.open()
    daq.start()
    samples = [daq.read(n) for n in (100, 10, 250)]
    time_s = np.concatenate([part.time_s for part in samples])
    np.testing.assert_allclose(time_s, np.arange(360) / 1000.0, atol=1e-12)
    assert [part.volts.shape for part in samples] == [(100, 4), (10, 4), (250, 4)]
    assert all(np.isfinite(part.volts).all() for part in samples)
    arrivals = [part.host_time_s for part in samples]
    assert arrivals == sorted(arrivals)
    assert daq.waiting() >= 0


def test_it_starts_again_at_0_after_safe_and_after_being_opened_again(daq: Daq) -> None:
    for again in (daq.safe, daq.open, daq.close):
        daq.open()
        daq.start()
        assert daq.read(20).time_s[0] == 0.0
        again()


def test_safe_and_close_work_from_any_state_twice_in_a_row(daq: Daq) -> None:
    for prepare in (lambda: None, daq.open, daq.start, lambda: daq.read(10)):
        prepare()
        daq.safe()
        daq.safe()
        if prepare == daq.start:
            daq.start()
    daq.close()
    daq.close()
    daq.safe()


def test_two_clocks_are_related_on_emulated_hardware_as_they_truly_are() -> None:
    with closing(Child("plant", seed=1)) as plant_process:
        device = Child("ni_device", **plant_process.said)
        with closing(device), closing(NiDaq.from_url(f"grpc://{device.said['grpc']}/Dev1")) as daq:
            plant = PlantClient(plant_process.said)
            daq.open()
            daq.start()
            relation, error_ms = ClockRelation(), []
            for _ in range(40):
                samples = daq.read(50)
                relation.add(float(samples.time_s[-1]), samples.host_time_s)
                found = float(relation.to_daq(np.array([samples.host_time_s]))[0])
                error_ms.append(1e3 * (found - plant.daq_time_s(samples.host_time_s)))
            # The clocks differ by thousands of seconds. A sample is in hand after 1.5 ms at least, never before.
            assert -30.0 < error_ms[-1] < -1.0
            assert relation.offset_s > 0.0


def test_a_daq_that_is_gone_before_the_next_motion_is_told_as_a_part_of_the_rig() -> None:
    table = TwinTable(Plant(1))
    with bench() as ni, closing(ni.daq()) as made:
        rig = Rig("twin:", table, made)
        rig.open()
        rig.daq.start()
        ni.device.unplug()
        with pytest.raises(DeviceError, match=r"daq\.unplugged"):
            list(rig.waiting())
        assert {part["part"]: part["code"] for part in rig.status()}["daq"] == "daq.unplugged"
