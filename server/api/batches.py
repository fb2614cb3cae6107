"""Batches: many recordings certified together, from files or one zip."""

import json
import shutil
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Query, Request
from fastapi.responses import JSONResponse, Response, StreamingResponse
from starlette.concurrency import run_in_threadpool

from calib_core.problem import Problem
from server import compute, texts
from server.api import models
from server.api.common import Cursor, Here, Language, Limit, Services
from server.problems import declared
from server.store_batches import new_id

router = APIRouter(prefix="/batches", tags=["batches"])
PIECE = 1 << 20
BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "properties": {
                        "files": {"type": "array", "items": {"type": "string", "format": "binary"}},
                        "archive": {"type": "string", "format": "binary", "description": "one zip instead of files"},
                        "spec": {"type": "string", "description": "limits, as JSON"},
                        "gyro_model": {"type": "string", "description": "id; else what each recording says"},
                        "name": {"type": "string"},
                    },
                }
            }
        },
    }
}
Key = Annotated[str | None, Header(max_length=200, description="makes a repeated request harmless")]
FileStatus = Literal["waiting", "done", "failed", "cancelled"]


class Batch(models.Plain):
    id: str
    name: str
    status: Literal["queued", "running", "finished", "cancelled"]
    message: models.Message | None
    files: int
    waiting: int
    done: int
    failed: int
    cancelled: int
    verdicts: dict[str, int]
    seconds_left: float | None
    gyro_model: dict[str, Any] | None
    spec: dict[str, Any] | None
    created_at: str
    began_at: str | None
    finished_at: str | None


class Batches(models.Plain):
    items: list[Batch]
    next: str | None


class BatchFile(models.Plain):
    position: int
    name: str
    size: int
    status: FileStatus
    change: int
    board: str | None
    certificate: str | None
    verdict: Literal["pass", "fail", "issued", "error"] | None
    error: models.Message | None
    axes: dict[str, Any] | None
    warnings: list[dict[str, Any]] | None
    cpu_s: float | None
    finished_at: str | None


class BatchFiles(models.Plain):
    items: list[BatchFile]
    next: str | None


@router.post(
    "",
    status_code=201,
    summary="Certify many recordings: files, or one zip of them",
    openapi_extra=BODY,
    responses={
        200: {"model": Batch, "description": "the batch that this Idempotency-Key made before"},
        **declared(400, 404, 409, 413),
    },
    response_model=Batch,
)
async def create(
    request: Request,
    here: Here,
    lang: Language,
    idempotency_key: Annotated[
        str | None, Header(max_length=200, description="makes a repeated request harmless")
    ] = None,
) -> Response:
    from server.batch_intake import Intake

    batch = new_id()
    folder = here.store.data / "batches" / batch
    intake = Intake(folder, request.headers.get("content-type", ""))
    folder.mkdir(parents=True)
    kept = False
    try:
        waiting = bytearray()
        async for piece in request.stream():
            waiting += piece
            if len(waiting) >= PIECE:
                await run_in_threadpool(intake.feed, bytes(waiting))
                waiting.clear()
        await run_in_threadpool(intake.feed, bytes(waiting))
        await run_in_threadpool(intake.finish)
        known, kept = await run_in_threadpool(_keep, here, batch, intake, idempotency_key)
    finally:
        intake.close()
        if not kept:
            await run_in_threadpool(shutil.rmtree, folder, ignore_errors=True)
    here.batches.wake()
    shown = _shown(here.store.batches.get(known), lang)
    return JSONResponse(shown.model_dump(mode="json"), 201 if kept else 200)


def _keep(here: Services, batch: str, intake: Any, key: str | None) -> tuple[str, bool]:
    from calib_core.certificate import limits

    spec, model = intake.fields.get("spec"), intake.fields.get("gyro_model")
    try:
        limited = json.loads(spec) if spec else None
    except ValueError:
        raise Problem("request.not_json", field="spec", given="") from None
    if limited is not None:
        limits(limited)
    found = here.store.gyro_models.get(model) if model else None
    return here.store.batches.create(
        batch,
        intake.files,
        name=intake.fields.get("name", "")[:200] or intake.files[0]["name"],
        fingerprint=intake.fingerprint,
        key=key or None,
        gyro_model=None if found is None else found.to_json(),
        spec=limited,
    )


