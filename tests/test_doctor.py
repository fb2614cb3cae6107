"""`gyrobench doctor`: every check with its result and its cure, on the emulated bench with things put wrong."""

import json
import sys
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest

from server.cli import main
from server.devices import doctor_servo

NO_TERMINALS = pytest.mark.skipif(sys.platform == "win32", reason="the servo bus is emulated behind a pseudo-terminal")


@pytest.fixture(scope="module")
def servos() -> Iterator[Any]:
    from servos import start

    with closing(start(seed=6)) as servos:
        yield servos


def looked(servos: Any, options: str = "ids=1,2&baud=1000000", **more: Any) -> dict[str, Any]:
    return {check.name: check for check in doctor_servo.checks(f"dynamixel:{servos.port}?{options}&latency=1", **more)}


@NO_TERMINALS
def test_a_healthy_bus_passes_every_check(servos: Any) -> None:
    found = looked(servos)
    assert {name: check.ok for name, check in found.items()} == {
        "port": True,
        "latency timer": None,
        "servo x": True,
        "servo z": True,
        "servos": True,
    }
    assert found["servo z"].values["part"] == "RX-64"


@NO_TERMINALS
def test_servos_at_another_speed_are_found_there(servos: Any) -> None:
    found = looked(servos, "ids=1,2&baud=115200")
    assert (found["servo x"].ok, found["servo x"].code) == (False, "check.servo_other_baud")
    assert found["servo x"].values["there"] == 1_000_000


@NO_TERMINALS
def test_servos_with_other_ids_are_named(servos: Any) -> None:
    found = looked(servos, "ids=3,2&baud=1000000")
    assert found["servo x"].code == "check.servo_other_id"
    assert found["servo x"].values["servos"] == ["1 (RX-28)", "2 (RX-64)"]
    assert found["servo z"].ok


@NO_TERMINALS
def test_an_absent_servo_is_looked_for_and_its_cable_named(servos: Any) -> None:
    for servo in (1, 2):
        servos.bus.silence(servo)
    found = looked(servos)
    assert (found["servo x"].code, found["servo x"].cure) == ("check.servo_absent", "cure.servo_absent")
    for servo in (1, 2):
        servos.bus.rejoin(servo)


@NO_TERMINALS
@pytest.mark.parametrize(
    ("address", "wrong", "code", "right"),
    [
        (8, [0, 0], "rig.servo_wheel", bytes([0xFF, 0x03])),
        (18, [4], "rig.servo_unguarded", bytes([36])),
        (5, [250], "rig.servo_delay", bytes([0])),
    ],
)
def test_mend_writes_the_cure_and_looks_again(
    servos: Any, address: int, wrong: list[int], code: str, right: bytes
) -> None:
    servos.bus.poke(1, address, *wrong)
    assert code in [check.code for check in doctor_servo.checks(f"dynamixel:{servos.port}?latency=1")]
    assert looked(servos, mend=True)["servo x"].ok is True
    assert servos.bus.peek(1, address, len(wrong)) == right


@NO_TERMINALS
def test_a_port_in_use_is_told(servos: Any) -> None:
    with closing(servos.table()) as table:
        table.open()
        assert looked(servos)["port"].code == "rig.port_taken"


def test_an_absent_port_is_told_with_the_ports_there_are() -> None:
    (check,) = doctor_servo.checks("dynamixel:/dev/no-such-port")
    assert (check.ok, check.code) == (False, "rig.port_absent")


def test_the_command_says_every_check_and_fails_with_the_first_wrong_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--rig", "dynamixel:/dev/no-such-port", "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert (said["ok"], said["checks"][0]["code"]) == (False, "rig.port_absent")
    assert "/dev/no-such-port" in said["checks"][0]["sentence"]
    assert main(["doctor", "--rig", "twin:"]) == 0
    assert "RX-28" in capsys.readouterr().out
    assert main(["doctor", "--move"]) == 2


def test_the_twins_physics_is_checked_by_turning_it(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["doctor", "--rig", "twin:?seed=1", "--move", "--json"])
    said = json.loads(capsys.readouterr().out)
    assert (code, said["ok"]) == (0, True)
    assert {"gyro x", "gyro z", "step x", "step z", "range"} <= {check["name"] for check in said["checks"]}
