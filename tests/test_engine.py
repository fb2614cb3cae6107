"""A run is documents, and however it ends the rig is left safe."""

import itertools
import math
import pickle
import tracemalloc
from collections.abc import Callable
from threading import Event
from time import process_time

import numpy as np
import pytest

from calib_core.problem import Problem
from calib_core.sequence import STATES, Plan, make_plan
from calib_core.twin import Plant
from server.devices import DeviceError, open_rig
from server.devices.rig import Rig
from server.devices.twin_rig import TwinDaq, TwinTable
from server.engine import Descriptor, Document, Pacer, Rows, Start, StateBegin, StateEnd, Stop, record, run


class Watched(Rig):
    """A twin that counts how often it was made safe."""

    def __init__(self, seed: int = 1) -> None:
        self.plant = Plant(seed)
        self.twin_table = TwinTable(self.plant)
        self.twin_daq = TwinDaq(self.twin_table)
        super().__init__("twin:", self.twin_table, self.twin_daq, simulated=True)
        self.made_safe = 0

    def safe(self) -> None:
        self.made_safe += 1
        super().safe()

    @property
    def at_rest(self) -> bool:
        self.plant.advance(2000)
        still = all(
            abs(servo.motion(np.array([self.plant.now_s]))[1][0]) < 1e-6 for servo in self.plant.servos.values()
        )
        return still and not any(servo.torque_on for servo in self.plant.servos.values())


def short(*states: str) -> Plan:
    return make_plan("standard", seed=1, states=states or STATES, readings=3)


def until(documents: list[Document], source: object, condition: Callable[[Document], bool]) -> None:
    for document in source:  # type: ignore[attr-defined]
        documents.append(document)
        if condition(document):
            return


def moving_in(state: str) -> Callable[[Document], bool]:
    """The first block of a test's or a sine's own motion in this state."""
    kind, axis = state.split("_")
    return lambda d: isinstance(d, Rows) and d.state == state and d.segment.startswith(f"{kind}_{axis}")


def test_what_a_busy_computer_reads_late_belongs_to_the_stroke_that_it_is_the_end_of() -> None:
    rig = Watched()
    rig.twin_daq.waiting = lambda: 300  # type: ignore[method-assign]
    blocks = [d for d in run(short("rate_x"), rig) if isinstance(d, Rows)]
    strokes = [list(of_one) for _, of_one in itertools.groupby(blocks, key=lambda d: d.segment)]
    assert strokes[0][0].segment == "rest"  # nothing came before it
    ends = [stroke[-1] for stroke in strokes if stroke[0].segment.startswith("rate_x/")]
    assert len(ends) > 30
    assert {len(end.columns["time_s"]) for end in ends} == {30}


def test_a_run_is_start_descriptor_states_with_rows_and_stop() -> None:
    plan = short("estimate_x", "rate_z")
    documents = list(run(plan, open_rig("twin:?seed=1"), run_id="r1", header={"operator": "A"}, clock=lambda: 7.0))
    assert [document.seq for document in documents] == list(range(len(documents)))
    assert {(document.run, document.time) for document in documents} == {("r1", 7.0)}
    kinds = [kind for kind, _ in itertools.groupby(type(document) for document in documents)]
    assert kinds == [Start, Descriptor, StateBegin, Rows, StateEnd, StateBegin, Rows, StateEnd, Stop]
    assert documents[-1] == Stop(run="r1", seq=len(documents) - 1, time=7.0, status="finished")
    start, descriptor = documents[:2]
    assert isinstance(start, Start)
    assert isinstance(descriptor, Descriptor)
    assert Plan.from_json(start.plan) == plan
    assert start.seed == 1
    assert descriptor.header["operator"] == "A"
    assert descriptor.header["seed"] == "1"
    assert descriptor.header["z_gyro_delay_s"] == "0.0001"


def test_rows_are_columns_that_cross_a_process_boundary() -> None:
    rows = [d for d in run(short("estimate_x"), open_rig("twin:")) if isinstance(d, Rows)]
    for document in rows:
        assert {(values.dtype, values.shape) for values in document.columns.values()} == {
            (np.dtype(np.float64), document.columns["time_s"].shape)
        }
        assert (document.fast is not None) == (document.segment == "hold")
    again = pickle.loads(pickle.dumps(rows[5]))
    np.testing.assert_array_equal(again.columns["x_gyro_v"], rows[5].columns["x_gyro_v"])
    fast = np.concatenate([d.fast["time_s"] for d in rows if d.fast is not None])
    assert fast[-1] - fast[0] == pytest.approx(3.0, abs=0.002)
    assert np.diff(fast) == pytest.approx(0.001)


