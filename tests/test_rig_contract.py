"""What every rig must do, whatever is behind it; and how the two clocks are put together."""

import io
import math
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np
import pytest

from calib_core.integral_fit import fit
from calib_core.problem import Problem
from calib_core.recording import read as parse
from calib_core.recording import write_csv
from calib_core.sequence import Move, Wave, make_plan
from calib_core.twin import HOST_EPOCH_S, Plant, board_truth
from server.devices import DeviceError, open_rig
from server.devices.clock import ClockRelation
from server.devices.protocols import Readings, Samples
from server.devices.rig import Rig
from server.devices.twin_rig import TwinDaq, TwinTable
from server.engine import record

NO_TERMINALS = pytest.mark.skipif(sys.platform == "win32", reason="emulated: needs pseudo-terminals")
RIGS = ["twin:?seed=3", "twin:?seed=3&covariates=1", pytest.param("emulated:?seed=3", marks=NO_TERMINALS)]


@pytest.fixture(params=RIGS)
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    rig = open_rig(request.param)
    yield rig
    rig.close()


class Spy:
    """Stands before a device and notes what it is asked."""

    def __init__(self, device: object) -> None:
        self.device, self.asked = device, []

    def __getattr__(self, name: str) -> object:
        value = getattr(self.device, name)
        if callable(value):
            self.asked.append(name)
        return value


def twin(seed: int = 1) -> tuple[Rig, TwinTable, TwinDaq, Plant]:
    table = TwinTable(Plant(seed))
    daq = TwinDaq(table)
    return Rig(f"twin:?seed={seed}", table, daq, simulated=True), table, daq, table.plant


def read(rig: Rig, blocks: int) -> None:
    for _ in range(blocks):
        rig.read(0.05)


