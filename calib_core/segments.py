"""Names of what the table was doing: ``rate_x/linearity/+60/2`` is a test reading, anything else is free text."""

import re
from dataclasses import dataclass

_READING = re.compile(
    r"(?P<kind>rate|position)_(?P<axis>[xyz])/(?P<test>linearity|repeat)/(?P<set_point>[+-]?\d+(?:\.\d+)?)/(?P<reading>\d+)",
    re.ASCII,
)


@dataclass(frozen=True, slots=True)
class Segment:
    """One reading of a test: ``set_point`` in deg/s (kind "rate") or deg (kind "position"), ``reading`` from 1."""

    kind: str
    axis: str
    test: str
    set_point: float
    reading: int

    @property
    def state(self) -> str:
        """The state the reading belongs to, ``rate_x`` and the like."""
        return f"{self.kind}_{self.axis}"


def parse_segment(name: str) -> Segment | None:
    """The test reading that ``name`` stands for; None for every other name (CONTRACT 1)."""
    found = _READING.fullmatch(name)
    if found is None:
        return None
    return Segment(found["kind"], found["axis"], found["test"], float(found["set_point"]), int(found["reading"]))


def format_segment(segment: Segment) -> str:
    """The inverse of ``parse_segment``: the sign always, no exponent, no trailing zeros (1e-6 at best)."""
    number = f"{segment.set_point:+.6f}".rstrip("0").rstrip(".")
    number = "+0" if number == "-0" else number
    return f"{segment.kind}_{segment.axis}/{segment.test}/{number}/{segment.reading}"
