"""The next experiment: proposed from a recording, run on a rig, joined to the data in hand, and judged again."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from calib_core.problem import Problem
from server import diagnosis

if TYPE_CHECKING:
    from calib_core.effects import Effect
    from calib_core.gap import Diagnosis
    from calib_core.gyro_models import GyroModel
    from calib_core.recording import Recording
    from calib_core.sequence import Axis
    from server.devices.rig import Rig

Words = dict[str, Any]


def propose(
    recording: "Recording",
    axis: str,
    axes: "Mapping[str, Axis] | None" = None,
    gyro_model: "GyroModel | None" = None,
    *,
    effects: Sequence[str] = (),
    suspects: "Mapping[str, type[Effect]] | None" = None,
) -> Words:
    """The diagnosis (CONTRACT 3) with ``next_experiment`` for a rig with ``axes`` (None: the usual bench).

    Without anything to settle ``next_experiment`` is None. Sentences are added by ``diagnosis.told``.
    """
    from calib_core.gap import diagnose
    from calib_core.gap_report import to_json

    found = diagnose(recording, axis, effects=effects, suspects=dict(suspects) if suspects is not None else None)
    answer = diagnosis.explained(to_json(found))
    return answer | {"next_experiment": following(found, axes, gyro_model)}


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
    gyro_model = experiment.model_of(recording) or PRESETS["LPY503AL-OUT"]
    steps = [Excitation.from_json(one) for one in motion]
    plan = plan_of(steps, experiment=name, axis=axis, gyro_model=gyro_model)
    done = engine.record(plan, rig, board=recording.header.get("board", ""))
    return experiment.join(recording, done, axis)


def run(
    recording: "Recording", axis: str, rig: "Rig", *, effects: Sequence[str] = (), most: int = 1
) -> tuple[Words, "Recording"]:
    """Diagnoses, and does what would settle it up to ``most`` times: the last diagnosis and all data together.

    The diagnosis says what was done under ``experiments``. Time goes on from the end of the recording, as in one
    session of one board: a simulated rig is taken there first, if it has not come so far.
    """
    experiments: list[Words] = []
    rig.after(recording.time_s[-1])
    answer = propose(recording, axis, rig.axes, effects=effects)
    while answer["next_experiment"] and len(experiments) < most:
        following = answer["next_experiment"]
        recording = perform(recording, axis, following["motion"], rig, name=str(len(experiments) + 1))
        experiments.append({**following, "before": answer["verdict"]})
        answer = propose(recording, axis, rig.axes, effects=effects)
    return answer | {"experiments": experiments}, recording