def joined(blocks: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def test_constructors_send_nothing_and_safe_comes_before_anything() -> None:
    twin_table = TwinTable(Plant(1))
    table, daq = Spy(twin_table), Spy(TwinDaq(twin_table))
    rig = Rig("twin:", table, daq, simulated=True)
    assert [part["ok"] for part in rig.status()] == [None] * 4
    assert (rig.columns[0], rig.header["rig"]) == ("time_s", "twin:")
    assert table.asked == daq.asked == []
    rig.safe()
    assert table.asked == daq.asked == ["safe"]


def test_safe_works_from_every_state_twice_in_a_row(rig: Rig) -> None:
    def let_go() -> None:
        rig.safe()
        rig.safe()
        assert not any(servo.torque_on for servo in rig.table.telemetry().values())

    let_go()
    rig.open()
    let_go()
    rig.begin()
    let_go()
    with pytest.raises(DeviceError, match=r"rig\.stopped"):  # a stop holds until somebody begins anew
        rig.start([Move("x", 20.0, 60.0)])
    rig.begin()
    rig.start([Wave("x", (30.0,), (0.25,), 10.0), Move("z", 100.0, 60.0)])
    rig.read(1.0)
    assert all(servo.torque_on for servo in rig.table.telemetry().values())
    let_go()
    rig.begin()
    still = rig.read(0.5).columns
    assert np.nanmax(still["x_position_deg"]) == np.nanmin(still["x_position_deg"])
    rig.close()
    let_go()


def test_an_emergency_stop_from_another_thread_disturbs_nothing() -> None:
    rig = open_rig("twin:?seed=3")
    rig.begin()
    rig.start([Wave("x", (30.0,), (0.25,), 20.0)])
    with ThreadPoolExecutor(1) as pool:
        reading = [pool.submit(rig.read, 0.05) for _ in range(200)]
        for _ in range(50):
            rig.safe()
        assert sum(len(job.result().columns["time_s"]) for job in reading) == 1000
    assert not any(servo.torque_on for servo in rig.table.telemetry().values())


def test_an_emergency_stop_ends_a_read_that_is_going_on_and_lets_go_at_once() -> None:
    with closing(open_rig("emulated:")) as rig, ThreadPoolExecutor(1) as pool:
        rig.begin()
        rig.start([Wave("x", (30.0,), (0.25,), 20.0), Move("z", 60.0, 20.0)])
        reading = pool.submit(rig.read, 5.0)
        time.sleep(0.3)  # the emulated bench has its own clock
        began = time.perf_counter()
        rig.safe()
        assert time.perf_counter() - began < 0.3
        assert not any(servo.torque_on for servo in rig.table.telemetry().values())
        with pytest.raises(DeviceError, match=r"rig\.stopped"):
            reading.result(2.0)


def test_a_wave_waits_for_its_start_and_swings_about_zero() -> None:
    rig, _, _, plant = twin()
    rig.begin()
    rig.start([Move("x", 0.0, 50.0)])
    rig.read(1.0)
    began_s = plant.now_s
    rig.start([Wave("x", (20.0, 2.0), (0.5, 2.0171), 4.0, start_s=1.0)])
    read(rig, 110)
    t = np.arange(0.0, 5.0, 0.01)
    angle = plant.servos["x"].motion(began_s + t)[0]
    assert np.abs(angle[t < 1.0]).max() < 0.3
    meant = 20.0 * np.sin(np.pi * (t - 1.0)) + 2.0 * np.sin(2 * np.pi * 2.0171 * (t - 1.0))
    assert np.abs(angle - meant)[t > 1.0].max() < 4.0
    assert np.ptp(angle) > 36.0


def test_rows_are_means_of_ten_samples_stamped_at_their_centre(rig: Rig) -> None:
    rig.begin()
    block = rig.read(0.5)
    assert tuple(block.columns) == rig.columns
    assert len(block.columns["time_s"]) == 50
    assert len(block.fast["time_s"]) == 500
    np.testing.assert_allclose(np.diff(block.columns["time_s"]), 0.01, atol=1e-9)
    np.testing.assert_allclose(np.diff(block.fast["time_s"]), 0.001, atol=1e-9)
    for name in ("time_s", "x_gyro_v", "z_gyro_v"):
        np.testing.assert_allclose(block.columns[name], block.fast[name].reshape(-1, 10).mean(axis=1), atol=1e-6)


def test_blocks_follow_each_other_without_a_gap(rig: Rig) -> None:
    rig.begin()
    columns = joined([dict(rig.read(seconds).columns) for seconds in (0.05, 0.01, 2.0, 0.33)])
    np.testing.assert_allclose(np.diff(columns["time_s"]), 0.01, atol=1e-9)


@pytest.mark.parametrize("block_s", [0.05, 1.0])
def test_each_encoder_reading_is_in_one_row_near_its_own_time(block_s: float) -> None:
    rig, _, _, _ = twin()
    rig.begin()
    rig.start([Wave("x", (30.0,), (0.2513,), 20.0)])
    columns = joined([dict(rig.read(block_s).columns) for _ in range(round(20 / block_s))])
    for axis in "xz":
        there = ~np.isnan(columns[f"{axis}_position_deg"])
        np.testing.assert_array_equal(there, ~np.isnan(columns[f"{axis}_position_time_s"]))
        own = columns[f"{axis}_position_time_s"][there]
        assert there.mean() == pytest.approx(0.99, abs=0.005)
        assert (np.diff(own) > 0.005).all()
        assert np.abs(own - columns["time_s"][there]).max() < 0.03
        codes = columns[f"{axis}_position_deg"][there] / (300 / 1023)
        np.testing.assert_allclose(codes, np.rint(codes), atol=2e-4)


def test_encoder_times_are_true_to_the_least_transfer_time_and_stay_so() -> None:
    rig, _, _, plant = twin(5)
    rig.begin()
    error_ms = []
    read(rig, 200)
    for _ in range(400):
        columns = rig.read(0.5).columns
        true_s = plant.daq.start_s + columns["time_s"][-1] * (1 + plant.daq.spec.clock_error)
        mapped = rig.clock.to_daq(np.array([HOST_EPOCH_S + true_s]))[0]
        error_ms.append(1e3 * (mapped - columns["time_s"][-1]))
    assert abs(plant.daq.spec.clock_error * 200) > 0.001  # uncorrected, the clocks part by more than this
    assert np.mean(error_ms) == pytest.approx(-1e3 * plant.daq.spec.transfer_s, abs=0.1)
    assert np.ptp(error_ms) < 0.6


@pytest.mark.parametrize("axis", ["x", "z"])
def test_the_integral_fit_finds_the_twins_truth_with_its_one_way_delay_taken_out(axis: str) -> None:
    plan = make_plan("standard", seed=1, states=[f"estimate_{axis}"])
    recording = record(plan, open_rig("twin:?seed=11"), board="B")
    found, truth = fit(recording, axis), board_truth(11, "B")[axis]
    assert found.values["scale_factor_V_per_dps"] == pytest.approx(truth.scale_factor, rel=3e-4)
    assert found.values["bias_V"] == pytest.approx(truth.bias, abs=1e-4)
    # 1.5 ms of USB transfer less 0.2 ms that the servo latches early: the clocks cannot tell, but the twin knows.
    assert found.delay_s == pytest.approx(0.0, abs=3e-4)


@pytest.mark.parametrize("skew", [-1e-4, 0.0, 8e-5])
def test_clock_relation_is_not_drawn_up_by_late_transfers(skew: float) -> None:
    rng = np.random.default_rng(1)
    relation = ClockRelation()
    at = np.arange(0.05, 200.0, 0.05)
    late = 0.001 + rng.exponential(0.002, len(at)) + 0.05 * (rng.random(len(at)) < 0.05)
    host = 70_000.0 + at * (1.0 + skew)
    for daq_s, host_s in zip(at, host + late, strict=True):
        relation.add(daq_s, host_s)
    assert relation.to_daq(host[-1:])[0] - at[-1] == pytest.approx(-0.001, abs=1.5e-4)


def test_a_whole_recording_takes_the_contracts_form_and_comes_back_the_same() -> None:
    rig = open_rig("twin:?seed=3&covariates=1")
    recording = record(make_plan("standard", seed=1, states=["estimate_z"]), rig, board="B-7")
    assert recording.axes == ("x", "z")
    assert recording.gyro("z").delay_s == 1e-4
    assert recording.header["gyro_average_s"] == "0.01"
    assert recording.header["board"] == "B-7"
    assert [run.name for run in recording.runs()] == ["move", "hold", "estimate_z", "step_z", "move"]
    assert 24 < np.nanmean(recording.columns["temperature_c"]) < 27
    assert 2.9 < np.nanmean(recording.columns["supply_v"]) < 3.1
    file = io.BytesIO()
    write_csv(recording, file)
    again = parse(file.getvalue())
    assert again.digest() == recording.digest()
    assert again.header == recording.header


def test_status_says_of_each_part_what_is_known() -> None:
    rig, table, daq, _ = twin()
    table.silent.add("z")
    daq.unplugged = True
    with pytest.raises(DeviceError, match=r"rig\.servo_silent"):
        rig.open()
    parts = {part["part"]: part for part in rig.status()}
    assert [part["ok"] for part in parts.values()] == [None, False, False, None]
    assert parts["servo z"]["code"] == "rig.servo_silent"
    assert parts["daq"]["code"] == "rig.daq_silent"
    table.silent.clear()
    daq.unplugged = False
    rig.begin()
    assert [part["ok"] for part in rig.status()] == [True] * 4
    assert rig.status()[0]["values"]["highest_dps"] == pytest.approx(327, abs=1)


def test_a_jammed_shaft_is_found_while_it_should_turn() -> None:
    rig, _, _, plant = twin()
    rig.begin()
    rig.start([Move("x", 60.0, 50.0)])
    rig.read(0.5)
    plant.servos["x"].stop(plant.now_s, jam=True)
    with pytest.raises(DeviceError) as caught:
        read(rig, 20)
    assert caught.value.code == "rig.stalled"
    assert caught.value.values["axis"] == "x"
    assert rig.status()[0]["ok"] is False


def test_a_servo_that_falls_silent_is_found_within_half_a_second() -> None:
    rig, table, _, _ = twin()
    rig.begin()
    table.silent.add("x")
    with pytest.raises(DeviceError, match=r"rig\.servo_silent"):
        read(rig, 12)


def test_a_gyro_that_does_not_feel_the_turn_is_found_at_the_first_one() -> None:
    rig, _, _, plant = twin()
    plant.mount({axis: type(model)(1.4, 0.0, noise=model.noise) for axis, model in plant.models.items()})
    rig.begin()
    rig.start([Move("z", 60.0, 50.0)])
    with pytest.raises(DeviceError) as caught:
        rig.read(1.5)
    assert (caught.value.code, caught.value.values["axis"]) == ("rig.gyro_still", "z")


def test_a_rig_works_again_once_its_fault_is_mended() -> None:
    rig, _, daq, _ = twin()
    rig.begin()
    daq.unplugged = True
    with pytest.raises(DeviceError, match=r"rig\.daq_silent"):
        rig.read(0.1)
    daq.unplugged = False
    rig.begin()
    assert len(rig.read(0.1).columns["time_s"]) == 10
    assert all(part["ok"] for part in rig.status())


@pytest.mark.parametrize("readings_per_s", [60, 100, 111, 180])
def test_each_row_has_a_reading_where_there_are_enough(readings_per_s: int) -> None:
    rig, table, _, _ = twin()
    read = table.read

    def more() -> dict[str, Readings]:
        """The same motion, read at another rate."""
        taken = {}
        for axis, seen in read().items():
            times = (
                np.arange(np.ceil(seen.time_s[0] * readings_per_s), seen.time_s[-1] * readings_per_s) / readings_per_s
            )
            taken[axis] = Readings(times, np.interp(times, seen.time_s, seen.angle_deg))
        return taken

    rig.begin()
    table.read = more  # type: ignore[method-assign]
    seen = np.concatenate([rig.read(0.2).columns["x_position_time_s"] for _ in range(50)])
    assert np.isfinite(seen).mean() == pytest.approx(min(1.0, readings_per_s / 100.0), abs=0.06)
    assert (np.diff(seen[np.isfinite(seen)]) > 0).all()


def test_what_waited_while_nobody_read_comes_before_the_next_motion() -> None:
    class Slow(TwinDaq):
        def waiting(self) -> int:
            return 777

    table = TwinTable(Plant(1))
    rig = Rig("twin:", table, Slow(table), simulated=True)
    rig.begin()
    (block,) = rig.waiting()
    assert len(block.columns["time_s"]) == 77
    assert list(twin()[0].waiting()) == []


def test_safe_tells_both_devices_though_the_first_fails() -> None:
    class Deaf(TwinTable):
        def safe(self) -> None:
            raise DeviceError("rig.servo_silent", axis="x", part="RX-28")

    class Noting(TwinDaq):
        told = False

        def safe(self) -> None:
            self.told = True

    table = Deaf(Plant(1))
    daq = Noting(table)
    rig = Rig("twin:", table, daq, simulated=True)
    with pytest.raises(DeviceError):
        rig.safe()
    assert daq.told


@pytest.mark.parametrize(
    ("url", "code"),
    [
        ("", "rig.address"),
        ("twin", "rig.address"),
        ("twin:elsewhere", "rig.address"),
        ("twin:?seed=-1", "rig.option"),
        ("twin:?seed=", "rig.option"),
        ("serial:/dev/ttyUSB0", "rig.address"),
        ("dynamixel:?ids=1,2", "rig.address"),
        ("dynamixel:/dev/ttyUSB0?ids=1,2&baud=1000000", "rig.no_daq"),
        ("dynamixel:COM3?ids=1,1+nidaq:Dev1", "rig.ids"),
        ("dynamixel:COM3?ids=1+nidaq:Dev1", "rig.ids"),
        ("dynamixel:COM3?ids=1,254+nidaq:Dev1", "rig.option"),
        ("dynamixel:COM3?speed=9+nidaq:Dev1", "rig.unknown_option"),
        ("dynamixel:COM3?baud=1&baud=2+nidaq:Dev1", "rig.unknown_option"),
        ("dynamixel:COM3+nidaq:", "daq.address"),
        ("emulated:here", "rig.address"),
        ("emulated:?seed=one", "rig.option"),
        ("twin:?speed=3", "rig.unknown_option"),
    ],
)
def test_an_address_that_leads_nowhere_is_refused(url: str, code: str) -> None:
    with pytest.raises(Problem) as caught:
        open_rig(url)
    assert caught.value.code == code


def test_an_absent_port_is_found_when_the_rig_is_opened() -> None:
    with closing(open_rig("dynamixel:/dev/no-such-port?ids=1,2+nidaq:Dev1?channels=ai0,ai1")) as rig:
        rig.safe()
        with pytest.raises(DeviceError) as caught:
            rig.open()
    assert (caught.value.code, caught.value.values["port"]) == ("rig.port_absent", "/dev/no-such-port")


def test_axes_carry_what_the_supply_allows(rig: Rig) -> None:
    rig.open()
    x, z = rig.axes["x"], rig.axes["z"]
    assert (x.part, z.part) == ("RX-28", "RX-64")
    assert (x.max_rate_dps, z.max_rate_dps) == pytest.approx((326.7, 254.1))
    assert x.step_deg == pytest.approx(0.2933, abs=1e-4)
    assert not math.isnan(x.supply_V)


def test_samples_carry_times_of_two_clocks() -> None:
    _, _, daq, plant = twin()
    daq.open()
    daq.start()
    samples = daq.read(100)
    assert isinstance(samples, Samples)
    assert samples.time_s[0] == 0.0
    assert samples.host_time_s > plant.host_time_s
