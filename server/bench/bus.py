"""The servo half of `bench bus`: how often the bus is read, what that costs, how fast a stop is, and whether the
emulated bench and the twin give one board the same certificate."""

import logging
import math
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from server.bench import Row
from server.bench.bus_faults import KINDS, Campaign
from server.devices.dynamixel_table import DynamixelTable

FAULTS, FEW_FAULTS = 1000, 20
STOPS = 20
SEED = 5
READINGS = 5


def run(*, quick: bool) -> Iterator[Row]:
    yield from reading(5.0 if quick else 20.0)
    yield from stopping()
    yield from faults(FEW_FAULTS if quick else FAULTS)
    yield from certificates(["estimate_x"] if quick else None)


def reading(seconds: float) -> Iterator[Row]:
    """Both servos read and streamed to; then as fast as the bus goes, also as it leaves the factory."""
    with _bench() as (bench, table):
        table.open()
        _swing(table)
        table.read()
        began, spent, lost = time.perf_counter(), time.process_time(), sum(table.bus.lost.values())
        time.sleep(seconds)
        taken, wall = table.read(), time.perf_counter() - began
        cpu = time.process_time() - spent
        rate = min(len(readings.time_s) for readings in taken.values()) / wall
        error = max(
            float(np.sqrt(np.mean((readings.angle_deg - bench.plant.angles(axis, readings.time_s)) ** 2)))
            for axis, readings in taken.items()
        )
        table.safe()
    yield Row("both servos read while both swing, 1 Mbaud, 1 ms timer", rate, "per s", 100.0, at_least=True)
    yield Row("replies that could not be used", sum(table.bus.lost.values()) - lost, f"of {round(2 * rate * wall)}")
    yield Row("the driver", 100.0 * cpu / wall, "% of a core", 15.0)
    yield Row("readings against the shafts, RMS", error, "deg", 0.12, ours="an encoder step is 0.293, its RMS 0.085")
    for baud, timer_ms, least in ((1_000_000, 1.0, 100.0), (57_600, 16.0, None)):
        with _bench(baud=baud, latency_ms=timer_ms) as (_, table):
            yield Row(
                f"read as fast as it goes, {baud} baud, {timer_ms:g} ms timer", _fastest(table), "per s", least, True
            )


def _fastest(table: DynamixelTable, seconds: float = 3.0) -> float:
    """Rounds of both servos a second, one question after the other."""
    from server.devices.dynamixel_bus import NoReply
    from server.devices.dynamixel_registers import BLOCK

    with closing(table.bus) as bus:
        bus.open()
        began, rounds = time.perf_counter(), 0
        while time.perf_counter() - began < seconds:
            try:
                for number in table.ids.values():
                    bus.read(number, *BLOCK)
                rounds += 1
            except NoReply:
                continue
        return rounds / (time.perf_counter() - began)


def stopping() -> Iterator[Row]:
    """From `safe` until both servos have been seen to have let go."""
    with _bench() as (bench, table):
        table.open()
        for name, busy in (("idle", False), ("while both swing", True)):
            took = []
            for _ in range(STOPS):
                if busy:
                    _swing(table)
                    time.sleep(0.1)
                began = time.perf_counter()
                table.safe()
                took.append(1e3 * (time.perf_counter() - began))
                assert not any(bench.bus.peek(number, 24)[0] for number in table.ids.values())
            yield Row(f"torque off and seen to be off, {name}, worst of {STOPS}", max(took), "ms", 100.0)


def faults(count: int) -> Iterator[Row]:
    """Every kind of HARDWARE's faults, `count` times: wrong readings, hung runs, torque left on, wrong reasons."""
    logging.getLogger("server.devices").setLevel(logging.ERROR)  # it warns of each fault, and is right to
    with _bench() as (bench, table):
        campaign = Campaign(table, bench.bus, bench.plant, seed=SEED)
        for kind in KINDS:
            found = campaign.run(kind, count)
            bad = found.wrong + found.hung + found.torque_on + len(found.surprises)
            told = f"{found.injected} faults, {found.readings} readings, worst off by {found.worst_deg:.2f} deg"
            if found.ended:
                told += f", {found.ended} runs ended for want of readings"
            yield Row(f"wrong, hung or left on after `{kind}`", bad, "", 0, ours=told)


def certificates(states: list[str] | None) -> Iterator[Row]:
    """One board on the emulated bench and on the twin, same seed: how far apart its figures are, in units of what both
    certificates say they may be."""
    began = time.perf_counter()
    real = _certificate(f"emulated:?seed={SEED}", states)
    wall = time.perf_counter() - began
    twin = _certificate(f"twin:?seed={SEED}", states)
    yield Row("a run on the emulated bench", wall, "s", ours=f"{READINGS} readings, {len(real['states'])} states")
    for axis, name, here, there in _figures(real, twin):
        apart = abs(here["value"] - there["value"])
        may = math.hypot(here["expanded_uncertainty"], there["expanded_uncertainty"])
        told = f"{here['value']:.6g} ± {here['expanded_uncertainty']:.2g} against {there['value']:.6g}"
        yield Row(
            f"{name} {axis}, emulated less twin, over both expanded uncertainties", apart / may, "", 1.0, ours=told
        )


def _figures(real: dict[str, Any], twin: dict[str, Any]) -> Iterator[tuple[str, str, Any, Any]]:
    for axis in real["axes"]:
        for name in ("bias_V", "scale_factor_V_per_dps"):
            yield axis, name, real["axes"][axis][name], twin["axes"][axis][name]


def _certificate(url: str, states: list[str] | None) -> dict[str, Any]:
    import threading

    from server import run_plan
    from server.conduct import conduct
    from server.devices import open_rig
    from server.store import Store

    request = {"board": "BENCH-1", "readings": READINGS, "seed": SEED, "states": states}
    with TemporaryDirectory() as folder, Store(Path(folder)) as store, closing(open_rig(url)) as rig:
        rig.open()
        speed = math.inf if rig.simulated else 1.0
        filled, plan = run_plan.plan_of(store, request, rig.axes)
        run = run_plan.create(store, filled, plan, rig=url, speed=speed)
        last = conduct(store, run, lambda: rig, speed=speed, abort=threading.Event())
        if last["certificate"] is None:
            raise RuntimeError(f"{url}: {last}")
        content: dict[str, Any] = store.certificates.get(last["certificate"])
        return content


def _swing(table: DynamixelTable) -> None:
    from calib_core.sequence import Wave

    table.start([Wave(axis, (30.0,), (0.2513,), 600.0) for axis in table.axes])


@contextmanager
def _bench(baud: int = 1_000_000, latency_ms: float = 1.0) -> Iterator[tuple[Any, DynamixelTable]]:
    from server import emulators
    from server.devices.address import table_of

    bench = emulators.start(SEED, baud=baud, latency_ms=latency_ms)
    with closing(bench), closing(table_of(bench.url)) as table:
        yield bench, table
