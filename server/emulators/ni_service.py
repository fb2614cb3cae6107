"""NI gRPC Device Server's NiDAQmx service, as far as a reader of voltages calls it: the RPCs of HARDWARE on the wire.

Only the listed calls exist; any other is answered with UNIMPLEMENTED, as an older server would. An error of the driver
goes out as it does there: status UNKNOWN with its code in the trailing metadata `ni-error`, but a read that ran out of
time as status OK with a part of the samples.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from server.emulators.ni_driver import NO_ATTRIBUTE, TIMEOUT, DaqmxError, Device

DRIVER_VERSION = {0x1272: 24, 0x1923: 8, 0x2F22: 0}
TASK_NAME, TASK_CHANNELS, TASK_DEVICES = 0x1276, 0x1273, 0x230E
AVAILABLE, CHANNELS = 0x1223, 0x217B
PRODUCT_TYPE, DEVICES = 0x0631, 0x193B
INITIALIZE, ATTACH = 1, 2
Call = Callable[[Any], Any]


def serve(device: Device, address: str = "127.0.0.1:0") -> tuple[Any, int]:
    """A running gRPC server in front of the device, and its port."""
    import grpc

    server = grpc.server(ThreadPoolExecutor(8, thread_name_prefix="ni"))
    server.add_generic_rpc_handlers([_handlers(device)])
    port = server.add_insecure_port(address)
    server.start()
    return server, port


def _handlers(device: Device) -> Any:
    import grpc
    from nidaqmx._stubs import nidaqmx_pb2 as wire

    def on_the_wire(call: Call) -> Callable[[Any, Any], Any]:
        def answer(request: Any, context: Any) -> Any:
            try:
                return call(request)
            except DaqmxError as error:
                read = [("ni-samps-per-chan-read", str(error.read))] if error.read is not None else []
                context.set_trailing_metadata([("ni-error", str(error.code)), *read])
                context.abort(grpc.StatusCode.UNKNOWN, str(error))
            except LookupError as error:
                context.abort(grpc.StatusCode.FAILED_PRECONDITION, str(error))

        return answer

    return grpc.method_handlers_generic_handler(
        "nidaqmx_grpc.NiDAQmx",
        {
            name: grpc.unary_unary_rpc_method_handler(
                on_the_wire(call),
                request_deserializer=getattr(wire, f"{name}Request").FromString,
                response_serializer=getattr(wire, f"{name}Response").SerializeToString,
            )
            for name, call in _calls(device, wire).items()
        },
    )


def _calls(device: Device, wire: Any) -> dict[str, Call]:
    """What is done for each RPC, by its name."""

    def one_of(known: Mapping[int, Any], request: Any) -> Any:
        if request.attribute_raw not in known:
            raise DaqmxError(NO_ATTRIBUTE)
        return known[request.attribute_raw]

    def create_task(request: Any) -> Any:
        name, behaviour = request.session_name, request.initialization_behavior
        known = bool(name) and name in device.tasks
        if known and behaviour == INITIALIZE:
            raise LookupError("The specified session name is already in use.")
        if not known and behaviour == ATTACH:
            raise LookupError("The specified session was not found.")
        task = device.tasks[name] if known else device.create(name)
        return wire.CreateTaskResponse(task={"name": task.name}, new_session_initialized=not known)

    def add_channel(request: Any) -> Any:
        device.add_voltage_channel(
            device.task(request.task.name),
            request.physical_channel,
            request.terminal_config_raw,
            request.min_val,
            request.max_val,
        )
        return wire.CreateAIVoltageChanResponse()

    def time_by_clock(request: Any) -> Any:
        device.time_by_clock(device.task(request.task.name), request.rate, request.samps_per_chan)
        return wire.CfgSampClkTimingResponse()

    def read(request: Any) -> Any:
        asked = request.num_samps_per_chan
        volts, got = device.read(device.task(request.task.name), asked, request.timeout)
        status = 0 if got == asked else TIMEOUT
        return wire.ReadAnalogF64Response(status=status, read_array=volts.ravel(), samps_per_chan_read=got)

    def task_text(request: Any) -> Any:
        task = device.task(request.task.name)
        said = {
            TASK_NAME: task.name,
            TASK_CHANNELS: ", ".join(f"{device.name}/ai{number}" for number, _ in task.inputs),
            TASK_DEVICES: device.name,
        }
        return wire.GetTaskAttributeStringResponse(value=one_of(said, request))

    def doing(what: Callable[[Any], None], response: Any) -> Call:
        def call(request: Any) -> Any:
            what(device.task(request.task.name))
            return response()

        return call

    return {
        "GetSystemInfoAttributeUInt32": lambda request: wire.GetSystemInfoAttributeUInt32Response(
            value=one_of(DRIVER_VERSION, request)
        ),
        "GetSystemInfoAttributeString": lambda request: wire.GetSystemInfoAttributeStringResponse(
            value=one_of({DEVICES: device.name}, request)
        ),
        "CreateTask": create_task,
        "GetTaskAttributeString": task_text,
        "GetDeviceAttributeString": lambda request: wire.GetDeviceAttributeStringResponse(
            value=one_of({PRODUCT_TYPE: device.product}, request)
        ),
        "CreateAIVoltageChan": add_channel,
        "CfgSampClkTiming": time_by_clock,
        "StartTask": doing(device.start, wire.StartTaskResponse),
        "GetReadAttributeUInt32": lambda request: wire.GetReadAttributeUInt32Response(
            value=one_of({AVAILABLE: device.available, CHANNELS: lambda task: len(task.inputs)}, request)(
                device.task(request.task.name)
            )
        ),
        "SetReadAttributeInt32": lambda _: wire.SetReadAttributeInt32Response(),  # how a read waits
        "SetReadAttributeDouble": lambda _: wire.SetReadAttributeDoubleResponse(),
        "ReadAnalogF64": read,
        "StopTask": doing(device.stop, wire.StopTaskResponse),
        "ClearTask": doing(device.clear, wire.ClearTaskResponse),
    }
