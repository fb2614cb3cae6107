"""`gyrobench emulate`: the emulated bench, for as long as this command runs."""

import argparse
import json
import sys
import threading

from server.cli import FAILED
from server.emulators.process import Child

EXAMPLE = "gyrobench emulate --seed 1"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=int, default=1, help="which simulated servos and boards (default 1)")
    parser.add_argument("--baud", type=int, default=1_000_000, help="speed of the servo bus (default 1000000)")
    parser.add_argument("--latency", type=float, default=1.0, metavar="MS", help="the adapter's timer (default 1 ms)")
    parser.add_argument("--covariates", action="store_true", help="temperature and supply on ai2 and ai3")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of words")


def main(args: argparse.Namespace) -> int:
    from server import emulators

    channels = 4 if args.covariates else 2
    bench = emulators.start(args.seed, baud=args.baud, latency_ms=args.latency, channels=channels)
    try:
        if args.json:
            print(json.dumps({"rig": bench.url}), flush=True)
        else:
            print(f"The emulated bench is up until Ctrl+C. Use it with\n\n  --rig '{bench.url}'\n", flush=True)
        ended = threading.Event()

        def watch(child: Child) -> None:
            child.wait()
            ended.set()

        for child in bench.children:
            threading.Thread(target=watch, args=[child], daemon=True).start()
        ended.wait()
        print("An emulator ended by itself.", file=sys.stderr)
        return FAILED
    finally:
        bench.close()
