"""A simulated six-state session, made once a process: the real engine on the twin, with three repeat readings."""

import json
from dataclasses import asdict
from functools import cache

from calib_core.recording import Recording
from calib_core.sequence import make_plan
from server.devices import open_rig
from server.engine import record

BOARD, SEED = "LPY-7", 7


@cache
def session_recording(profile: str = "standard", states: tuple[str, ...] | None = None) -> Recording:
    plan = make_plan(profile, seed=SEED, readings=3, states=states)
    header = {
        "ranges": json.dumps({axis: asdict(ranges) for axis, ranges in plan.ranges.items()}),
        "gyro_model": json.dumps(plan.gyro_model.to_json()),
        "operator": "Ada",
        "started_at": "2026-11-22T06:10:00.123456Z",
        "finished_at": "2026-11-22T06:55:13Z",
        "room_temperature_degC": "24.5",
    }
    return record(plan, open_rig(f"twin:?seed={SEED}"), board=BOARD, header=header)
