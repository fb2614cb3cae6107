"""`gyrobench certify`: recordings of whole sessions become certificates, on the path that a run takes too."""

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from calib_core.problem import Problem
from server.cli import FAILED, data_option, os_problem

EXAMPLE = "gyrobench certify LPY-*.csv.gz --spec lab.json --out certificates --workers 2"
FEW = 4
"""Fewer files than these are done before other processes have started."""
Tell = Callable[[dict[str, Any]], None]


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("files", nargs="+", metavar="FILE", help="recordings: .csv, .csv.gz or .parquet")
    parser.add_argument("--out", required=True, metavar="DIR", help="where the documents go")
    parser.add_argument("--spec", metavar="FILE", help="limits as JSON; without them the verdict is `issued`")
    parser.add_argument(
        "--gyro-model", metavar="ID", help="datasheet (default: what the recording says, else LPY503AL-OUT)"
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help="processes at work (default: one a core, or one for a few files)"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object a file on stdout, in the order they end")
    data_option(parser)


def main(args: argparse.Namespace) -> int:
    from server import outcome
    from server.batch_cluster import ADDRESS
    from server.store import Store

    if args.workers is not None and args.workers < 1:
        raise Problem("certify.workers", given=args.workers)
    spec = outcome.read_spec(args.spec)
    progress = Progress(len(args.files), args.lang) if sys.stderr.isatty() else None
    verdicts: list[str] = []

    def tell(found: outcome.Outcome) -> None:
        verdicts.append(found["verdict"])
        if progress:
            progress.clear()
        outcome.tell(found, args.lang, as_json=args.json)
        if progress:
            progress.show(len(verdicts), verdicts.count("error"))

    with Store(args.data) as store:
        model = store.gyro_models.get(args.gyro_model).to_json() if args.gyro_model else None
        if args.workers == 1 or (args.workers is None and len(args.files) < FEW and not os.environ.get(ADDRESS)):
            _here(store, args, (model, spec), tell)
        else:
            _on_cluster(store, args, (model, spec), tell)
    return FAILED if {"fail", "error"} & set(verdicts) else 0


class Progress:
    """One line on a terminal: how many are done, how many failed, how long the others take."""

    def __init__(self, files: int, lang: str) -> None:
        self._files, self._lang = files, lang
        self._began = time.monotonic()

    def show(self, done: int, failed: int) -> None:
        from server.texts import render

        left_s = (time.monotonic() - self._began) / done * (self._files - done)
        values = {"done": done, "files": self._files, "failed": failed, "left_min": left_s / 60}
        print(render("certify.progress", values, self._lang), end="", file=sys.stderr, flush=True)

    def clear(self) -> None:
        print("\r\033[K", end="", file=sys.stderr, flush=True)


def _here(store: Any, args: argparse.Namespace, settings: tuple[Any, Any], tell: Tell) -> None:
    from server import batch_work, outcome

    for file in args.files:
        found = batch_work.certify(file, Path(file).name, *settings)
        if "error" in found:
            tell(outcome.failed(_problem(found), args.lang, file=file))
        else:
            issued = batch_work.keep(store, found, Path(file).name)
            tell(outcome.certified(issued, Path(args.out), args.lang, file=file))


def _on_cluster(store: Any, args: argparse.Namespace, settings: tuple[Any, Any], tell: Tell) -> None:
    """The same in many processes; each file is told when it ends."""
    import asyncio

    from server import batch_work, outcome
    from server.batch_cluster import AHEAD, Cluster

    async def certify(cluster: Cluster, file: str) -> outcome.Outcome:
        try:
            source = file if cluster.is_local else await asyncio.to_thread(Path(file).read_bytes)
            found = await cluster.run(batch_work.certify_here, source, Path(file).name, *settings)
            if "error" in found:
                raise _problem(found)
            issued = batch_work.keep(store, found, Path(file).name)
            rendered = await cluster.run(batch_work.documents, issued, args.lang)
            return outcome.certified(issued, Path(args.out), args.lang, file=file, rendered=rendered)
        except OSError as error:
            return outcome.failed(os_problem(error), args.lang, file=file)
        except Problem as problem:
            if problem.code.startswith("batch.cluster"):
                raise
            return outcome.failed(problem, args.lang, file=file)

    async def some(cluster: Cluster, files: Iterator[str]) -> None:
        for file in files:
            tell(await certify(cluster, file))

    async def everything() -> None:
        async with Cluster.open(args.workers, files=len(args.files)) as cluster:
            files = iter(args.files)
            await asyncio.gather(*(some(cluster, files) for _ in range(cluster.places + AHEAD)))

    asyncio.run(everything())


def _problem(found: Mapping[str, Any]) -> Problem:
    return Problem(found["error"]["code"], **found["error"]["values"])
