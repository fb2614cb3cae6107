"""What `gyrobench serve` was told, and where data lives."""

import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path

from calib_core.problem import Problem

LOOPBACK = {"127.0.0.1", "::1", "localhost"}


@dataclass(frozen=True)
class Settings:
    data: Path
    host: str = "127.0.0.1"
    port: int = 8000
    rig: str = "twin:"
    speed: float = 20.0  # bench seconds per second; math.inf for as fast as it goes
    token: str | None = None  # asked of every write but the emergency stop, where the host is not loopback


def data_dir(explicit: str | Path | None = None) -> Path:
    """``--data``, else GYROBENCH_DATA, else the platform's user data directory."""
    chosen = explicit or os.environ.get("GYROBENCH_DATA")
    if chosen:
        return Path(chosen).expanduser().absolute()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "Gyrobench"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Application Support" / "Gyrobench"
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "gyrobench"


def is_simulated(rig: str) -> bool:
    """Whether no physical gyro is behind it: the twin, and the emulated bench, which has its port in such a folder."""
    return rig.startswith(("twin:", "emulated:")) or "gyrobench-emulated-" in rig


def has_speed(rig: str) -> bool:
    """Only the twin runs at another speed than the clock's: everything else has a clock of its own."""
    return rig.startswith("twin:")


def checked_speed(speed: str | float | None, rig: str, *, default: float = 20.0) -> float:
    """A speed as the rig allows it; None asks for the rig's own. Raises Problem: only a twin has another than 1."""
    if speed is None:
        return default if has_speed(rig) else 1.0
    try:
        value = math.inf if speed == "max" else float(speed)
    except ValueError:
        value = math.nan
    if math.isnan(value) or not value >= 1:
        raise Problem("rig.speed_unknown", speed=speed)
    if value != 1 and not has_speed(rig):
        raise Problem("rig.speed_only_simulated", speed=speed, rig=rig)
    return value
