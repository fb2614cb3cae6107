"""What was asked for becomes a plan and a stored, queued run; the API and the command line both come here."""

import secrets
from collections.abc import Mapping
from typing import Any

from calib_core import sequence, session
from calib_core.certificate import limits
from calib_core.gyro_models import GyroModel
from calib_core.problem import Problem
from calib_core.sequence import Axis, Plan
from server.store import Store
from server.store_boards import USUAL_MODEL
from server.store_db import Row, checked_id

# What a run that repeats some states takes over from the one it continues, unless asked otherwise.
INHERITED = ("gyro_model", "profile", "readings", "seed", "ranges", "spec")


def plan_of(store: Store, request: Mapping[str, Any], axes: Mapping[str, Axis]) -> tuple[dict[str, Any], Plan]:
    """The request with its blanks filled, and its plan, walked against sensor and rig. Raises Problem, nothing stored.

    ``request`` has the keys of POST runs (CONTRACT 4); ``axes`` are the rig's, empty where it is not known yet.
    """
    board = checked_id(str(request["board"]), "board")
    filled = {name: value for name, value in request.items() if value is not None}
    known: list[str] = []
    model: GyroModel | None = None
    if continues := filled.get("continues"):
        before = store.runs.get(continues)
        _check_continues(before, board, filled)
        inherited = {"gyro_model": before["gyro_model"], "profile": before["profile"], **before["request"]}
        filled = {name: inherited.get(name) for name in INHERITED} | filled
        done = [entry["name"] for entry in before["states"] if entry["status"] in ("done", "kept")]
        filled["kept"] = [name for name in done if name not in filled["states"]]
        model = GyroModel.from_json(before["plan"]["gyro_model"])  # as it was then
        known = [name[-1] for name in filled["kept"] if name.startswith("estimate_")]
    if filled.get("spec") is not None:
        limits(filled["spec"])
    filled.setdefault("profile", "standard")
    if filled.get("seed") is None:
        filled["seed"] = secrets.randbelow(2**31)
    if filled.get("gyro_model") is None:
        filled["gyro_model"] = _model_of_board(store, board)
    plan = sequence.make_plan(
        filled["profile"],
        seed=filled["seed"],
        states=filled.get("states"),
        readings=filled.get("readings"),
        ranges=filled.get("ranges"),
        gyro_model=model or store.gyro_models.get(filled["gyro_model"]),
    )
    session.check_states([state.name for state in plan.states], known)
    if axes:
        sequence.check(plan, axes)
    return filled, plan


def create(store: Store, filled: Mapping[str, Any], plan: Plan, *, rig: str, speed: float) -> str:
    """A queued run with its empty recording, one that continues another with that one's kept states."""
    kept: list[str] = filled.get("kept", [])
    before = store.runs.get(filled["continues"]) if kept else {}
    if kept and before["request"]["rig"] != rig:
        raise Problem("run.continues_other", name="rig", given=rig, before=before["request"]["rig"])
    request = {**filled, "readings": plan.readings, "rig": rig, "speed": speed if speed < float("inf") else "max"}
    board = request["board"]
    with store.connection.write():
        store.boards.ensure(board, gyro_model=filled["gyro_model"])
        recording = store.recordings.create(board=board, name=board, source="run", header={})
        run = store.runs.create(
            board=board,
            gyro_model=filled["gyro_model"],
            profile=plan.profile,
            recording=recording,
            request=request,
            plan=plan.to_json(),
            states=[name for name in sequence.STATES if name in {*kept, *(state.name for state in plan.states)}],
        )
        if kept:
            store.recordings.copy_states(before["recording"], recording, kept)
            for name in kept:
                store.runs.set_state(run, name, "kept")
                if name in before["results"]:
                    store.runs.set_result(run, name, before["results"][name])
    return run


def _check_continues(before: Row, board: str, filled: Mapping[str, Any]) -> None:
    if not filled.get("states"):
        raise Problem("run.continues_states")
    for name in ("board", "gyro_model", "profile"):
        given = board if name == "board" else filled.get(name)
        if given is not None and given != before[name]:
            raise Problem("run.continues_other", name=name, given=given, before=before[name])


def _model_of_board(store: Store, board: str) -> str:
    try:
        return str(store.boards.get(board)["gyro_model"])
    except Problem:
        return USUAL_MODEL
