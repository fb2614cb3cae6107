"""`gyrobench emulate` starts the stand-ins, prints the rig that uses them, and takes them along when it ends."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
from shared import ROOT

from server.settings import checked_speed, has_speed, is_simulated

if sys.platform == "win32":
    pytest.skip("the servo bus is emulated behind a pseudo-terminal", allow_module_level=True)


def test_the_command_prints_a_rig_that_is_there_until_it_ends() -> None:
    command = [sys.executable, "-m", "server.cli", "emulate", "--seed", "3", "--covariates", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        rig = json.loads(process.stdout.readline())["rig"]
        port = Path(rig.removeprefix("dynamixel:").partition("?")[0])
        assert port.exists()
        assert rig.endswith("channels=ai0,ai1,ai2,ai3")
        assert is_simulated(rig)
        process.kill()  # however it ends
    until = time.monotonic() + 10.0
    while port.exists():
        assert time.monotonic() < until, "an emulator outlived its starter"
        time.sleep(0.05)


def test_only_the_twin_has_a_speed_and_an_emulated_board_is_no_physical_one() -> None:
    bench = "dynamixel:/dev/ttyUSB0?ids=1,2+nidaq:Dev1"
    assert [is_simulated(rig) for rig in ("twin:?seed=2", "emulated:", bench)] == [True, True, False]
    assert [has_speed(rig) for rig in ("twin:?seed=2", "emulated:", bench)] == [True, False, False]
    assert checked_speed(None, "emulated:", default=20.0) == 1.0
