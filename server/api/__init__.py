"""HTTP under /api/v1: one router a noun."""

import sys

# FastAPI looks, at every route, whether a model is one of pydantic 1's, and takes "not installed" for a no. None here
# is; importing that package would be a tenth of the server's start-up.
sys.modules.setdefault("pydantic.v1", None)  # type: ignore[arg-type]

from server.api import (  # noqa: E402
    batches,
    boards,
    certificates,
    diagnoses,
    effects,
    experiments,
    gyro_models,
    health,
    lab,
    live,
    notebooks,
    recordings,
    rig,
    runs,
    saved_models,
    thesis,
    workbench,
)

ROUTERS = (
    health.router,
    rig.router,
    boards.router,
    gyro_models.router,
    runs.router,
    live.router,
    recordings.router,
    diagnoses.router,
    workbench.router,
    effects.router,
    saved_models.router,
    experiments.router,
    notebooks.router,
    lab.router,
    certificates.router,
    batches.router,
    thesis.router,
)
