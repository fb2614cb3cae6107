"""`gyrobench doctor`: what is connected, what answers, what is wrong and how to mend it."""

import argparse
import json
from collections.abc import Iterator
from contextlib import closing
from typing import TYPE_CHECKING, Any

from calib_core.problem import Problem
from server.cli import FAILED

if TYPE_CHECKING:
    from server.devices.check import Check

EXAMPLE = "gyrobench doctor --rig 'dynamixel:/dev/ttyUSB0?ids=1,2&baud=1000000+nidaq:Dev1?channels=ai0,ai1' --move"
MARKS = {True: "ok", None: "??", False: "!!"}


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rig", help="the rig to look at (default: whatever is plugged in)")
    parser.add_argument("--move", action="store_true", help="also turn the table slowly: gyro, signs, step check")
    parser.add_argument("--mend", action="store_true", help="write what cures a wrong set-up into the servos")
    parser.add_argument("--gyro-model", metavar="ID", default="LPY503AL-OUT", help="what is mounted, for --move")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")


def main(args: argparse.Namespace) -> int:
    from server.texts import render

    shown: list[dict[str, Any]] = []
    for check in _checks(args):
        sentence = render(check.code, check.values, args.lang)
        cure = render(check.cure, check.values, args.lang) if check.cure else ""
        shown.append({"name": check.name, "ok": check.ok, "code": check.code, "values": check.values,
                      "sentence": sentence, "cure": cure})  # fmt: skip
        if not args.json:
            print(f"{MARKS[check.ok]}  {check.name}: {sentence}" + (f"\n    {cure}" if cure else ""), flush=True)
    failed = any(check["ok"] is False for check in shown)
    if args.json:
        print(json.dumps({"ok": not failed, "checks": shown}, ensure_ascii=False, default=str))
    return FAILED if failed else 0


def _checks(args: argparse.Namespace) -> Iterator["Check"]:
    from server.devices import doctor_daq, doctor_servo, open_rig, start_checks
    from server.devices.check import Check

    if args.rig is None:
        if args.move or args.mend:
            raise Problem("doctor.no_rig")
        yield from doctor_servo.find()
        yield from doctor_daq.checks("Dev1")
        return
    good = True
    url = args.rig.strip()
    servos, _, daq = url.partition("+nidaq:")
    if servos.startswith("dynamixel:"):
        for check in doctor_servo.checks(servos, mend=args.mend):
            good = good and check.ok is not False
            yield check
        if daq:
            for check in doctor_daq.checks(daq):
                good = good and check.ok is not False
                yield check
    if servos.startswith("dynamixel:") and (not good or not args.move):
        return
    with closing(open_rig(url)) as rig:
        if args.move:
            yield from start_checks.run(rig, _gyro_model(args.gyro_model))
            return
        try:
            rig.open()
        except Problem as problem:
            axis = problem.values.get("axis")
            yield Check(f"servo {axis}" if axis else "rig", False, problem.code, dict(problem.values))
            return
        for part in rig.status():
            yield Check(part["part"], part["ok"], part["code"], part["values"])


def _gyro_model(name: str) -> Any:
    from calib_core.gyro_models import PRESETS

    if name not in PRESETS:
        raise Problem(
            "cli.choice", command="gyrobench doctor", name="--gyro-model", given=name, allowed=", ".join(PRESETS)
        )
    return PRESETS[name]
