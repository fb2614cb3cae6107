"""An RS-485 bus with two emulated servos behind a pseudo-terminal: real bytes at real wire speed, faults on demand.

The terminal has one name for good (a link), so that a port that went away can come back. As HARDWARE says: the slave's
descriptor stays open and raw, the wire's time is slept here, and the process is its own.
"""

import os
import random
import select
import tempfile
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from server.devices.dynamixel_registers import BAUDS, MODELS, Register
from server.emulators import process
from server.emulators.plant import PlantClient
from server.emulators.servo import Instruction, Servo

BROADCAST = 0xFE
KINDS = ("no_reply", "bad_checksum", "truncated", "short", "late", "overload", "wrong_id", "noise")
NOTED = 50_000
SPEEDS = {getattr(termios, f"B{baud}"): baud for baud in BAUDS.values() if hasattr(termios, f"B{baud}")}


def checksum(body: bytes) -> int:
    """Of everything after the two header bytes."""
    return ~sum(body) & 0xFF


def status(number: int, error: int, data: bytes) -> bytes:
    body = bytes([number, len(data) + 2, error]) + data
    return b"\xff\xff" + body + bytes([checksum(body)])


def take(buffer: bytearray) -> tuple[int, int, bytes, bool] | None:
    """The next instruction packet, taken out of `buffer`: id, instruction, parameters, checksum good."""
    while True:
        start = buffer.find(b"\xff\xff")
        if start < 0:
            del buffer[: max(0, len(buffer) - 1)]
            return None
        del buffer[:start]
        while buffer[2:3] == b"\xff":  # more than two header bytes
            del buffer[0]
        if len(buffer) < 4:
            return None
        length = buffer[3]
        if length < 2:
            del buffer[:2]
            continue
        if len(buffer) < length + 4:
            return None
        packet = bytes(buffer[: length + 4])
        del buffer[: length + 4]
        return packet[2], packet[4], packet[5:-1], checksum(packet[2:-1]) == packet[-1]


