"""The simulated bench: servos, converter and clocks behave as HARDWARE says; turn the table and the voltage moves."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib_core.gyro_models import PRESETS
from calib_core.model import Model, Noise
from calib_core.twin import HOST_EPOCH_S, Plant, board_truth
from calib_core.twin_daq import DaqSpec
from calib_core.twin_servo import RX28, SPEED_DPS, STEP_DEG, Servo, ServoSpec, to_code, to_deg

QUIET = {"x": Model(1.25, 0.006), "z": Model(1.26, 0.0059)}
NOMINAL = DaqSpec()
EXACT = replace(RX28, stop_short_deg=0.0, stop_scatter_deg=0.0)


def servo(spec: ServoSpec = EXACT) -> Servo:
    return Servo(spec, np.random.default_rng(1))


def still(
    models: dict[str, Model] = QUIET, daq: DaqSpec = NOMINAL, tilt: bool = True, covariates: bool = False
) -> Plant:
    level = {"x": 0.0, "z": 0.0}
    servos = {"x": EXACT, "z": EXACT}
    plant = Plant(1, models, servos=servos, daq=daq, start_deg=level, tilt=tilt, covariates=covariates)
    plant.daq.start(0.0)
    return plant


def test_a_move_runs_at_the_registers_speed_and_lags_by_its_pd_loop() -> None:
    shaft = servo()
    shaft.command([(0.0, 90.0, 50.0)])
    angle, rate = shaft.motion(np.array([0.0, 1.0, 1.001, 10.0]))
    assert rate[0] == 0.0
    assert rate[1] == pytest.approx(75 * SPEED_DPS)
    assert angle[1] == pytest.approx(75 * SPEED_DPS * (1.0 - RX28.lag_s), abs=1e-6)
    assert angle[3] == pytest.approx(float(to_deg(to_code(90.0))))
    assert rate[3] == pytest.approx(0.0, abs=1e-12)


def test_the_slowest_speed_is_one_register_step_because_zero_would_be_the_highest() -> None:
    shaft = servo()
    shaft.command([(0.0, 90.0, 0.01)])
    assert shaft.motion(np.array([1.0]))[1][0] == pytest.approx(SPEED_DPS)


def test_no_command_is_faster_than_the_supply_allows() -> None:
    shaft = servo()
    shaft.command([(0.0, 149.0, 999.0)])
    assert shaft.motion(np.linspace(0.0, 2.0, 500))[1].max() == pytest.approx(27.0 * 12.1, rel=1e-3)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.01, 0.8), st.floats(-149.0, 149.0), st.floats(0.0, 400.0)), min_size=1, max_size=8)
)
def test_rate_is_the_derivative_of_angle_and_neither_jumps(commands: list[tuple[float, float, float]]) -> None:
    shaft = servo(RX28)
    now = 0.0
    for wait_s, goal_deg, rate_dps in commands:
        now += wait_s
        shaft.command([(now, goal_deg, rate_dps)])
    time_s = np.arange(0.0, now + 2.0, 1e-3)
    angle, rate = shaft.motion(time_s)
    middle = shaft.motion(time_s[:-1] + 5e-4)[1]
    np.testing.assert_allclose(np.diff(angle), (rate[:-1] + 4 * middle + rate[1:]) / 6e3, atol=1e-4)  # Simpson's rule
    assert np.abs(np.diff(rate)).max() < 2 * 27.0 * 12.1 * (2.0 / RX28.lag_s) / np.e * 1e-3  # a full reversal
    assert np.abs(angle).max() <= 150.5


def test_letting_go_stops_the_shaft_from_any_motion_and_can_be_repeated() -> None:
    shaft = servo()
    shaft.command([(0.0, 140.0, 300.0)])
    before = shaft.motion(np.array([0.2]))[0][0]
    shaft.stop(0.2)
    shaft.stop(0.2)
    angle, rate = shaft.motion(np.array([0.2, 0.5, 5.0]))
    assert not shaft.torque_on
    assert angle[0] == pytest.approx(before)
    assert abs(rate[1]) < 0.01
    assert angle[2] - before < 8.0


def test_rest_is_off_its_goal_by_friction_within_one_code() -> None:
    shaft = servo(RX28)
    ends = []
    for i in range(40):
        shaft.command([(4.0 * i, 30.0 * (1 if i % 2 else -1), 100.0)])
        ends.append(shaft.motion(np.array([4.0 * i + 3.9]))[0][0])
    error = np.array(ends) - to_deg(to_code(np.array(ends)))
    assert 0.04 < np.abs(error).mean() < 0.12
    assert np.abs(error).max() < STEP_DEG / 2
    assert len({round(e, 6) for e in error}) > 30


def test_voltages_are_codes_of_the_converter_and_follow_the_model() -> None:
    plant = still()
    plant.servos["x"].command([(0.0, 100.0, 60.0)])
    samples = plant.advance(1500)
    codes = samples.volts / (5.0 / 4096.0)
    np.testing.assert_allclose(codes, np.rint(codes), atol=1e-9)
    rate = plant.servos["x"].motion(np.array([1.0]))[1][0]
    assert samples.volts[1000, 0] == pytest.approx(1.25 + 0.006 * rate, abs=0.00062)
    assert samples.volts[:, 1] == pytest.approx(1.26, abs=0.00062)


def test_converter_ends_at_its_limits() -> None:
    volts = Plant(1).daq.convert(np.array([3.0, -3.0, 1.0]))
    assert volts == pytest.approx([2.5 - 5 / 4096, -2.5, 1.0], abs=7e-4)


def test_turning_one_axis_moves_only_its_own_output() -> None:
    for axis, other in (("x", "z"), ("z", "x")):
        plant = still()
        plant.servos[axis].command([(0.0, 50.0, 50.0)])
        volts = dict(zip(("x", "z"), plant.advance(900).volts.T, strict=True))
        assert np.ptp(volts[axis]) > 0.25
        assert np.ptp(volts[other]) == 0.0


@pytest.mark.parametrize(("tilt", "factor"), [(True, 0.5), (False, 1.0)])
def test_a_turn_about_z_is_seen_through_the_cosine_of_the_tilt(tilt: bool, factor: float) -> None:
    plant = still(tilt=tilt)
    plant.servos["x"].command([(0.0, 60.0, 200.0)])
    plant.advance(1500)
    plant.servos["z"].command([(1.5, 100.0, 50.0)])
    z = plant.advance(1500).volts[1000, 1]
    rate = plant.servos["z"].motion(np.array([2.5]))[1][0]
    assert (z - 1.26) / (0.0059 * rate) == pytest.approx(factor, abs=0.006)


def test_the_second_channel_is_converted_a_fixed_time_after_the_first() -> None:
    plant = still(daq=DaqSpec(channel_delay_s=0.004), tilt=False)
    for axis in "xz":
        plant.servos[axis].command([(0.05, 60.0, 100.0)])
    volts = plant.advance(400).volts
    x, z = (volts[:, 0] - 1.25) / 0.006, (volts[:, 1] - 1.26) / 0.0059
    assert np.abs(z[:-4] - x[4:]).max() < 0.5
    assert np.abs(z - x).max() > 5.0


def test_noise_has_the_density_of_the_model_after_the_mean_of_ten() -> None:
    plant = still({axis: Model(1.25, 0.006, noise=Noise(white=1.2e-3)) for axis in "xz"})
    rows = plant.advance(60_000).volts.reshape(-1, 10, 2).mean(axis=1)
    assert rows.std(axis=0) == pytest.approx(1.2e-3, rel=0.05)


def test_blocks_of_any_length_give_the_same_voltages() -> None:
    def volts(lengths: list[int]) -> np.ndarray:
        plant = Plant(4)
        plant.daq.start(0.0)
        plant.servos["x"].command([(0.1, 40.0, 80.0)])
        return np.concatenate([plant.advance(n).volts for n in lengths])

    np.testing.assert_array_equal(volts([2000]), volts([10, 490, 1, 1499]))


def test_a_seed_is_a_bench_and_a_board_id_is_a_gyro() -> None:
    assert board_truth(1) == board_truth(1)
    assert board_truth(1) != board_truth(2)
    assert board_truth(1, "A") != board_truth(1, "B")
    many = [model for seed in range(200) for model in board_truth(seed).values()]
    assert 1.23 <= min(m.bias for m in many) < max(m.bias for m in many) <= 1.28
    assert 5.7e-3 <= min(m.scale_factor for m in many) < max(m.scale_factor for m in many) <= 6.1e-3


def test_the_gyro_on_the_table_is_of_the_model_asked_for() -> None:
    plain, fourfold = board_truth(1), board_truth(1, gyro_model=PRESETS["LPY503AL-4XOUT"])
    assert fourfold["x"].scale_factor == pytest.approx(333 / 83 * plain["x"].scale_factor)
    assert fourfold["x"].bias == plain["x"].bias


def test_encoder_readings_are_codes_at_99_hz_with_their_own_times() -> None:
    plant = still()
    plant.servos["x"].command([(0.0, 100.0, 20.0)])
    read: dict[str, list[np.ndarray]] = {"x": [], "z": []}
    for n in [50] * 80:
        plant.advance(n)
        for axis, arrays in plant.encoders().items():
            read[axis].append(np.array(arrays))
    x, z = (np.concatenate(read[axis], axis=1) for axis in "xz")
    assert len(x[0]) == pytest.approx(4.0 * 99, abs=3)
    assert (np.diff(x[0]) > 0.009).all()
    assert len(set(np.diff(x[0]).round(7))) > 100
    assert (z[0] - x[0]) == pytest.approx(0.002)
    np.testing.assert_allclose(x[1] / STEP_DEG, np.rint(x[1] / STEP_DEG), atol=1e-9)
    # The code is the nearest to where the shaft was in the middle of the transaction, 0.2 ms of latch time aside.
    angle = plant.servos["x"].motion(x[0] - HOST_EPOCH_S)[0]
    assert np.abs(x[1] - angle).max() < STEP_DEG / 2 + 20.0 * 0.0006
    assert x[0][-1] <= plant.host_time_s


def test_the_daq_counts_its_own_seconds() -> None:
    plant = still(daq=DaqSpec(clock_error=5e-5))
    last = plant.advance(100_000)
    assert last.time_s[-1] == pytest.approx(99.999)
    assert plant.now_s == pytest.approx(99.999 * (1 + 5e-5))
    assert last.host_time_s > plant.host_time_s + 0.0015


def test_covariates_are_two_more_channels() -> None:
    samples = still(covariates=True).advance(100)
    assert samples.volts.shape == (100, 4)
    assert samples.volts[:, 2].mean() * 100 == pytest.approx(25, abs=1)
    assert samples.volts[:, 3].mean() * 2 == pytest.approx(3, abs=0.01)
