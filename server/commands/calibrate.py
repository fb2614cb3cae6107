"""`gyrobench calibrate`: the six states without a browser, the same way as the worker runs them."""

import argparse
import logging
import signal
import sys
import threading
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from calib_core.problem import Problem
from server.cli import BAD_USE, FAILED, data_option

EXAMPLE = "gyrobench calibrate --board LPY-1 --rig 'twin:?seed=1' --spec lab.json --out certificates"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--board", required=True, metavar="ID", help="what is printed on the board")
    parser.add_argument(
        "--rig", default="twin:", help="twin:?seed=1, emulated:, dynamixel:PORT+nidaq:DEV (default twin:)"
    )
    parser.add_argument("--profile", default="standard", help="standard or thesis (default standard)")
    parser.add_argument(
        "--gyro-model", metavar="ID", help="datasheet and ranges (default the board's, else LPY503AL-OUT)"
    )
    parser.add_argument("--states", help="some of the six only, with commas: estimate_x,rate_x")
    parser.add_argument("--readings", type=int, metavar="N", help="repeat readings at a set-point (default 22)")
    parser.add_argument("--seed", type=int, metavar="N", help="decides the order of set-points (default: drawn)")
    parser.add_argument("--spec", metavar="FILE", help="limits as JSON; without them the verdict is `issued`")
    parser.add_argument("--speed", help="bench seconds per second, or max; simulated rigs only (default max there)")
    parser.add_argument("--operator", default="", metavar="NAME")
    parser.add_argument("--note", default="", help="a line for the certificate")
    parser.add_argument("--room-temperature", type=float, metavar="DEGC", help="a condition named on the certificate")
    parser.add_argument("--out", default=".", metavar="DIR", help="where the documents go (default here)")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    data_option(parser)


def main(args: argparse.Namespace) -> int:
    from server import outcome
    from server.devices import DeviceError

    # What ends a run is told in one sentence; the server's log has its traceback as well.
    logging.getLogger("gyrobench").addHandler(logging.NullHandler())
    try:
        found = outcome.certified(_run(args), Path(args.out), args.lang)
        code = FAILED if found["verdict"] == "fail" else 0
    except Problem as problem:
        found = outcome.failed(problem, args.lang, board=args.board)
        code = FAILED if isinstance(problem, DeviceError | Ended) else BAD_USE
    outcome.tell(found, args.lang, as_json=args.json)
    return code


class Ended(Problem):
    """The run began and did not reach its certificate."""


def _run(args: argparse.Namespace) -> dict[str, Any]:
    """The issued certificate; raises Problem."""
    from server import outcome, run_plan
    from server.conduct import conduct
    from server.devices import open_rig
    from server.settings import checked_speed
    from server.store import Store

    spec = outcome.read_spec(args.spec)
    speed = checked_speed(args.speed, args.rig, default=float("inf"))
    request = {
        "board": args.board,
        "gyro_model": args.gyro_model,
        "profile": args.profile,
        "states": args.states.split(",") if args.states else None,
        "readings": args.readings,
        "seed": args.seed,
        "operator": args.operator,
        "note": args.note,
        "conditions": {} if args.room_temperature is None else {"room_temperature_degC": args.room_temperature},
        "spec": spec,
    }
    Path(args.out).mkdir(parents=True, exist_ok=True)  # refused before 45 minutes, not after them
    with Store(args.data) as store, closing(open_rig(store.effects.address(args.rig))) as rig:
        rig.open()
        filled, plan = run_plan.plan_of(store, request, rig.axes)
        run = run_plan.create(store, filled, plan, rig=rig.url, speed=speed)
        abort = threading.Event()
        before = signal.signal(signal.SIGINT, lambda *_: abort.set())
        try:
            live = _terminal(run, args.lang) if sys.stderr.isatty() else None
            last = conduct(store, run, lambda: rig, speed=speed, abort=abort, live=live)
        finally:
            signal.signal(signal.SIGINT, before)
        if last["certificate"] is None:
            raise Ended(last["message"]["code"], **last["message"]["values"])
        return store.certificates.get(last["certificate"])


def _terminal(run: str, lang: str) -> Any:
    """A view of the run that is one line on stderr."""
    from server.live import Arrays, LiveRun
    from server.texts import render

    class Terminal(LiveRun):
        def feed(self, message: Mapping[str, Any], arrays: Arrays | None = None) -> None:  # noqa: ARG002
            if progress := message.get("progress"):
                values = {"step": message["step"], "percent": f"{100 * progress['run_fraction']:.0f}",
                          "left": f"{progress['seconds_left']:.0f}"}  # fmt: skip
                print(f"\r\x1b[K{render('outcome.progress', values, lang)}", end="", file=sys.stderr, flush=True)
            elif "certificate" in message:
                print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    return Terminal(run, {})
