"""The DAQ driver on the emulated NI gRPC server: exact samples, and a sentence for whatever fails."""

import gc
import subprocess
import sys
import threading
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from ni_bench import Bench, bench, refused
from shared import ROOT

from calib_core.problem import Problem
from server.devices import doctor_daq
from server.devices.ni_daq import NiDaq
from server.texts import render

DIFFERENTIAL = 10106


@pytest.fixture
def ni() -> Iterator[Bench]:
    with bench() as made:
        yield made


# --- addresses -------------------------------------------------------------------------------------------------
def test_an_address_names_device_server_channels_and_their_delay() -> None:
    here = NiDaq.from_url("Dev1")
    assert (here.device, here.inputs, here.server, here.channels) == (
        "Dev1", ("ai0", "ai1"), "", ("x_gyro_v", "z_gyro_v"),
    )  # fmt: skip
    there = NiDaq.from_url("grpc://lab-pc.local:31763/cDAQ1Mod1?channels=ai3,ai1,ai0,ai2&channel_delay_us=12.5")
    assert (there.device, there.server) == ("cDAQ1Mod1", "lab-pc.local:31763")
    assert there.inputs == ("ai3", "ai1", "ai0", "ai2")
    assert there.channels == ("x_gyro_v", "z_gyro_v", "temperature_c", "supply_v")
    assert there.channel_delay_s == pytest.approx(12.5e-6)
    assert NiDaq.from_url("grpc://[::1]:31763/Dev1").server == "[::1]:31763"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "daq.address"),
        ("Dev 1", "daq.address"),
        ("Dev1/ai0", "daq.address"),
        ("Dév1", "daq.address"),
        ("http://host:1/Dev1", "daq.address"),
        ("grpc://host/Dev1", "daq.address"),
        ("grpc://host:0/Dev1", "daq.address"),
        ("grpc://host:65536/Dev1", "daq.address"),
        ("grpc://host:31763/", "daq.address"),
        ("grpc://:31763/Dev1", "daq.address"),
        ("Dev1?channels=", "daq.channels"),
        ("Dev1?channels=ai0", "daq.channels"),
        ("Dev1?channels=ai0,ai0", "daq.channels"),
        ("Dev1?channels=ai0,ai1,ai2,ai3,ai4", "daq.channels"),
        ("Dev1?channels=0,1", "daq.channels"),
        ("Dev1?channels=ai0, ai1", "daq.channels"),
        ("Dev1?channels=ai0,ai1&channels=ai0,ai1", "daq.option"),
        ("Dev1?rate=5", "daq.option"),
        ("Dev1?channel_delay_us=-1", "daq.delay"),
        ("Dev1?channel_delay_us=nan", "daq.delay"),
    ],
)
def test_a_bad_address_is_refused_in_a_sentence(text: str, code: str) -> None:
    with pytest.raises(Problem) as caught:
        NiDaq.from_url(text)
    assert caught.value.code == code
    for lang in ("en", "th"):
        said = render(code, caught.value.values, lang)
        assert "{" not in said
        assert not said.startswith(code)


# --- samples ---------------------------------------------------------------------------------------------------
def test_every_volt_is_in_its_place_and_none_is_lost(ni: Bench) -> None:
    daq = ni.running("Dev1?channels=ai2,ai0,ai3")
    samples = [daq.read(n) for n in (50, 1, 120, 500, 7)]
    volts = np.concatenate([part.volts for part in samples])
    time_s = np.concatenate([part.time_s for part in samples])
    k = np.arange(678)
    np.testing.assert_allclose(time_s, k / 1000.0, atol=1e-12)
    np.testing.assert_allclose(volts, 1e-6 * k[:, None] + [2.0, 0.0, 3.0], atol=1e-9)
    assert all(part.volts.shape == (len(part.time_s), 3) for part in samples)
    assert samples[0].host_time_s < samples[-1].host_time_s


def test_inputs_are_differential_at_2_5_V(ni: Bench) -> None:
    ni.running("Dev1?channels=ai1,ai3")
    (task,) = ni.device.shown().values()
    assert task["inputs"] == [(1, DIFFERENTIAL), (3, DIFFERENTIAL)]


def test_the_clock_is_0_at_every_start(ni: Bench) -> None:
    daq = ni.running()
    daq.read(30)
    daq.safe()
    daq.start()
    again = daq.read(10)
    assert again.time_s[0] == 0.0
    assert again.volts[0, 0] == 0.0


def test_waiting_samples_are_counted(ni: Bench) -> None:
    daq = ni.running()
    ni.source.ahead = 777
    assert daq.waiting() == 777


def test_the_part_is_the_products_name(ni: Bench) -> None:
    daq = ni.daq()
    assert daq.part == "NI Dev1"
    daq.open()
    assert daq.part == "NI USB-6008"


