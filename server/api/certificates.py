"""Certificates: issue, list, read, compute again."""

from typing import Literal

from fastapi import APIRouter
from fastapi.responses import Response

from server import compute
from server.api import models
from server.api.common import Cursor, Here, Language, Limit, Search
from server.problems import declared

router = APIRouter(prefix="/certificates", tags=["certificates"])
MEDIA = {"pdf": "application/pdf", "csv": "text/csv; charset=utf-8", "json": "application/json"}


@router.get("", summary="Certificates, newest first")
def certificates(
    here: Here, q: Search = "", board: Search = "", recording: Search = "", limit: Limit = 50, cursor: Cursor = None
) -> models.Certificates:
    items, following = here.store.certificates.find(q=q, board=board, recording=recording, limit=limit, cursor=cursor)
    return models.Certificates.model_validate({"items": items, "next": following})


@router.post("", status_code=201, summary="Certify a stored recording", responses=declared(404))
async def issue(body: models.CertificateBody, here: Here) -> models.Certificate:
    asked = (body.recording, body.model, body.spec, body.models)
    content = await here.compute.run(compute.certify, here.store.data, *asked)
    return models.Certificate.model_validate(content)


@router.get(
    "/{number}.{form}",
    summary="A certificate as a document: .pdf, .csv or .json",
    responses={200: {"content": {media: {} for media in MEDIA.values()}}, **declared(404)},
    response_class=Response,
)
async def document(
    number: str,
    form: Literal["pdf", "csv", "json"],
    here: Here,
    accepted: Language,
    lang: Literal["en", "th"] | None = None,
) -> Response:
    rendered = await here.compute.run(compute.document, here.store.data, number, form, lang or accepted)
    headers = {"Content-Disposition": f'attachment; filename="{number}.{form}"'}
    return Response(rendered, media_type=MEDIA[form], headers=headers)


@router.get("/{number}", summary="One certificate", responses=declared(404))
def certificate(number: str, here: Here) -> models.Certificate:
    return models.Certificate.model_validate(here.store.certificates.get(number))


@router.get("/{number}/verify", summary="Compute it again from its recording and compare", responses=declared(404))
async def verify(number: str, here: Here) -> models.Verified:
    return models.Verified.model_validate(await here.compute.run(compute.verify, here.store.data, number))