def test_progress_counts_readings_and_bench_time() -> None:
    plan = short("rate_x")
    seen = [d.progress for d in run(plan, open_rig("twin:")) if isinstance(d, Rows)]
    assert (seen[0].done, seen[-1].done, seen[-1].of) == (0, 54, 54)
    assert seen[-1].state_fraction == pytest.approx(1.0)
    assert seen[-1].run_fraction == pytest.approx(1.0)
    assert seen[-1].seconds_left == pytest.approx(0.0, abs=1e-6)
    assert seen[0].seconds_left == pytest.approx(plan.duration_s, abs=2.01)
    assert all(a.seconds_left >= b.seconds_left for a, b in itertools.pairwise(seen))


def test_a_rig_that_cannot_do_the_plan_is_told_before_anything_moves() -> None:
    rig = Watched()
    with pytest.raises(Problem) as caught:
        run(make_plan("standard", seed=1, ranges={"x": {"position_deg": 155}}), rig)
    assert caught.value.code == "plan.angle_past_rig"
    assert rig.plant.now_s == 0.0
    assert not any(servo.torque_on for servo in rig.plant.servos.values())


@pytest.mark.parametrize("state", STATES)
def test_stop_in_every_state_takes_one_block_and_leaves_the_motors_off(state: str) -> None:
    rig, abort, documents = Watched(), Event(), []
    source = run(short(state), rig, abort=abort)
    until(documents, source, moving_in(state))
    assert any(servo.torque_on for servo in rig.plant.servos.values())
    abort.set()
    (stop,) = source
    assert isinstance(stop, Stop)
    assert (stop.status, stop.code) == ("stopped", "run.stopped")
    assert rig.made_safe == 1
    assert rig.at_rest


def test_an_emergency_stop_under_a_read_is_a_stop_and_no_fault() -> None:
    rig, abort, documents = Watched(), Event(), []
    source = run(short("rate_x"), rig, abort=abort)
    until(documents, source, moving_in("rate_x"))

    def taken_away(n: int) -> None:
        abort.set()
        raise DeviceError("rig.daq_silent", part="NI USB-6008", asked=n)

    rig.twin_daq.read = taken_away  # type: ignore[method-assign, assignment]
    *_, stop = source
    assert isinstance(stop, Stop)
    assert stop.status == "stopped"


FAULTS: dict[str, tuple[Callable[[Watched, str], object], str]] = {
    "daq": (lambda rig, _: setattr(rig.twin_daq, "unplugged", True), "rig.daq_silent"),
    "servo": (lambda rig, axis: rig.twin_table.silent.add(axis), "rig.servo_silent"),
    "jam": (lambda rig, axis: rig.plant.servos[axis].stop(rig.plant.now_s, jam=True), "rig.stalled"),
    "bug": (lambda rig, _: setattr(rig.twin_daq, "read", None), "internal"),
}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_every_state_ends_the_run_with_its_sentence_and_a_safe_rig(state: str, fault: str) -> None:
    rig, documents = Watched(), []
    source = run(short(state), rig)
    until(documents, source, moving_in(state))
    inject, code = FAULTS[fault]
    inject(rig, state[-1])
    *_, stop = source
    assert isinstance(stop, Stop)
    assert (stop.status, stop.code) == ("failed", code)
    assert rig.made_safe == 1
    assert rig.at_rest


@pytest.mark.parametrize("state", STATES)
def test_a_consumer_that_goes_away_leaves_the_rig_safe(state: str) -> None:
    rig, documents = Watched(), []
    source = run(short(state), rig)
    until(documents, source, moving_in(state))
    source.close()
    assert rig.made_safe == 1
    assert rig.at_rest


def test_an_exception_in_the_consumer_leaves_the_rig_safe() -> None:
    rig = Watched()

    def consume() -> None:
        for document in run(short("rate_x"), rig):
            if moving_in("rate_x")(document):
                raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        consume()
    assert rig.made_safe == 1
    assert rig.at_rest


