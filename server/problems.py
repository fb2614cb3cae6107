"""Every refusal as an RFC 9457 problem document, in the language that was asked for."""

import errno
import json
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from calib_core.problem import Problem
from server import texts
from server.devices import DeviceError

MEDIA_TYPE = "application/problem+json"

# Refusals that are not 422, "understood, and cannot be done".
STATUS = {
    "auth.token_needed": 401,
    "auth.foreign_origin": 403,
    "rig.leased": 409,
    "run.busy": 409,
    "run.not_running": 409,
    "rig.busy": 409,
    "experiment.needs_data": 409,
    "experiment.nothing_open": 409,
    "experiment.nothing_shows": 409,
    "notebook.full": 409,
    "lab.key": 403,
    "lab.name_taken": 409,
    "lab.full": 409,
    "lab.revealed": 409,
    "lab.too_many_runs": 409,
    "lab.other_session": 409,
    "lab.bench_failed": 409,
    "board.exists": 409,
    "effect.exists": 409,
    "effect.too_many": 409,
    "effect.of_library": 409,
    "gyro_model.exists": 409,
    "gyro_model.preset": 409,
    "gyro_model.in_use": 409,
    "batch.key_used": 409,
    "batch.nothing_to_retry": 409,
    "batch.not_multipart": 400,
    "batch.too_many": 413,
    "batch.expands": 413,
    "request.too_large": 413,
    "recording.too_large": 413,
    "server.fault": 500,
    "rig.stop_not_confirmed": 503,
    "worker.not_ready": 503,
    "worker.no_answer": 503,
    "store.locked": 503,
    "store.full": 507,
}
# Pydantic's complaint -> our text under error.request, and what of its context fills it.
FIELD_TEXTS = {
    "missing": "missing",
    "extra_forbidden": "unknown_field",
    "string_too_long": "too_long",
    "string_too_short": "too_short",
    "too_long": "too_many",
    "greater_than": "not_above",
    "greater_than_equal": "too_small",
    "less_than": "not_below",
    "less_than_equal": "too_large_number",
    "string_pattern_mismatch": "characters",
    "literal_error": "choice",
    "enum": "choice",
    "json_invalid": "not_json",
    "finite_number": "not_finite",
}
TYPE_TEXTS = {"int": "not_whole", "float": "not_number", "bool": "not_boolean", "string": "not_text"}


def status_of(problem: Problem) -> int:
    if problem.code.endswith(".not_found"):
        return 404
    return STATUS.get(problem.code, 502 if isinstance(problem, DeviceError) else 422)


def document(problem: Problem, lang: str, instance: str, status: int | None = None) -> dict[str, Any]:
    status = status or status_of(problem)
    return {
        "type": f"urn:gyrobench:problem:{problem.code}",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": texts.sentence(problem, lang),
        "code": problem.code,
        "values": plain(problem.values),
        "instance": instance,
    }


def plain(values: Mapping[str, object]) -> dict[str, Any]:
    """Values as JSON has them; what JSON has no word for goes as text."""
    return dict(json.loads(json.dumps(values, default=str), parse_constant=str))


def answer(request: Request, problem: Problem, status: int | None = None, **headers: str) -> JSONResponse:
    lang = texts.negotiate(request.headers.get("accept-language"))
    body = document(problem, lang, request.url.path, status)
    headers["content-language"] = lang
    return JSONResponse(body, body["status"], headers, MEDIA_TYPE)


def refused_field(error: Mapping[str, Any]) -> Problem:
    """Pydantic's first complaint in our own words."""
    kind, context = error["type"], error.get("ctx", {})
    location = [str(part) for part in error["loc"]]
    field = ".".join(location[1:]) or location[0]
    if kind == "value_error" and isinstance(cause := context.get("error"), Problem):
        return cause
    text = FIELD_TEXTS.get(kind) or TYPE_TEXTS.get(kind.split("_")[0], "unacceptable")
    values = {name: value for name, value in context.items() if isinstance(value, str | int | float)}
    given = error.get("input")
    return Problem(
        f"request.{text}", **{**values, "field": field, "given": given if isinstance(given, str | int | float) else ""}
    )


def install(app: FastAPI) -> None:
    @app.exception_handler(Problem)
    async def refused(request: Request, problem: Problem) -> JSONResponse:
        return answer(request, problem)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        return answer(request, refused_field(first), 400 if first["type"] == "json_invalid" else 422)

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> JSONResponse:
        codes = {404: "request.not_found", 405: "request.method_not_allowed", 413: "request.too_large"}
        problem = Problem(
            codes.get(error.status_code, "request.unacceptable_request"), method=request.method, path=request.url.path
        )
        return answer(request, problem, error.status_code, **(error.headers or {}))

    @app.exception_handler(OSError)
    async def system(request: Request, error: OSError) -> JSONResponse:
        if error.errno == errno.ENOSPC:
            return answer(request, Problem("store.full", path=str(error.filename or "")))
        raise error

    @app.exception_handler(Exception)
    async def fault(request: Request, error: Exception) -> JSONResponse:
        return answer(request, Problem("server.fault", kind=type(error).__name__))


# --- OpenAPI ---------------------------------------------------------------------------------------------------
SCHEMA = {
    "title": "Problem",
    "description": "RFC 9457 problem document; `detail` is a sentence in the language of Accept-Language.",
    "type": "object",
    "required": ["type", "title", "status", "detail", "code", "values", "instance"],
    "properties": {
        "type": {"type": "string"},
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "detail": {"type": "string"},
        "code": {"type": "string"},
        "values": {"type": "object"},
        "instance": {"type": "string"},
    },
}


def declared(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """`responses=` of a route: these statuses answer with a problem document."""
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {status: {"description": HTTPStatus(status).phrase, "content": content} for status in statuses}


def complete(schema: dict[str, Any]) -> dict[str, Any]:
    """OpenAPI as FastAPI wrote it, with the errors every route can answer and none of FastAPI's own."""
    schemas = schema.setdefault("components", {}).setdefault("schemas", {})
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    schemas["Problem"] = SCHEMA
    for operations in schema["paths"].values():
        for method, operation in operations.items():
            answers = operation["responses"]
            answers.pop("422", None)
            also = [500]
            if operation.get("parameters") or operation.get("requestBody"):
                also.append(422)
            if operation.get("requestBody"):
                also += [400, 413]
            if method != "get":
                also += [401, 403, 507]
            for status, answer in declared(*also).items():
                answers.setdefault(str(status), answer)
            operation["responses"] = dict(sorted(answers.items()))
    return schema
