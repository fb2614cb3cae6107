"""HTTP under /api/v1: one router a noun."""

from server.api import health

ROUTERS = (health.router,)
