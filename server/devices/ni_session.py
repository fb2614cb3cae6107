"""A DAQmx task: with NI's driver on this computer, or through NI gRPC Device Server on another one.

The server keeps a task until it is cleared, whatever became of its client, holding the device; and it hands a task to
whoever names it, samples and all. So a task has one of a few known names: what is left over under any of them is
cleared, and the new task takes the next name, so that a client which was cleared away gets an error, not our samples.
Every call has a deadline: the library sets none, and a cable pulled between the two computers answers nothing.
"""

from contextlib import suppress
from typing import Any, NamedTuple

CALL_S = 3.0
NAMES = 4
UNREACHABLE = ("UNAVAILABLE", "DEADLINE_EXCEEDED")


class Session:
    """The task and the channel it came through. `close` leaves nothing behind, as far as the server can be reached."""

    def __init__(self, device: str, server: str) -> None:
        """Raises `nidaqmx.errors.Error`."""
        from nidaqmx.errors import Error

        self._channel = _channel(server) if server else None
        try:
            self.task = _task("", None) if self._channel is None else self._new(device)
        except Error:
            self._leave()
            raise

    def _new(self, device: str) -> Any:
        from nidaqmx.grpc_session_options import SessionInitializationBehavior as Behaviour

        free = 0
        for number in range(NAMES):
            if self._clear(f"gyrobench {device} {number}"):
                free = (number + 1) % NAMES
        return self._named(f"gyrobench {device} {free}", Behaviour.INITIALIZE_SERVER_SESSION)

    def _clear(self, name: str) -> bool:
        """Clear a task that was left over on the server; whether there was one."""
        from nidaqmx.errors import Error
        from nidaqmx.grpc_session_options import SessionInitializationBehavior as Behaviour

        try:
            self._named(name, Behaviour.ATTACH_TO_SERVER_SESSION).close()
        except Error as error:
            if unreachable(error):
                raise
            return False
        return True

    def _named(self, name: str, behaviour: Any) -> Any:
        from nidaqmx.grpc_session_options import GrpcSessionOptions

        return _task(name, GrpcSessionOptions(self._channel, name, initialization_behavior=behaviour))

    def close(self, *, answering: bool = True) -> None:
        """Clear the task, unless the server does not answer any more, and leave."""
        from nidaqmx.errors import Error

        if answering:
            with suppress(Error):
                self.task.close()
        self._leave()

    def _leave(self) -> None:
        if self._channel is not None:
            self._channel.close()


def devices(server: str) -> tuple[str, dict[str, str]]:
    """The driver's version, and every device it knows with its product. Raises `nidaqmx.errors.Error`."""
    from nidaqmx.grpc_session_options import GrpcSessionOptions
    from nidaqmx.system import System

    channel = _channel(server) if server else None
    try:
        system = System.local() if channel is None else System.remote(GrpcSessionOptions(channel, ""))
        found = {device.name: device.product_type for device in system.devices}
        return ".".join(str(part) for part in system.driver_version), found
    finally:
        if channel is not None:
            channel.close()


def unreachable(error: Exception) -> bool:
    """Whether this error says that the server is gone or silent."""
    return getattr(getattr(error, "rpc_code", None), "name", "") in UNREACHABLE


def _task(name: str, options: Any) -> Any:
    from nidaqmx import Task

    return Task(name, grpc_options=options)


def _channel(server: str) -> Any:
    """A gRPC channel of its own: no proxy, no connection shared with one that failed and now waits to try again."""
    import grpc

    class Call(NamedTuple):
        method: str
        timeout: float
        metadata: Any
        credentials: Any
        wait_for_ready: Any
        compression: Any

    class Deadline(grpc.UnaryUnaryClientInterceptor):  # type: ignore[misc]
        def intercept_unary_unary(self, proceed: Any, call: Any, request: Any) -> Any:
            details = Call(call.method, CALL_S, call.metadata, call.credentials, call.wait_for_ready, call.compression)
            return proceed(details, request)

    options = [("grpc.enable_http_proxy", 0), ("grpc.use_local_subchannel_pool", 1)]
    return grpc.intercept_channel(grpc.insecure_channel(server, options=options), Deadline())
