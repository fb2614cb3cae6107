"""Before an unknown board the table turns slowly, and what does not answer rightly ends the run there."""

import threading
from dataclasses import replace

import pytest

from calib_core.gyro_models import PRESETS
from calib_core.model import Model
from calib_core.sequence import make_plan
from calib_core.twin import Plant, board_truth
from server import engine
from server.devices import DeviceError
from server.devices.rehearsal import rehearse
from server.devices.rig import Rig
from server.devices.twin_rig import TwinDaq, TwinTable

MODEL = PRESETS["LPY503AL-OUT"]


def like_a_real_one(models: dict[str, Model]) -> Rig:
    """The twin's table and DAQ as a rig that something could catch on."""
    table = TwinTable(Plant(1, models))
    return Rig("bench", table, TwinDaq(table), simulated=False)


def test_a_good_board_is_turned_slowly_once_and_the_rig_is_safe_afterwards() -> None:
    rig = like_a_real_one(board_truth(1))
    fastest: list[float] = []
    start = rig.table.start
    rig.table.start = lambda motions: (fastest.extend(motion.peak_rate_dps for motion in motions), start(motions))[1]  # type: ignore[method-assign]
    rehearse(rig, "B-1", MODEL, threading.Event())
    assert 0.0 < max(fastest) <= 15.0
    assert not any(servo.torque_on for servo in rig.table.telemetry().values())
    fastest.clear()
    rehearse(rig, "B-1", MODEL, threading.Event())
    assert fastest == []
    rehearse(rig, "B-2", MODEL, threading.Event())
    assert fastest


@pytest.mark.parametrize(
    ("axis", "wrong", "code"),
    [
        ("x", {"scale_factor": 0.0}, "check.gyro_still"),
        ("z", {"scale_factor": -5.9e-3}, "check.gyro_reversed"),
        ("x", {"bias": 2.49}, "check.gyro_rail"),
    ],
)
def test_a_gyro_that_does_not_answer_rightly_ends_the_run_before_its_first_sample(
    axis: str, wrong: dict[str, float], code: str
) -> None:
    truth = board_truth(1)
    rig = like_a_real_one(truth | {axis: replace(truth[axis], **wrong)})
    plan = make_plan("standard", seed=1, states=["estimate_x"])
    *documents, stop = engine.run(plan, rig, board="B-1", pace=engine.Pacer(1.0))
    assert [type(document) for document in documents] == [engine.Start]
    assert isinstance(stop, engine.Stop)
    assert (stop.status, stop.code, stop.values["found"]["code"]) == ("failed", "rig.rehearsal", code)
    assert rig.rehearsed is None


def test_an_abort_ends_the_rehearsal() -> None:
    rig = like_a_real_one(board_truth(1))
    stop = threading.Event()
    stop.set()
    with pytest.raises(DeviceError, match=r"rig\.stopped"):
        rehearse(rig, "B-1", MODEL, stop)