def test_a_rig_that_cannot_be_made_safe_says_to_cut_the_power() -> None:
    class Deaf(Watched):
        def safe(self) -> None:
            raise DeviceError("rig.servo_silent", axis="x", part="RX-28")

    *_, stop = run(short("estimate_x"), Deaf())
    assert isinstance(stop, Stop)
    assert (stop.status, stop.code) == ("failed", "rig.not_safe")


def test_a_rig_that_does_not_answer_fails_the_run_before_it_moves() -> None:
    rig = Watched()
    rig.twin_daq.unplugged = True
    start, stop = run(short(), rig)
    assert isinstance(start, Start)
    assert isinstance(stop, Stop)
    assert (stop.status, stop.code) == ("failed", "rig.daq_silent")
    assert rig.made_safe == 1


class FakeTime:
    """A clock that only an abort's wait moves forward."""

    def __init__(self) -> None:
        self.now, self.stop_at = 100.0, math.inf

    def clock(self) -> float:
        return self.now

    def is_set(self) -> bool:
        return self.now >= self.stop_at

    def wait(self, timeout: float | None = None) -> bool:
        self.now = min(self.now + (timeout or 0.0), max(self.stop_at, self.now))
        return self.is_set()


@pytest.mark.parametrize("speed", [1.0, 20.0])
def test_bench_time_goes_as_fast_as_asked(speed: float) -> None:
    fake = FakeTime()
    plan = short("estimate_x")
    blocks = [d for d in run(plan, open_rig("twin:"), pace=Pacer(speed, fake.clock), abort=fake) if isinstance(d, Rows)]
    assert fake.now - 100.0 == pytest.approx(plan.duration_s / speed, rel=1e-6)
    assert max(len(block.columns["time_s"]) for block in blocks) == round(5 * speed)


def test_at_any_speed_an_abort_is_answered_within_50_ms() -> None:
    for speed in (1.0, 20.0, 100.0):
        fake = FakeTime()
        fake.stop_at = 100.1234
        *_, stop = run(short("estimate_x"), open_rig("twin:"), pace=Pacer(speed, fake.clock), abort=fake)
        assert isinstance(stop, Stop)
        assert stop.status == "stopped"
        assert fake.now - fake.stop_at <= 0.05


def test_time_lost_by_a_slow_consumer_is_not_rushed_after() -> None:
    fake = FakeTime()
    pace = Pacer(1.0, fake.clock)
    fake.now += 60.0
    for _ in range(40):
        pace.wait(0.05, fake)
    assert fake.now - 160.0 == pytest.approx(40 * 0.05, abs=0.11)


def test_a_real_rig_has_no_other_speed_than_its_own() -> None:
    rig = Watched()
    rig.simulated = False
    with pytest.raises(Problem, match=r"rig\.speed_fixed"):
        run(short("estimate_x"), rig, pace=Pacer(20.0))
    with pytest.raises(Problem, match=r"rig\.speed"):
        Pacer(0.0)


def test_the_same_seeds_give_the_same_recording_and_another_seed_another() -> None:
    plan = short("estimate_x", "position_z")
    one, again, other = (record(plan, open_rig(f"twin:?seed={seed}"), board="B") for seed in (5, 5, 6))
    assert one.digest() == again.digest()
    assert one.digest() != other.digest()
    assert one.header["board"] == "B"


def test_the_gyro_recorded_is_the_board_asked_for() -> None:
    plan = short("estimate_x")
    rig = open_rig("twin:?seed=5")
    a, b, a_again = (record(plan, rig, board=board) for board in ("A", "B", "A"))
    means = [recording.columns["x_gyro_v"].mean() for recording in (a, b, a_again)]
    assert means[0] == pytest.approx(means[2], abs=5e-4)
    assert abs(means[0] - means[1]) > 2e-3


def test_a_recording_that_fails_raises_what_ended_it() -> None:
    rig = Watched()
    rig.twin_daq.unplugged = True
    with pytest.raises(Problem, match=r"rig\.daq_silent"):
        record(short("estimate_x"), rig)


def test_six_whole_states_cost_little_time_and_memory() -> None:
    plan = make_plan("standard", seed=1)
    began = process_time()
    rows = sum(len(d.columns["time_s"]) for d in run(plan, open_rig("twin:?seed=1")) if isinstance(d, Rows))
    assert process_time() - began < 6.0
    assert rows == pytest.approx(267_000, rel=0.02)
    tracemalloc.start()
    for _ in run(short("position_x"), open_rig("twin:?seed=1")):
        pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6