def test_a_server_that_knows_less_still_serves(ni: Bench) -> None:
    ni.device.fail("SetReadAttributeInt32", -200452)
    ni.device.product = ""
    assert len(ni.running().read(50).time_s) == 50


# --- safe, close, again ----------------------------------------------------------------------------------------
def test_safe_works_from_every_state_twice_in_a_row(ni: Bench) -> None:
    daq = ni.daq()
    for prepare in (lambda: None, daq.open, daq.start, lambda: (daq.start(), daq.read(10)), daq.close):
        prepare()
        daq.safe()
        daq.safe()
    assert not any(task["running"] for task in ni.device.shown().values())


def test_safe_ends_a_read_that_waits(ni: Bench) -> None:
    daq = ni.running()
    ni.source.ahead = 100_000 // 100  # plenty, so the read takes piece after piece
    reading = threading.Event()
    ended: list[str] = []
    ni.source.latency_s = lambda: reading.set() or 0.0

    def work() -> None:
        while True:
            try:
                daq.read(1000)
            except Problem as problem:
                ended.append(problem.code)
                return

    thread = threading.Thread(target=work)
    thread.start()
    assert reading.wait(5.0)
    daq.safe()
    thread.join(5.0)
    assert ended == ["rig.stopped"]
    assert not any(task["running"] for task in ni.device.shown().values())


def test_close_leaves_no_task_on_the_server(ni: Bench) -> None:
    daq = ni.running()
    assert len(ni.device.shown()) == 1
    daq.close()
    assert ni.device.shown() == {}
    assert refused(lambda: daq.read(10)).code == "daq.not_open"


def test_a_crashed_clients_task_is_cleared_and_its_channels_do_not_come_along(ni: Bench) -> None:
    crashed = ni.running("Dev1?channels=ai0,ai1,ai2")
    crashed._session = None  # gone without a word: the server keeps the task, and the task the device
    daq = ni.running("Dev1?channels=ai1,ai0")
    assert [task["inputs"] for task in ni.device.shown().values()] == [[(1, DIFFERENTIAL), (0, DIFFERENTIAL)]]
    np.testing.assert_allclose(daq.read(2).volts, [[1.0, 0.0], [1.000001, 0.000001]], atol=1e-9)


def test_who_is_cleared_away_gets_an_error_and_never_the_others_samples(ni: Bench) -> None:
    first = ni.running()
    first.read(20)
    second = ni.running()
    assert refused(lambda: first.read(20)).code == "daq.taken"
    assert second.read(20).time_s[0] == 0.0
    third = ni.running()
    assert refused(lambda: second.read(20)).code == "daq.taken"
    assert refused(lambda: first.read(20)).code == "daq.not_open"
    third.read(20)


# --- faults ----------------------------------------------------------------------------------------------------
READ_FAULTS = {
    -200279: "daq.overrun",
    -201003: "daq.unplugged",
    -50405: "daq.unplugged",
    -200088: "daq.taken",
    -200222: "daq.error",
}


@pytest.mark.parametrize(("number", "code"), READ_FAULTS.items())
def test_an_error_of_a_read_ends_it_with_its_sentence_and_no_sample(ni: Bench, number: int, code: str) -> None:
    daq = ni.running()
    daq.read(50)
    ni.device.fail("ReadAnalogF64", number)
    assert refused(lambda: daq.read(50)).code == code
    assert refused(lambda: daq.read(50)).code == "daq.not_open"
    assert refused(daq.start).code == "daq.not_open"
    daq.open()
    daq.start()
    assert daq.read(50).time_s[0] == 0.0


def test_overrun_and_unplugging_are_told_apart_by_what_happened(ni: Bench) -> None:
    daq = ni.running()
    ni.source.ahead = 10_001  # more than the 10 s that the buffer holds
    late = refused(lambda: daq.read(50))
    ni.source.ahead = 100
    daq.open()
    daq.start()
    ni.device.unplug()
    gone = refused(lambda: daq.read(50))
    assert (late.code, gone.code) == ("daq.overrun", "daq.unplugged")
    assert "is well" in render(late.code, late.values)
    assert "cable" in render(gone.code, gone.values)
    assert refused(daq.open).code == "daq.unplugged"
    ni.device.unplug(False)
    daq.open()


def test_a_partial_read_is_no_data(ni: Bench) -> None:
    daq = ni.running()
    ni.source.ahead = 30
    assert refused(lambda: daq.read(50)).code == "daq.late"


def test_a_device_that_is_held_elsewhere_is_said_to_be(ni: Bench) -> None:
    other = ni.device.create("LabVIEW")
    ni.device.start(other)
    fault = refused(ni.daq().open)
    assert fault.code == "daq.reserved"
    assert f"at 127.0.0.1:{ni.port}" in render(fault.code, fault.values)


