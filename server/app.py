"""The web application: routes under /api/v1, problem documents, and the pages as files."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.openapi.utils import get_openapi
from fastapi.responses import FileResponse, HTMLResponse, Response
from starlette.middleware.gzip import GZipMiddleware
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from calib_core.problem import Problem
from server import __version__, problems
from server.api import ROUTERS, common
from server.auth import Guard
from server.settings import Settings
from server.texts import WEB

POLICY = "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; frame-ancestors 'none'"


class Pages(StaticFiles):
    """Files of web/, asked for again each time so that an upgrade reaches every browser."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers.update({"Cache-Control": "no-cache", "Content-Security-Policy": POLICY})
        return response


def packaged(package: str, *inside: str) -> Path:
    """A file of an installed package, without importing the package."""
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise FileNotFoundError(package)
    return Path(spec.submodule_search_locations[0]).joinpath(*inside)


def vendored() -> dict[str, Path]:
    return {
        "uplot.iife.min.js": packaged("youplot", "vendor", "uplot.iife.min.js"),
        "uplot.min.css": packaged("youplot", "vendor", "uplot.min.css"),
        "sarabun.ttf": packaged("fontpkg_sarabun", "files", "Sarabun-Regular.ttf"),
    }


def create_app(settings: Settings) -> FastAPI:
    services = common.Services(settings)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        services.start()
        try:
            yield
        finally:
            services.close()

    app = FastAPI(
        title="Gyrobench",
        version=__version__,
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
    )
    app.state.services = services
    problems.install(app)
    app.add_middleware(Guard, token=settings.token)
    for router in ROUTERS:
        app.include_router(router, prefix="/api/v1")
    files = vendored()

    def vendor(request: Request) -> FileResponse:
        name = request.path_params["name"]
        if name not in files:
            raise Problem("request.not_found", path=request.url.path)
        return FileResponse(files[name], headers={"Cache-Control": "max-age=86400"})

    def described(_: Request) -> HTMLResponse:
        from server.api import docs

        return HTMLResponse(docs.page(app.openapi()))

    app.add_route("/vendor/{name}", vendor)
    app.add_route("/docs", described, include_in_schema=False)

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = get_openapi(title=app.title, version=app.version, routes=app.routes)
            app.openapi_schema = problems.complete(schema)
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]
    # Thai takes three bytes a letter; of the texts a fifth is left.
    app.mount("/", GZipMiddleware(Pages(directory=WEB, html=True), minimum_size=1000, compresslevel=6))
    return app
