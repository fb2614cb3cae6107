"""The one way from a recording to a certificate, for the worker, the API and the command line.

    store or file -> Recording -> session.analyse -> content -> store (insert only)

Content depends on the recording (its header included), gyro model, specification, software version and the saved model
that it is compensated by alone, and names them all, so that anyone can compute it again; number and day of issue come
from the store.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

from calib_core import session
from calib_core.certificate import judge, limits
from calib_core.gyro_models import GyroModel
from calib_core.problem import Problem
from calib_core.recording import Recording
from calib_core.reference import HEADER, ReferenceCalibration
from calib_core.sequence import PROFILES, STATES
from server import __version__
from server.settings import is_simulated
from server.store import Store

FORMAT = "gyrobench-certificate 1"
# Kept where the recording's header says it; text as the operator wrote it.
COPIED = ("operator", "note", "started_at", "finished_at", "seed")
SAME = 1e-9
"""Relative difference up to which a recomputed number is the same: other processors add in another order."""
MORE_SHOWN = 20


def certify(
    store: Store,
    recording_id: str,
    *,
    gyro_model: GyroModel | None = None,
    spec: Mapping[str, Any] | None = None,
    compensation: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """Analyses a stored recording and issues its certificate; the issued content, number included.

    ``compensation`` (saved models as ``compensated_by`` gives them): their axes are certified with the effects taken
    out.

    Raises Problem where the recording, the specification or the store does not allow it; then nothing is issued.
    """
    return store.issue_certificate(
        content(
            store.recording(recording_id), recording_id, gyro_model=gyro_model, spec=spec, compensation=compensation
        )
    )


def content(
    recording: Recording,
    recording_id: str,
    *,
    gyro_model: GyroModel | None = None,
    spec: Mapping[str, Any] | None = None,
    compensation: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """What a certificate says, without number and date of issue."""
    if spec is not None:
        limits(spec)  # refused before the work, not after it
    found = session.analyse(_without(recording, compensation), gyro_model=gyro_model)
    verdict, judgement = judge(found.axes, spec)
    header = recording.header
    rig = header.get("rig", "")
    calibration = ReferenceCalibration.of(header)
    return {
        "format": FORMAT,
        "board": header.get("board", ""),
        **{name: header.get(name, "") for name in COPIED},
        "gyro_model": found.gyro_model.to_json(),
        "conditions": _numbers(header, room_temperature_degC="room_temperature_degC"),
        "rig": {
            "url": rig,
            "simulated": is_simulated(rig),
            "reference_calibration": header.get(HEADER, "") if calibration is None else calibration.name,
            "reference": None if calibration is None else calibration.to_json(),
            "clock": _numbers(header, offset_s="clock_offset_s", skew_ppm="clock_skew_ppm"),
        },
        "profile": found.profile,
        "readings": _readings(found),
        "recording": {
            "id": recording_id,
            "digest": recording.digest(),
            "samples": len(recording),
            "duration_s": round(recording.duration_s, 3),
        },
        "software": {"name": "gyrobench", "version": __version__},
        "axes": found.axes,
        "states": found.states,
        "warnings": [*_plan_warnings(found), *found.warnings],
        "spec": spec,
        "verdict": verdict,
        "judgement": judgement,
        **({"compensation": dict(compensation[0])} if len(compensation) == 1 else {}),
        **({"compensation": [dict(one) for one in compensation]} if len(compensation) > 1 else {}),
    }


def compensated_by(saved: Mapping[str, Any]) -> dict[str, Any]:
    """A saved model as a certificate states it: what it is called, and all that computes it again."""
    from server.store_models import compensation_of

    told = compensation_of(saved).to_json()
    return told | {"model": saved["id"], "name": saved["name"], "error": saved["error"], "software": saved["software"]}


def taken_out(certificate: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The saved models that a certificate's axes were freed of: it states one, or a list of several."""
    stated = certificate.get("compensation") or []
    return [stated] if isinstance(stated, Mapping) else list(stated)


def _without(recording: Recording, compensation: Sequence[Mapping[str, Any]]) -> Recording:
    if not compensation:
        return recording
    from calib_core.compensation import Compensation
    from calib_core.corrected import corrected

    models = [Compensation.from_json(one) for one in compensation]
    for k, model in enumerate(models):
        if model.axis in (other.axis for other in models[:k]):
            raise Problem("compensation.same_axis", axis=model.axis)
    for model in models:
        recording = corrected(recording, model)
    return recording


def verify(certificate: Mapping[str, Any], recording: Recording) -> dict[str, Any]:
    """Computes a certificate again from its recording and says where it differs: {"valid", "digest_ok",
    "differences": [{"path", "certified", "computed"}]}.
    """
    known = certificate["recording"]
    again = content(
        recording,
        known["id"],
        gyro_model=GyroModel.from_json(certificate["gyro_model"]),
        spec=certificate["spec"],
        compensation=taken_out(certificate),
    )
    names = ("axes", "verdict", "judgement", "profile", "board")
    differences = [found for name in names for found in _compare(name, certificate[name], again[name])]
    digest_ok = known["digest"] == again["recording"]["digest"]
    return {
        "valid": digest_ok and not differences,
        "digest_ok": digest_ok,
        "differences": differences[:MORE_SHOWN],
        "software": {"certified": certificate["software"]["version"], "computed": __version__},
    }


def _compare(path: str, certified: Any, computed: Any) -> Iterator[dict[str, Any]]:
    if isinstance(certified, Mapping) and isinstance(computed, Mapping):
        for key in dict.fromkeys([*certified, *computed]):
            yield from _compare(f"{path}.{key}", certified.get(key), computed.get(key))
    elif isinstance(certified, list) and isinstance(computed, list) and len(certified) == len(computed):
        for i, (one, other) in enumerate(zip(certified, computed, strict=True)):
            yield from _compare(f"{path}.{i}", one, other)
    elif not _same(certified, computed):
        yield {"path": path, "certified": certified, "computed": computed}


def _same(certified: object, computed: object) -> bool:
    if isinstance(certified, float) and isinstance(computed, float):
        return abs(certified - computed) <= SAME * max(abs(certified), abs(computed))
    return certified == computed


def _numbers(header: Mapping[str, str], **names: str) -> dict[str, float]:
    """Those of the header's lines that are numbers, under our names."""
    found = {}
    for name, line in names.items():
        with suppress(ValueError):
            found[name] = float(header.get(line, ""))
    return {name: value for name, value in found.items() if math.isfinite(value)}


def _readings(found: session.Session) -> int | None:
    """Repeat readings at a set-point, counted in what was measured; None where there was no repeat test."""
    counts = [len(point["readings"]) for state in found.states.values() for point in _repeats(state)]
    return max(counts, default=None)


def _repeats(state: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    points: list[Mapping[str, Any]] = state.get("points", {}).get("repeat", [])
    return points


def _plan_warnings(found: session.Session) -> Iterator[dict[str, Any]]:
    """A short plan or a part of one is certified as what it is."""
    usual, readings = PROFILES[found.profile].repeat_readings, _readings(found)
    if readings is not None and readings != usual:
        yield {"code": "session.short_plan", "values": {"readings": readings, "usual": usual}}
    if len(found.states) < len(STATES):
        yield {"code": "session.partial", "values": {"states": ", ".join(found.states)}}