class Bus:
    """The wire, the adapter's latency timer, and the servos on it. Public methods are the control channel's."""

    def __init__(self, plant: PlantClient, *, baud: int, latency_s: float, seed: int) -> None:
        self._plant, self._latency_s, self._rng = plant, latency_s, random.Random(seed)
        self._lock = threading.Lock()
        self._folder = tempfile.TemporaryDirectory(prefix="gyrobench-emulated-")
        self.port = str(Path(self._folder.name) / "servos")
        number = {part: model for model, part in ((m.number, m.part) for m in MODELS.values())}
        self._servos: dict[int, Servo] = {}
        for i, (axis, part) in enumerate(plant.parts().items(), start=1):
            turn, let_go = partial(self._turn, axis), partial(plant.let_go, axis)
            servo = self._servos[i] = Servo(number[part], i, partial(plant.shaft, axis), turn, let_go)
            servo.table[Register.BAUD] = next(code for code, value in BAUDS.items() if value == baud)
            servo.table[Register.RETURN_DELAY] = 0
        self._faults: deque[tuple[str, int | None, float]] = deque()
        self._held = b""
        self._deaf = 0
        self._counts = dict.fromkeys(("instructions", "replies", "faults"), 0)
        self._written: deque[tuple[float, int, int, bytes]] = deque(maxlen=NOTED)
        self._together: dict[str, tuple[float, float]] | None = None
        self._wake_read, self._wake_write = os.pipe()
        self._master = self._slave = -1
        self.plug()

    # --- the control channel -----------------------------------------------------------------------------------
    def fault(self, kind: str, servo: int | None = None, count: int = 1, seconds: float = 0.08) -> None:
        """Spoil the next `count` replies (of one servo). `late` by 0 `seconds`: held back until the next request."""
        if kind not in KINDS:
            raise ValueError(f"{kind}: one of {', '.join(KINDS)}")
        with self._lock:
            self._faults.extend([(kind, servo, seconds)] * count)

    def pending(self) -> int:
        """Faults asked for and not yet met."""
        return len(self._faults)

    def deafen(self, count: int = 1) -> None:
        """The next `count` writes to several servos are lost on their way."""
        self._deaf = count

    def mend(self) -> None:
        with self._lock:
            self._deaf = 0
            self._faults.clear()
            self._held = b""

    def babble(self, count: int = 200) -> None:
        """Noise on the wire that nobody asked for."""
        self._send(self._noise(count))

    def unplug(self) -> None:
        """The adapter is pulled out: the port goes away under whoever has it open."""
        with self._lock:
            if self._master < 0:
                return
            Path(self.port).unlink()
            for fd in (self._master, self._slave):
                os.close(fd)
            self._master = self._slave = -1
        os.write(self._wake_write, b".")

    def plug(self) -> None:
        """The adapter is there (again)."""
        with self._lock:
            if self._master >= 0:
                return
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            Path(self.port).symlink_to(os.ttyname(self._slave))
        os.write(self._wake_write, b".")

    def poke(self, servo: int, address: int, *values: int) -> None:
        """Set registers as no instruction could: temperature, voltage, limits."""
        with self._lock:
            self._servos[servo].table[address : address + len(values)] = bytes(values)

    def peek(self, servo: int, address: int, length: int = 1) -> bytes:
        """Registers as they are now."""
        with self._lock:
            self._servos[servo]._look()
            return bytes(self._servos[servo].table[address : address + length])

    def silence(self, servo: int) -> None:
        """The servo leaves the bus: its cable is off."""
        with self._lock:
            self._servos[-servo] = self._servos.pop(servo)

    def rejoin(self, servo: int) -> None:
        with self._lock:
            self._servos[servo] = self._servos.pop(-servo)

    def counts(self) -> dict[str, int]:
        return dict(self._counts)

    def written(self) -> list[tuple[float, int, int, bytes]]:
        """(seconds, servo, address, values) of every write since the last call."""
        with self._lock:
            found = list(self._written)
            self._written.clear()
        return found

    # --- the wire ----------------------------------------------------------------------------------------------
    def run(self) -> None:
        buffer = bytearray()
        while True:
            master = self._master
            try:
                ready, _, _ = select.select([self._wake_read, *([master] if master >= 0 else [])], [], [])
                if self._wake_read in ready:
                    os.read(self._wake_read, 64)
                    buffer.clear()
                    continue
                buffer += os.read(master, 4096)
            except OSError:  # unplugged in between
                continue
            seen = time.perf_counter()
            while (packet := take(buffer)) is not None:
                seen = self._serve(seen, *packet)

    def _serve(self, seen: float, number: int, instruction: int, parameters: bytes, good: bool) -> float:
        """Execute a packet whose last byte the adapter had at `seen`; when its reply was out."""
        with self._lock:
            baud = self._baud()
            if not baud:  # unplugged since, or a speed no servo has
                return seen
            self._counts["instructions"] += 1
            arrived = seen + (len(parameters) + 6) * 10.0 / baud
            _sleep_until(arrived)
            there = [servo for place, servo in self._servos.items() if place > 0]
            heard = {servo.number: servo for servo in there if BAUDS.get(servo.table[Register.BAUD]) == baud}
            if number == BROADCAST:
                if self._deaf:
                    self._deaf -= 1
                elif good:
                    self._broadcast(heard, instruction, parameters)
                return arrived
            if number not in heard:
                return arrived
            servo = heard[number]
            if not good:
                reply, delay = status(number, 0x10 | servo.alarm, b""), servo.table[Register.RETURN_DELAY]
            else:
                if instruction == Instruction.WRITE:
                    self._note(number, parameters)
                level, delay = servo.table[Register.STATUS_RETURN], servo.table[Register.RETURN_DELAY]
                error, data = servo.execute(instruction, parameters)
                if instruction > (Instruction.PING, Instruction.READ, Instruction.SYNC_WRITE)[level]:
                    return arrived
                reply = status(number, error, data)
            self._counts["replies"] += 1
            wait = delay * 2e-6 + len(reply) * 10.0 / baud + self._latency_s
            reply, late = self._spoil(number, reply)
        _sleep_until(arrived + wait + late)
        self._send(reply)
        return time.perf_counter()

    def _broadcast(self, heard: dict[int, Servo], instruction: int, parameters: bytes) -> None:
        self._together = {}
        if instruction == Instruction.SYNC_WRITE and len(parameters) >= 2 and parameters[1]:
            address, width = parameters[0], parameters[1] + 1
            for i in range(2, len(parameters) - width + 1, width):
                number, values = parameters[i], parameters[i + 1 : i + width]
                if number in heard:
                    self._note(number, bytes([address]) + values)
                    heard[number].execute(Instruction.WRITE, bytes([address]) + values)
        else:
            for number, servo in heard.items():
                if instruction == Instruction.WRITE:
                    self._note(number, parameters)
                servo.execute(instruction, parameters)
        goals, self._together = self._together, None
        if goals:
            self._plant.command(goals)

    def _turn(self, axis: str, goal_deg: float, rate_dps: float) -> None:
        if self._together is not None:
            self._together[axis] = goal_deg, rate_dps
        else:
            self._plant.command({axis: (goal_deg, rate_dps)})

    def _note(self, number: int, parameters: Sequence[int]) -> None:
        self._written.append((time.perf_counter(), number, parameters[0], bytes(parameters[1:])))

    def _baud(self) -> int:
        """What the host has set its port to."""
        return SPEEDS.get(termios.tcgetattr(self._slave)[5], 0) if self._slave >= 0 else 0

    def _spoil(self, number: int, reply: bytes) -> tuple[bytes, float]:
        """The reply as the fault due now makes it, and how much later it comes."""
        held, self._held = self._held, b""
        if not self._faults or self._faults[0][1] not in (None, number):
            return held + reply, 0.0
        kind, _, seconds = self._faults.popleft()
        self._counts["faults"] += 1
        rng, body = self._rng, bytearray(reply[2:-1])
        match kind:
            case "no_reply":
                reply = b""
            case "bad_checksum":
                reply = reply[:-1] + bytes([reply[-1] ^ rng.randint(1, 255)])
            case "truncated":
                reply = reply[: rng.randrange(1, len(reply))]
            case "short":  # one byte of data less, said honestly and summed up rightly
                reply = status(number, body[2], bytes(body[3:-1]))
            case "late" if seconds > 0.0:
                return held + reply, seconds
            case "late":
                self._held, reply = reply, b""
            case "overload":
                reply = status(number, body[2] | 0x20, bytes(body[3:]))
            case "wrong_id":
                reply = status(rng.choice([n for n in range(1, 253) if n != number]), body[2], bytes(body[3:]))
            case "noise":
                at = rng.randrange(len(reply) + 1)
                reply = reply[:at] + self._noise(rng.randint(1, 12)) + reply[at:]
        return held + reply, 0.0

    def _noise(self, count: int) -> bytes:
        return bytes(self._rng.choice((0xFF, 0x00, self._rng.randrange(256))) for _ in range(count))

    def _send(self, reply: bytes) -> None:
        with self._lock:
            if self._master >= 0 and reply:
                try:
                    os.write(self._master, reply)
                except (BlockingIOError, OSError):  # nobody reads: a real wire forgets, too
                    return


def _sleep_until(when: float) -> None:
    left = when - time.perf_counter()
    if left > 0.0:
        time.sleep(left)


def main() -> None:
    given: dict[str, Any] = process.told()
    plant = PlantClient(given["plant"])
    bus = Bus(plant, baud=int(given["baud"]), latency_s=float(given["latency_s"]), seed=int(given["seed"]))
    threading.Thread(target=bus.run, daemon=True).start()
    process.live({"port": bus.port, "control": process.serve(bus)})


if __name__ == "__main__":
    main()
