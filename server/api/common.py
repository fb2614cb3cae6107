"""What every route needs: the services of this server, the language asked for, the parameters of a list."""

import time
from typing import Annotated

from fastapi import Depends, Query
from starlette.requests import HTTPConnection

from server import texts
from server.batch import BatchProcess
from server.compute import Compute
from server.lease import Lease
from server.searches import Searches
from server.settings import Settings
from server.store import Store
from server.store_db import CURSOR_PATTERN
from server.supervisor import Supervisor


class Services:
    """One server's parts; opens the store, and starts nothing before `start`."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.started = time.monotonic()
        self.store = Store(settings.data)
        self.lease = Lease()
        self.compute = Compute()
        self.searches = Searches()
        self.bench = Compute()  # students' runs, a moment each, do not wait for a long diagnosis
        self.supervisor = Supervisor(settings, self.store)
        self.batches = BatchProcess(self.store)

    def start(self) -> None:
        self.store.runs.interrupt_open()
        self.supervisor.start()
        self.batches.resume()

    def close(self) -> None:
        self.batches.stop()  # takes a second or two, beside the next
        self.supervisor.close()
        self.batches.close()
        self.compute.close()
        self.searches.close()
        self.bench.close()
        self.store.close()


def _services(connection: HTTPConnection) -> Services:
    services: Services = connection.app.state.services
    return services


def _language(connection: HTTPConnection) -> str:
    return texts.negotiate(connection.headers.get("accept-language"))


Here = Annotated[Services, Depends(_services)]
Language = Annotated[str, Depends(_language)]
Limit = Annotated[int, Query(ge=1, le=200, description="at most so many")]
Cursor = Annotated[
    str | None, Query(description="`next` of the page before", json_schema_extra={"pattern": CURSOR_PATTERN})
]
Search = Annotated[str, Query(max_length=100, description="what to look for")]
