"""One Dynamixel bus (Protocol 1.0) through dynamixel-sdk, with every trap of HARDWARE closed. For one thread only.

A reading is data only if the comm result is success, the packet is of the asked servo and length, and it came in time
to be stamped. After a reply that did not come, what may still come is drained, and the servo is asked for another
number of bytes than any reply still on its way has. Replies keep their order, so once that question has its answer,
no older one is left.
"""

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from server.devices import DeviceError
from server.devices.dynamixel_registers import Alarm, Register

try:
    from termios import error as TerminalError
except ImportError:  # Windows has none
    TerminalError = OSError  # type: ignore[misc,assignment]

log = logging.getLogger(__name__)

POLL_S = 0.002  # a read of the port waits this long for bytes: the SDK asks again at once, and would spin
SPARE_MS = 10.0  # a reply may be this much later than wire and adapter explain: hosts are busy, too
STAMP_S = 0.003  # a transaction that took this much longer than it has to has no usable time in its middle
DRAIN_S = 0.05
BABBLE = 512  # bytes without a packet among them
WRITE_S = 0.5
USUAL_LATENCY_MS = 16.0
FRAME_BYTES = 14  # of a read's request and reply beside the data
PROBES = 5  # the question that finds the end of old replies asks for 1 to 5 bytes; no other read is so short
SUCCESS, SILENCE = 0, -3001


class NoReply(Exception):
    """No usable reply this time. `why`: silent, garbled, or unstamped (good, but too late for its time to be known)."""

    def __init__(self, why: str) -> None:
        super().__init__(why)
        self.why = why


class Babble(Exception):
    """Bytes go on and on without making a packet."""


@dataclass(frozen=True)
class Reply:
    """Registers, and when by the host's clock: the middle of the transaction."""

    data: bytes
    time_s: float


def latency_ms(port: str) -> float | None:
    """The adapter's latency timer, where the system tells it (Linux): it holds every reply back that long."""
    name = Path(port).resolve().name
    try:
        return float(Path(f"/sys/class/tty/{name}/device/latency_timer").read_text())
    except (OSError, ValueError):
        return None


def _port(name: str) -> Any:
    """The SDK's port, made not to spin, not to wait for ever, and not to share its line with another program."""
    from dynamixel_sdk import PortHandler

    class Port(PortHandler):  # type: ignore[misc]
        timer_ms = USUAL_LATENCY_MS
        heard = 0

        def setupPort(self, cflag_baud: int) -> bool:
            super().setupPort(cflag_baud)
            self.ser.timeout, self.ser.write_timeout, self.ser.exclusive = POLL_S, WRITE_S, True
            return True

        def getCurrentTime(self) -> float:
            return time.perf_counter() * 1e3  # the SDK's own jumps when somebody sets the clock

        def setPacketTimeout(self, packet_length: int) -> None:
            self.heard = 0
            self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + 2.0 * self.timer_ms + 2.0 + SPARE_MS)

        def readPort(self, length: int) -> Any:
            # The SDK looks at its clock only where bytes run out; noise need not.
            if self.heard > BABBLE:
                raise Babble
            data = super().readPort(length)
            self.heard += len(data)
            return data

    return Port(name)


