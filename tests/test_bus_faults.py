"""A slice of the fault campaign with a fixed seed; `gyrobench bench bus` injects a thousand of each kind."""

import sys
from collections.abc import Iterator
from contextlib import closing

import pytest

if sys.platform == "win32":
    pytest.skip("the servo bus is emulated behind a pseudo-terminal", allow_module_level=True)

from servos import start

from server.bench.bus_faults import ENDING, KINDS, PASSING, Campaign


@pytest.fixture(scope="module")
def campaign() -> Iterator[Campaign]:
    with closing(start(seed=4)) as servos, closing(servos.table()) as table:
        yield Campaign(table, servos.bus, servos.plant, seed=20)


@pytest.mark.parametrize("kind", KINDS)
def test_no_fault_of_the_bus_becomes_data_hangs_a_run_or_leaves_the_torque_on(campaign: Campaign, kind: str) -> None:
    outcome = campaign.run(kind, 12 if kind in PASSING else 3)
    assert outcome.clean, outcome
    assert outcome.readings > 0


def test_every_kind_of_fault_is_in_the_campaign() -> None:
    hardware = {"no_reply", "bad_checksum", "truncated", "short", "late", "wrong_id", "noise", "overload", "port_gone"}
    assert hardware <= set(KINDS)
    assert set(ENDING) | set(PASSING) == set(KINDS)
