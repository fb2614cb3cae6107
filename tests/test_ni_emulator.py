"""The emulated NI gRPC Device Server on the wire: what HARDWARE says the real one answers."""

from collections.abc import Iterator
from typing import Any

import grpc
import numpy as np
import pytest
from ni_bench import Bench, bench
from nidaqmx._stubs import nidaqmx_pb2 as wire
from nidaqmx._stubs.nidaqmx_pb2_grpc import NiDAQmxStub

DIFFERENTIAL, SINGLE_ENDED = 10106, 10083
GROUP_BY_CHANNEL = 0


@pytest.fixture
def ni() -> Iterator[Bench]:
    with bench() as made:
        yield made


@pytest.fixture
def stub(ni: Bench) -> Iterator[Any]:
    with grpc.insecure_channel(f"127.0.0.1:{ni.port}", options=[("grpc.enable_http_proxy", 0)]) as channel:
        yield NiDAQmxStub(channel)


def task(stub: Any, name: str = "t", *, behaviour: int = 0) -> Any:
    return stub.CreateTask(wire.CreateTaskRequest(session_name=name, initialization_behavior=behaviour))


def running(stub: Any, terminals: int = DIFFERENTIAL, volts: float = 2.5) -> Any:
    made = task(stub).task
    for number in (0, 1):
        stub.CreateAIVoltageChan(
            wire.CreateAIVoltageChanRequest(
                task=made,
                physical_channel=f"Dev1/ai{number}",
                terminal_config_raw=terminals,
                min_val=-volts,
                max_val=volts,
            )
        )
    stub.CfgSampClkTiming(wire.CfgSampClkTimingRequest(task=made, rate=1000.0, samps_per_chan=10_000))
    stub.StartTask(wire.StartTaskRequest(task=made))
    return made


def read(stub: Any, made: Any, n: int, timeout: float = 0.0) -> Any:
    return stub.ReadAnalogF64(
        wire.ReadAnalogF64Request(
            task=made, num_samps_per_chan=n, timeout=timeout, fill_mode_raw=GROUP_BY_CHANNEL, array_size_in_samps=2 * n
        )
    )


def test_samples_are_grouped_by_channel(ni: Bench, stub: Any) -> None:
    answer = read(stub, running(stub), 3)
    assert (answer.status, answer.samps_per_chan_read) == (0, 3)
    np.testing.assert_allclose(answer.read_array, [0, 1e-6, 2e-6, 1, 1.000001, 1.000002])
    assert ni.port


def test_an_error_is_status_UNKNOWN_with_its_code_in_the_trailing_metadata(ni: Bench, stub: Any) -> None:
    made = running(stub)
    ni.device.fail("ReadAnalogF64", -200279)
    with pytest.raises(grpc.RpcError) as caught:
        read(stub, made, 10)
    assert caught.value.code() is grpc.StatusCode.UNKNOWN
    assert dict(caught.value.trailing_metadata()) == {"ni-error": "-200279", "ni-samps-per-chan-read": "0"}


def test_running_out_of_time_is_status_OK_with_a_part_of_the_samples(ni: Bench, stub: Any) -> None:
    made = running(stub)
    ni.source.ahead = 4
    answer = read(stub, made, 10)
    assert (answer.status, answer.samps_per_chan_read, len(answer.read_array)) == (-200284, 4, 20)


def test_what_a_real_server_does_not_know_either_is_unimplemented(stub: Any) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        stub.SelfTestDevice(wire.SelfTestDeviceRequest(device_name="Dev1"))
    assert caught.value.code() is grpc.StatusCode.UNIMPLEMENTED


def test_a_task_outlives_its_client_and_is_handed_to_whoever_names_it(stub: Any) -> None:
    assert task(stub).new_session_initialized
    assert not task(stub).new_session_initialized
    assert not task(stub, behaviour=2).new_session_initialized
    for name, behaviour in (("t", 1), ("other", 2)):
        with pytest.raises(grpc.RpcError) as caught:
            task(stub, name, behaviour=behaviour)
        assert caught.value.code() is grpc.StatusCode.FAILED_PRECONDITION


def test_one_device_runs_one_task(ni: Bench, stub: Any) -> None:
    first, second = running(stub), task(stub, "second").task
    with pytest.raises(grpc.RpcError) as caught:
        stub.StartTask(wire.StartTaskRequest(task=second))
    assert ("ni-error", "-50103") in caught.value.trailing_metadata()
    stub.ClearTask(wire.ClearTaskRequest(task=first))
    stub.StartTask(wire.StartTaskRequest(task=second))
    assert list(ni.device.shown()) == ["second"]


def test_single_ended_inputs_step_by_9_77_mV(ni: Bench, stub: Any) -> None:
    answer = read(stub, running(stub, SINGLE_ENDED, 10.0), 50)
    np.testing.assert_allclose(np.array(answer.read_array)[50:], 102 * 20 / 2048)
    assert ni.port


@pytest.mark.parametrize(
    ("channel", "terminals", "volts", "code"),
    [
        ("Dev2/ai0", DIFFERENTIAL, 2.5, -200220),
        ("Dev1/ai8", SINGLE_ENDED, 10.0, -200170),
        ("Dev1/ai4", DIFFERENTIAL, 2.5, -200170),
        ("Dev1/ao0", DIFFERENTIAL, 2.5, -200170),
        ("Dev1/ai0", DIFFERENTIAL, 3.0, -200077),
    ],
)
def test_what_the_device_has_not_is_refused(stub: Any, channel: str, terminals: int, volts: float, code: int) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        stub.CreateAIVoltageChan(
            wire.CreateAIVoltageChanRequest(
                task=task(stub).task,
                physical_channel=channel,
                terminal_config_raw=terminals,
                min_val=-volts,
                max_val=volts,
            )
        )
    assert ("ni-error", str(code)) in caught.value.trailing_metadata()