class Bus:
    """The constructor sends nothing. `latency`: the adapter's latency timer in ms; None asks the system, else 16."""

    def __init__(self, port: str, baud: int, latency: float | None = None) -> None:
        self.port, self.baud = port, baud
        self._latency = latency
        self._handler: Any = None
        self._packets: Any = None
        self._settled: set[int] = set()
        self._probe = 0
        self._alarms: dict[int, Alarm] = {}
        self.timer_ms = USUAL_LATENCY_MS
        self.return_delay_s = 5e-4
        self.good = 0
        self.lost = {"silent": 0, "garbled": 0, "unstamped": 0}

    def open(self) -> None:
        """Raises DeviceError: the port is absent, not ours to use, another program's, or not for this speed."""
        from dynamixel_sdk import PacketHandler

        self.close()
        handler = _port(self.port)
        try:
            known = handler.setBaudRate(self.baud)
            with suppress(AttributeError, OSError, ValueError):  # what is no FTDI adapter on Linux cannot
                handler.ser.set_low_latency_mode(True)
        except (OSError, TerminalError, ValueError) as error:
            raise _refused(self.port, error) from error
        if not known:
            raise DeviceError("rig.baud", baud=self.baud)
        timers = (self._latency, latency_ms(self.port), USUAL_LATENCY_MS)
        self.timer_ms = handler.timer_ms = next(timer for timer in timers if timer is not None)
        self._handler, self._packets = handler, PacketHandler(1.0)
        self._settled.clear()

    def close(self) -> None:
        handler, self._handler = self._handler, None
        if handler is not None:
            with suppress(OSError, TerminalError):  # it may have gone away before
                handler.closePort()

    @property
    def is_open(self) -> bool:
        return self._handler is not None

    def read(self, servo: int, address: int, length: int) -> Reply:
        """Registers with their time, in one transaction.

        Raises NoReply for whatever is not this servo's answer to this question; DeviceError once the port is gone.
        """
        self._settle(servo)
        began = time.perf_counter()
        data = self._ask(servo, address, length)
        ended = time.perf_counter()
        needed = (length + FRAME_BYTES) * 10.0 / self.baud + self.return_delay_s + self.timer_ms * 1e-3
        if ended - began > needed + STAMP_S:
            self.lost["unstamped"] += 1
            raise NoReply("unstamped")
        self.good += 1
        return Reply(data, 0.5 * (began + ended))

    def registers(self, servo: int, address: int, length: int, *, tries: int = 20) -> bytes:
        """Registers whose time does not matter, asked for until they come; raises NoReply after the last try."""
        for left in reversed(range(tries)):
            try:
                self._settle(servo)
                return self._ask(servo, address, length)
            except NoReply:
                if not left:
                    raise
        raise ValueError("no tries")

    def alarms(self, servo: int) -> Alarm:
        """What this servo complained of since the last call, in whatever reply."""
        return self._alarms.pop(servo, Alarm(0))

    def ping(self, servo: int) -> bool:
        """Whether this servo is there at all: a ping is answered even by one that is set to answer nothing else."""
        with self._line() as handler:
            _, result, _ = self._packets.txRxPacket(handler, [0xFF, 0xFF, servo, 2, 1, 0])
        return bool(result == SUCCESS)

    def write(self, address: int, values: Mapping[int, bytes]) -> None:
        """The same registers of several servos at once. Nothing answers: read back what matters."""
        from dynamixel_sdk import GroupSyncWrite

        with self._line() as handler:
            group = GroupSyncWrite(handler, self._packets, address, len(next(iter(values.values()))))
            for servo, data in values.items():
                group.addParam(servo, list(data))
            if group.txPacket() != SUCCESS:
                raise OSError("the port does not take what is sent")

    # --- one question ------------------------------------------------------------------------------------------
    def _ask(self, servo: int, address: int, length: int) -> bytes:
        packet: list[int] = []
        with self._line() as handler:
            result = self._packets.readTx(handler, servo, address, length)
            while result == SUCCESS:
                packet, result = self._packets.rxPacket(handler)
                if result != SUCCESS or packet[2] == servo:
                    break
        if result != SUCCESS:
            raise self._lose(servo, "silent" if result == SILENCE else "garbled")
        if packet[3] != length + 2 or len(packet) != length + 6:
            raise self._lose(servo)  # another question's answer: ours is still to come
        alarm = Alarm(packet[4])
        if alarm & (Alarm.CHECKSUM | Alarm.INSTRUCTION | Alarm.RANGE):
            raise self._lose(servo)  # the question did not reach it whole
        self._alarms[servo] = self._alarms.get(servo, Alarm(0)) | alarm
        return bytes(packet[5:-1])

    def _settle(self, servo: int) -> None:
        """After a failure, and at first: make sure that no old reply of this servo is still to come."""
        if servo in self._settled:
            return
        with self._line() as handler:
            handler.ser.timeout = (self.timer_ms + SPARE_MS / 2.0) * 1e-3
            until = time.perf_counter() + DRAIN_S
            while handler.ser.read(256) and time.perf_counter() < until:
                pass
            handler.ser.timeout = POLL_S
        self._probe = self._probe % PROBES + 1
        if self._ask(servo, Register.ID, self._probe)[0] != servo:
            raise self._lose(servo)
        self._settled.add(servo)

    def _lose(self, servo: int, why: str = "garbled") -> NoReply:
        self._settled.discard(servo)
        self.lost[why] += 1
        return NoReply(why)

    @contextmanager
    def _line(self) -> Iterator[Any]:
        """The SDK's port, free again afterwards, with what it raises turned into ours."""
        handler = self._handler
        if handler is None:
            raise DeviceError("rig.port_gone", port=self.port)
        try:
            yield handler
        except Babble as error:
            self._settled.clear()
            self.lost["garbled"] += 1
            raise NoReply("garbled") from error
        except (OSError, TerminalError) as error:
            # The SDK would say "busy" from now on: drop everything of this port.
            log.warning("%s is gone: %s", self.port, error)
            self.close()
            raise DeviceError("rig.port_gone", port=self.port) from error
        finally:
            handler.is_using = False


def _refused(port: str, error: Exception) -> DeviceError:
    from server.devices.address import ports

    if not Path(port).exists() and port not in ports():
        return DeviceError("rig.port_absent", port=port, ports=", ".join(ports()) or "–")
    if isinstance(error, PermissionError) or getattr(error, "errno", None) == 13:
        return DeviceError("rig.port_denied", port=port)
    return DeviceError("rig.port_taken", port=port, reason=str(error))
