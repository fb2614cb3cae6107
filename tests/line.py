"""The far end of a serial line, scripted: what is asked is noted, what is answered is in the script."""

import contextlib
import os
import select
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterable
from pathlib import Path

Answer = bytes | list[tuple[float, bytes]]  # at once, or pieces with a pause in seconds before each


def packet(text: str) -> bytes:
    """A packet as manuals print it: "FF FF 01 02 01 FB"."""
    return bytes.fromhex(text)


def status(servo: int, error: int, data: bytes) -> bytes:
    body = bytes([servo, len(data) + 2, error]) + data
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


class Line:
    """A pseudo-terminal whose other end answers the k-th packet with the k-th answer, the others with `then`."""

    def __init__(self, *answers: Answer) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self.port = str(Path(self._folder.name) / "line")
        self.asked: list[bytes] = []
        self._answers = list(answers)
        self.then: Callable[[bytes], bytes] = lambda asked: b""  # noqa: ARG005
        self.plug()

    def plug(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        Path(self.port).symlink_to(os.ttyname(self._slave))
        end, self._end = os.pipe()
        self._thread = threading.Thread(target=self._talk, args=[self._master, end], daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        Path(self.port).unlink()
        os.close(self._end)
        self._thread.join()  # its descriptors' numbers are the next line's: it must not read on
        for fd in (self._slave, self._master):
            os.close(fd)

    def say(self, *answers: Answer) -> None:
        """Answers for the packets to come."""
        self._answers = list(answers)

    def _talk(self, master: int, end: int) -> None:
        heard = b""
        while True:
            ready, _, _ = select.select([master, end], [], [])
            if end in ready:
                os.close(end)
                return
            heard += os.read(master, 256)
            while len(heard) >= 4 and len(heard) >= heard[3] + 4:
                self.asked.append(heard[: heard[3] + 4])
                heard = heard[heard[3] + 4 :]
                answer = self._answers.pop(0) if self._answers else self.then(self.asked[-1])
                for pause_s, data in _pieces(answer):
                    time.sleep(pause_s)
                    with contextlib.suppress(OSError):
                        os.write(master, data)

    def close(self) -> None:
        if Path(self.port).is_symlink():
            self.unplug()
        self._folder.cleanup()


def _pieces(answer: Answer) -> Iterable[tuple[float, bytes]]:
    return [(0.0, answer)] if isinstance(answer, bytes) else answer
