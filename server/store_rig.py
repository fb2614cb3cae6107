"""The calibration records of rigs' encoders: the newest is the one in force, none is ever changed."""

import json
from typing import Any

from calib_core.reference import ReferenceCalibration
from server.store_db import Connection, dumps, now


class RigRecords:
    """By kind of rig ("dynamixel", "emulated", "twin"): a server has one bench of each."""

    def __init__(self, connection: Connection) -> None:
        self._at = connection

    def get(self, rig: str) -> ReferenceCalibration | None:
        """The record in force for the rig at this address."""
        found = self._at.rows("select body from rig_records where kind = ? order by id desc limit 1", [_kind(rig)])
        body: dict[str, Any] | None = json.loads(found[0]["body"]) if found else None
        return None if body is None else ReferenceCalibration.from_json(body)

    def set(self, rig: str, record: ReferenceCalibration | None) -> None:
        """From now on; None: not calibrated any more."""
        row = {"kind": _kind(rig), "body": dumps(None if record is None else record.to_json()), "created_at": now()}
        with self._at.write() as db:
            db.table("rig_records").insert(row)


def _kind(rig: str) -> str:
    return rig.partition(":")[0]
