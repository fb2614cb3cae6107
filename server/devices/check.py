"""One check of a rig: what was looked at, how it came out, and what to do where it is wrong."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Check:
    """`ok` is None where it could not be told. `code` and `values` name its sentence, `cure` the text that mends it."""

    name: str
    ok: bool | None
    code: str
    values: dict[str, Any] = field(default_factory=dict)
    cure: str = ""
