"""The next experiment: proposed from a recording, run on a rig, joined to the data in hand, and judged again."""

import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib_core.problem import Problem
from server import diagnosis, untested
from server.compute import tell

if TYPE_CHECKING:
    from calib_core.effects import Effect
    from calib_core.gap import Diagnosis
    from calib_core.gyro_models import GyroModel
    from calib_core.recording import Recording
    from calib_core.sequence import Axis
    from server.devices.rig import Rig
    from server.store import Store

Words = dict[str, Any]


def following(
    found: "Diagnosis", axes: "Mapping[str, Axis] | None" = None, gyro_model: "GyroModel | None" = None
) -> Words | None:
    """CONTRACT 3's ``next_experiment`` after a diagnosis, with its code and values in words."""
    from calib_core import experiment

    proposal = experiment.propose(found, axes or experiment.RIG, gyro_model)
    if proposal is None:
        return None
    answer = proposal.to_json()
    known = answer["values"]
    words: Words = {"motion": motion_words(answer["motion"])}
    if proposal.kind == "unknown":
        words["along"] = diagnosis.along(proposal.separates[0])
        words["effects"] = words["along"]
    else:
        words["effects"] = diagnosis.effect_words(proposal.separates, "both")
    return answer | {"values": known | words}


def motion_words(motion: Sequence[Mapping[str, Any]]) -> Any:
    """What to do, one thing after the other."""
    words = [
        {
            "code": f"experiment.motion.{one['kind']}",
            "values": {
                "axis": one["axis"],
                "duration_s": one["duration_s"],
                "frequencies": one.get("frequency_hz", []),
                "amplitudes": [round(size, 1) for size in one.get("amplitude_deg", [])],
                "rates": one.get("rates_dps", []),
                "angles": one.get("angles_deg", []),
            },
        }
        for one in motion
    ]
    if len(words) < 2:
        return words
    return {"code": "experiment.then", "values": {"some": words[:-1], "last": words[-1]}}


def perform(
    recording: "Recording", axis: str, motion: Sequence[Mapping[str, Any]], rig: "Rig", *, name: str = "1"
) -> "Recording":
    """Runs ``motion`` on the rig, at its own pace, and joins it to the recording in hand.

    Raises Problem where the rig cannot do it (before anything moves), fails, or gives what cannot be joined.
    """
    from calib_core import experiment
    from calib_core.excitation import Excitation, plan_of
    from calib_core.gyro_models import PRESETS
    from server import engine

    if axis not in rig.axes:
        raise Problem("experiment.no_axis", axis=axis)
    gyro_model = experiment.model_of(recording.header) or PRESETS["LPY503AL-OUT"]
    steps = [Excitation.from_json(one) for one in motion]
    plan = plan_of(steps, experiment=name, axis=axis, gyro_model=gyro_model)
    done = engine.record(plan, rig, board=recording.header.get("board", ""))
    return experiment.join(recording, done, axis)


def run(
    recording: "Recording",
    axis: str,
    rig: "Rig",
    *,
    effects: Sequence[str] = (),
    suspects: "Mapping[str, type[Effect]] | None" = None,
    most: int = 1,
) -> tuple[Words, "Recording"]:
    """Diagnoses, and does what would settle it up to ``most`` times: the last diagnosis and all data together.

    The diagnosis says what was done under ``experiments``. Time goes on from the end of the recording, as in one
    session of one board: a simulated rig is taken there first, if it has not come so far.
    """
    experiments: list[Words] = []
    rig.after(recording.time_s[-1])

    def judge() -> Words:
        return diagnosis.of_recording(recording, axis=axis, effects=effects, suspects=suspects, axes=rig.axes)

    answer = judge()
    while answer["next_experiment"] and len(experiments) < most:
        following = answer["next_experiment"]
        recording = perform(recording, axis, following["motion"], rig, name=str(len(experiments) + 1))
        experiments.append({**following, "before": answer["verdict"]})
        answer = judge()
    return answer | {"experiments": experiments}, recording


