"""HTTP under /api/v1: one router a noun."""

from server.api import (
    boards,
    certificates,
    diagnoses,
    experiments,
    gyro_models,
    health,
    lab,
    live,
    notebooks,
    recordings,
    rig,
    runs,
    thesis,
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
    experiments.router,
    notebooks.router,
    lab.router,
    certificates.router,
    thesis.router,
)
