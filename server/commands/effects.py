"""`gyrobench effects`: what a diagnosis may name; effects of one's own are kept and forgotten here."""

import argparse
import json
from collections.abc import Iterator
from typing import Any

from server.cli import data_option
from server.texts import render

EXAMPLE = """gyrobench effects --json
  gyrobench effects --add cogging --formula 'sin(7 * radians(position_deg))' --parameter a --unit '{out}'
  gyrobench effects --remove cogging"""


def add(parser: argparse.ArgumentParser) -> None:
    one = parser.add_mutually_exclusive_group()
    one.add_argument("--add", metavar="NAME", help="keep an effect of your own: parameter x formula")
    one.add_argument("--remove", metavar="NAME", help="forget one of your own")
    parser.add_argument("--formula", default="", help="over rate_dps, position_deg, temperature_c, time_s ...")
    parser.add_argument("--parameter", default="k", metavar="NAME", help="what it is multiplied by (default k)")
    parser.add_argument("--unit", default="{out}", help="of the parameter; {out} stands for the recording's unit")
    parser.add_argument("--acts", choices=("output", "rate", "angle"), default="output", help="on what it acts")
    parser.add_argument("--note", default="", help="what it is for")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    data_option(parser)


def main(args: argparse.Namespace) -> int:
    from server import diagnosis
    from server.store import Store

    with Store(args.data) as store:
        if args.add:
            given = {key: getattr(args, key) for key in ("formula", "parameter", "unit", "acts")}
            store.effects.add({"name": args.add, **given}, note=args.note)
        if args.remove:
            store.effects.delete(args.remove)
        own = [diagnosis.own_card(row, args.lang) for row in store.effects.find()]
    cards = [*diagnosis.cards(args.lang), *own]
    print(json.dumps({"effects": cards}, ensure_ascii=False) if args.json else "\n".join(lines(cards, args.lang)))
    return 0


def lines(cards: list[dict[str, Any]], lang: str) -> Iterator[str]:
    """Name and title of each; of one's own the formula."""
    width = max(len(card["name"]) for card in cards)
    for card in cards:
        own = card["own"] and {"parameter": card["parameters"][0]["name"], "formula": card["formula"]}
        yield f"{card['name']:<{width}}  {render('effects_own.line', own, lang) if own else card['title']}"