# --- in the server: by the store, each step in the process that has to do it --------------------------------------
def proposed(
    data: Path, recording: str, axis: str, effects: Sequence[str], axes: Mapping[str, Mapping[str, Any]], rig: str
) -> str:
    """Stores the proposal for a stored recording on a rig with ``axes`` (as the worker told them); gives its id.

    Raises Problem where nothing is open that a motion could settle.
    """
    from calib_core.sequence import Axis
    from server.store import Store

    with Store(data) as store:
        hand = store.recording(recording)
        if axis not in hand.axes:
            raise Problem("diagnosis.no_axis", axis=axis, axes=", ".join(hand.axes))
        known = {name: Axis(**facts) for name, facts in axes.items()}
        suspects = store.effects.suspects()
        answer = diagnosis.of_recording(hand, axis=axis, effects=effects, suspects=suspects, axes=known, told=tell)
        following = answer["next_experiment"]
        if following is None:
            raise _settled(answer)
        row = store.experiments.add(recording, axis, effects, {**following, "verdict": answer["verdict"], "rig": rig})
        return str(row["id"])


def _settled(answer: Mapping[str, Any]) -> Problem:
    """Why no motion is proposed: nothing is open, or what is needs more than motion."""
    left, needed = (
        untested.rows(answer["candidates"]),
        diagnosis.joined("both", list(untested.needed(answer["candidates"]))),
    )
    effects = diagnosis.effect_words([row["effect"] for row in left], "both")
    if needed:
        return Problem("experiment.needs_data", axis=answer["axis"], effects=effects, needed=needed)
    if left:
        return Problem("experiment.nothing_shows", axis=answer["axis"], effects=effects)
    return Problem("experiment.nothing_open", axis=answer["axis"])


def create(
    store: "Store", row: Mapping[str, Any], axes: Mapping[str, Mapping[str, Any]], *, rig: str, speed: float
) -> str:
    """The queued run of a stored experiment, checked against sensor and rig; gives its id."""
    from calib_core import sequence
    from calib_core.excitation import Excitation, plan_of
    from calib_core.experiment import model_of
    from server.store_boards import USUAL_MODEL

    header, board = store.recordings.row(row["recording"])["header"], store.recordings.row(row["recording"])["board"]
    gyro_model = model_of(header) or store.gyro_models.get(USUAL_MODEL)
    motion = [Excitation.from_json(one) for one in row["proposal"]["motion"]]
    plan = plan_of(motion, experiment=row["id"], axis=row["axis"], gyro_model=gyro_model)
    if axes:
        sequence.check(plan, {name: sequence.Axis(**facts) for name, facts in axes.items()})
    shown = speed if speed < float("inf") else "max"
    request = {"board": board, "experiment": row["id"], "seed": plan.seed, "readings": plan.readings, "rig": rig}
    with store.connection.write():
        if board:
            store.boards.ensure(board, gyro_model=gyro_model.id or USUAL_MODEL)
        recording = store.recordings.create(board=board, name=board or row["id"], source="experiment", header={})
        run = store.runs.create(
            board=board,
            gyro_model=gyro_model.id or USUAL_MODEL,
            profile=plan.profile,
            recording=recording,
            request={**request, "speed": shown},
            plan=plan.to_json(),
            states=[state.name for state in plan.states],
        )
        store.experiments.begin(row["id"], run)
    return run


def judged(data: Path, experiment: str) -> None:
    """Joins a finished experiment to its recording, keeps both as one recording, and stores the joined diagnosis."""
    from calib_core.experiment import join
    from server.store import Store

    with Store(data) as store:
        row = store.experiments.get(experiment)
        if row["result"] is not None:
            return
        hand = store.recording(row["recording"])
        done = store.recording(store.runs.get(row["run"])["recording"])
        try:
            both = join(hand, done, row["axis"], _between(hand.header, done.header))
            asked = {"axis": row["axis"], "effects": row["effects"], "suspects": store.effects.suspects()}
            answer = diagnosis.of_recording(both, **asked, told=tell)
            board = done.header.get("board", "")
            kept = store.recordings.add(both, board=board, name=f"{board}+{experiment}", source="experiment")
            result: Words = {"recording": kept, "diagnosis": answer}
        except Problem as problem:
            values = json.loads(json.dumps(problem.values, default=str))
            result = {"message": {"code": problem.code, "values": values}}
        store.experiments.judge(experiment, result)


def _between(hand: Mapping[str, str], done: Mapping[str, str]) -> float:
    """Seconds between the end of one record and the beginning of the next, by the clock on the wall.

    Simulated time stands still between runs; where nothing is known it is taken for a moment.
    """
    from calib_core.prospect import PAUSE_S

    ended, began = hand.get("finished_at"), done.get("started_at")
    if not ended or not began or done.get("rig", "").startswith("twin:"):
        return PAUSE_S
    return max(PAUSE_S, (datetime.fromisoformat(began) - datetime.fromisoformat(ended)).total_seconds())
