"""What every route needs: the services of this server and the language asked for."""

import time
from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from server import auth, texts
from server.settings import Settings


class Services:
    """One server's parts; nothing runs before `start`."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.started = time.monotonic()

    def start(self) -> None: ...

    def close(self) -> None: ...

    def check_write(self, connection: HTTPConnection) -> None:
        auth.check_write(connection, self.settings.token)


def _services(connection: HTTPConnection) -> Services:
    services: Services = connection.app.state.services
    return services


def _language(connection: HTTPConnection) -> str:
    return texts.negotiate(connection.headers.get("accept-language"))


Here = Annotated[Services, Depends(_services)]
Language = Annotated[str, Depends(_language)]
