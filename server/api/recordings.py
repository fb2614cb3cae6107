"""Recordings: upload, list, download."""

import json
import tempfile
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, File, Form, UploadFile
from fastapi.responses import FileResponse
from starlette.background import BackgroundTask

from calib_core.problem import Problem
from server import compute
from server.api import models
from server.api.common import Cursor, Here, Limit, Search, Services
from server.problems import declared
from server.store_db import checked_id

router = APIRouter(prefix="/recordings", tags=["recordings"])
FORMS = {
    "csv": "text/csv; charset=utf-8",
    "parquet": "application/vnd.apache.parquet",
    "fast.csv": "text/csv; charset=utf-8",
}


@router.get("", summary="Recordings, newest first")
def recordings(
    here: Here, q: Search = "", board: Search = "", limit: Limit = 50, cursor: Cursor = None
) -> models.Recordings:
    items, following = here.store.recordings.find(q=q, board=board, limit=limit, cursor=cursor)
    return models.Recordings.model_validate({"items": items, "next": following})


@router.post(
    "",
    status_code=201,
    summary="Keep a recording: gyro-recording 1 as CSV, .csv.gz or Parquet, or gyro-points 1 as CSV",
    responses=declared(400, 413),
)
async def upload(
    here: Here,
    file: Annotated[UploadFile, File(description="the recording")],
    map: Annotated[str, Form(max_length=10_000, description='foreign columns: {"gyro_x": "x_gyro_dps"}')] = "",
    board: Annotated[str, Form(max_length=64)] = "",
) -> models.RecordingAnswer:
    if board:
        checked_id(board, "board")
    name = Path(file.filename or "recording").name[:200]
    with tempfile.TemporaryDirectory(prefix="gyrobench-") as folder:
        kept = Path(folder, "upload")
        with kept.open("wb") as copy:
            while piece := await file.read(1 << 20):
                copy.write(piece)
        recording = await here.compute.run(
            compute.import_recording, here.store.data, kept, name, _mapping(map), board or None
        )
    return models.RecordingAnswer(**here.store.recordings.row(recording))


def _mapping(text: str) -> dict[str, str]:
    try:
        given: Any = json.loads(text or "{}")
    except ValueError:
        given = None
    if not isinstance(given, dict) or not all(isinstance(new, str) for new in given.values()):
        raise Problem("request.mapping")
    return given


# The files come before the recording itself, and the longest ending first: "abc.csv" is no id.
@router.get(
    "/{recording}.fast.csv",
    summary="The 1 kHz samples of a recording's holds",
    responses={200: {"content": {FORMS["fast.csv"]: {}}}, **declared(404)},
    response_class=FileResponse,
)
async def download_fast(recording: str, here: Here) -> FileResponse:
    return await _file(here, recording, "fast.csv")


@router.get(
    "/{recording}.{form}",
    summary="A recording as a file: .csv or .parquet",
    responses={200: {"content": {FORMS["csv"]: {}, FORMS["parquet"]: {}}}, **declared(404)},
    response_class=FileResponse,
)
async def download(recording: str, form: Literal["csv", "parquet"], here: Here) -> FileResponse:
    return await _file(here, recording, form)


async def _file(here: Services, recording: str, form: str) -> FileResponse:
    row = here.store.recordings.row(recording)
    folder = tempfile.TemporaryDirectory(prefix="gyrobench-")
    try:
        file = Path(folder.name, f"{_safe(row['name'])}-{recording}.{form}")
        await here.compute.run(compute.export_recording, here.store.data, recording, form, file)
    except BaseException:
        folder.cleanup()
        raise
    gone = BackgroundTask(folder.cleanup)
    return FileResponse(file, media_type=FORMS[form], filename=file.name, background=gone)


def _safe(name: str) -> str:
    stem = name.split(".")[0]
    return "".join(letter if letter.isascii() and (letter.isalnum() or letter in "-_") else "-" for letter in stem)[:60]


@router.get("/{recording}", summary="What is known of a recording", responses=declared(404))
def recording(recording: str, here: Here) -> models.RecordingAnswer:
    return models.RecordingAnswer(**here.store.recordings.row(recording))