@router.get("", summary="Batches, newest first")
def batches(here: Here, lang: Language, limit: Limit = 50, cursor: Cursor = None) -> Batches:
    items, following = here.store.batches.find(limit=limit, cursor=cursor)
    return Batches(items=[_shown(row, lang) for row in items], next=following)


# The endings come before the batch itself: "abc/results.zip" is no id.
@router.get(
    "/{batch}/results.csv",
    summary="One line a file, with every certified number",
    responses={200: {"content": {"text/csv; charset=utf-8": {}}}, **declared(404)},
    response_class=Response,
)
def results_csv(batch: str, here: Here, lang: Language) -> Response:
    from server import batch_results

    here.store.batches.get(batch)
    table = batch_results.table(batch_results.rows(here.store, batch), lang)
    return Response(table, media_type="text/csv; charset=utf-8", headers=_named(f"batch-{batch}.csv"))


@router.get(
    "/{batch}/results.zip",
    summary="results.csv and the documents of every certificate",
    responses={200: {"content": {"application/zip": {}}}, **declared(404)},
    response_class=Response,
)
async def results_zip(
    batch: str, here: Here, accepted: Language, lang: Literal["en", "th"] | None = None
) -> StreamingResponse:
    from server import batch_results

    here.store.batches.get(batch)
    files = await run_in_threadpool(lambda: list(batch_results.rows(here.store, batch)))

    async def documents(numbers: list[str]) -> Any:
        return await here.compute.run(compute.documents, here.store.data, numbers, lang or accepted)

    stream: AsyncIterator[bytes] = batch_results.archive(files, lang or accepted, documents)
    return StreamingResponse(stream, media_type="application/zip", headers=_named(f"batch-{batch}.zip"))


@router.get(
    "/{batch}/files",
    summary="Files in the order in which they last changed: ask again with the last `change` as cursor",
    responses=declared(404),
)
def files(
    batch: str,
    here: Here,
    lang: Language,
    status: Annotated[FileStatus | None, Query()] = None,
    limit: Limit = 200,
    cursor: Cursor = None,
) -> BatchFiles:
    here.store.batches.get(batch)
    rows, following = here.store.batches.files(batch, status=status or "", limit=limit, cursor=cursor)
    return BatchFiles(items=[_file(row, lang) for row in rows], next=following)


@router.post("/{batch}/retry", summary="Try failed and cancelled files again", responses=declared(404, 409))
def retry(batch: str, here: Here, lang: Language) -> Batch:
    row = here.store.batches.retry(batch)
    here.batches.wake()
    return _shown(row, lang)


@router.post("/{batch}/cancel", summary="Leave what still waits", responses=declared(404))
def cancel(batch: str, here: Here, lang: Language) -> Batch:
    return _shown(here.store.batches.cancel(batch), lang)


@router.get("/{batch}", summary="One batch and how far it is", responses=declared(404))
def one(batch: str, here: Here, lang: Language) -> Batch:
    return _shown(here.store.batches.get(batch), lang)


def _shown(row: dict[str, Any], lang: str) -> Batch:
    return Batch(**{**row, "message": _message(row["message"], lang), "seconds_left": _left(row)})


def _left(row: dict[str, Any]) -> float | None:
    """At the pace since it was begun, or begun again; None before the first file is done."""
    if row["status"] != "running" or not row["since_began"]:
        return 0.0 if not row["waiting"] else None
    taken = (datetime.now(UTC) - datetime.fromisoformat(row["began_at"])).total_seconds()
    return round(float(taken / row["since_began"] * row["waiting"]), 1)


def _file(row: dict[str, Any], lang: str) -> BatchFile:
    from server.batch_results import reason

    error = row["error"]
    told = None if error is None else models.Message(**error, sentence=reason(row, lang))
    return BatchFile(**{**row, "error": told})


def _message(message: dict[str, Any] | None, lang: str) -> models.Message | None:
    if message is None:
        return None
    return models.Message(**message, sentence=texts.render(f"error.{message['code']}", message["values"], lang))


def _named(name: str) -> dict[str, str]:
    return {"Content-Disposition": f'attachment; filename="{name}"'}