@pytest.mark.parametrize(("place", "code"), [("Dev2", "daq.no_device"), ("Dev1?channels=ai0,ai7", "daq.no_channel")])
def test_what_the_device_has_not_is_named(ni: Bench, place: str, code: str) -> None:
    fault = refused(ni.daq(place).open)
    assert fault.code == code
    assert ("Dev2" if code == "daq.no_device" else "ai7") in render(code, fault.values)
    assert ni.device.shown() == {}


def test_a_server_that_is_gone_is_told_at_once_and_found_again(ni: Bench) -> None:
    daq = ni.running()
    daq.read(50)
    ni.server.stop(0).wait()
    assert refused(lambda: daq.read(50)).code == "daq.server_gone"
    assert refused(daq.open).code == "daq.server_gone"
    from server.emulators.ni_service import serve

    again, _ = serve(ni.device, f"127.0.0.1:{ni.port}")
    try:
        daq.open()
        daq.start()
        assert len(daq.read(50).time_s) == 50
    finally:
        again.stop(0)


def test_a_server_that_says_nothing_does_not_hold_the_run(ni: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.devices.ni_session.CALL_S", 0.1)
    daq = ni.running()
    ni.device.hang()
    assert refused(lambda: daq.read(50)).code == "daq.server_silent"


def test_a_server_without_the_driver_is_told_from_one_that_is_old(ni: Bench) -> None:
    import grpc
    from nidaqmx.errors import RpcError

    from server.devices.ni_faults import fault

    assert fault(RpcError(grpc.StatusCode.NOT_FOUND, "")).code == "daq.no_driver_there"
    assert fault(RpcError(grpc.StatusCode.UNIMPLEMENTED, "")).code == "daq.server_old"
    assert ni.port


def test_without_nis_driver_the_message_says_what_to_do() -> None:
    fault = refused(NiDaq.from_url("Dev1").open)
    if fault.code == "daq.no_device":
        pytest.skip("NI-DAQmx is installed here")
    assert fault.code == "daq.no_driver"
    assert "NI gRPC Device Server" in render(fault.code, fault.values, "en")
    assert "grpc://" in render(fault.code, fault.values, "th")


def test_every_fault_has_its_sentence_in_both_languages(ni: Bench) -> None:
    from server.devices.ni_faults import BY_CODE, BY_STATUS

    where = ni.daq().where()
    for code in {*BY_CODE.values(), *BY_STATUS.values(), "daq.no_driver", "daq.error", "daq.not_open", "rig.stopped"}:
        for lang in ("en", "th"):
            said = render(code, {**where, "number": -1, "said": "."}, lang)
            assert "{" not in said
            assert not said.startswith(code)


def test_memory_stays_flat_over_a_long_reading(ni: Bench) -> None:
    import tracemalloc

    daq = ni.running()
    held = []
    tracemalloc.start()
    try:
        for _ in range(4):
            for _ in range(50):
                daq.read(100)
            gc.collect()
            held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    # gRPC's own threads let go when they come to it; what is kept of each reading would grow every time.
    assert min(after - before for before, after in pairwise(held)) < 5_000


def test_nis_library_is_not_imported_before_it_is_needed() -> None:
    script = (
        "import sys; from server.devices.ni_daq import NiDaq; daq = NiDaq.from_url('Dev1'); daq.safe(); daq.close();"
        "print(sorted({'nidaqmx', 'grpc'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stdout.strip() == "[]"


# --- doctor ----------------------------------------------------------------------------------------------------
def told(address: str) -> list[tuple[str, bool | None, str]]:
    found = []
    for check in doctor_daq.checks(address):
        said = " ".join(render(code, check.values, "en") for code in (check.code, check.cure) if code)
        assert "{" not in said
        found.append((check.name, check.ok, said))
    return found


def test_doctor_says_which_driver_devices_and_volts_there_are(ni: Bench) -> None:
    driver, samples = told(f"grpc://127.0.0.1:{ni.port}/Dev1?channels=ai0,ai3")
    assert driver[1]
    assert "24.8.0" in driver[2]
    assert "Dev1 (USB-6008)" in driver[2]
    assert samples[1]
    assert "ai3 3.00" in samples[2]
    assert ni.device.shown() == {}


def test_doctor_names_the_devices_there_are_where_the_one_asked_for_is_not(ni: Bench) -> None:
    driver, device = told(f"grpc://127.0.0.1:{ni.port}/Dev3")
    assert driver[1] is True
    assert device[1] is False
    assert "Put one of these names" in device[2]
    assert "Dev1 (USB-6008)" in device[2]


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("grpc://127.0.0.1:1/Dev1", "start it on that computer"),
        ("Dev1", "NI gRPC Device Server"),
        ("?", "not understood"),
    ],
)
def test_doctor_stops_at_the_first_thing_that_is_not_there(address: str, words: str) -> None:
    (only,) = told(address)
    assert only[1] is False
    assert words in only[2]
