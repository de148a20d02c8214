"""`graspd models [NAME]`: which models there are, what each is worth, where it ends."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from typing import Any

from daemon.assembly.assembly import DEFAULT_MODEL
from daemon.process.text import complain, printable
from models import zoo
from models.contract import ModelError

TITLES = {
    "cv": "known objects",
    "unknown": "the paper's 8 other objects",
    "objects": "other objects",
    "objects-whole": "other objects, same days",
    "session": "other objects, another day",
    "days": "other objects, each day by others",
}
"""What each protocol asks, for people."""

SHOWN = {
    "known objects": ("cv",),
    "other objects": ("objects", "objects-whole"),
    "another day": ("session",),
    "each other day": ("days",),
}
"""Columns of the list: the first of these protocols that a card has."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("name", nargs="?", help="show this model's card")
    parser.add_argument("--json", action="store_true", help="the cards as JSON on stdout")


def run(args: argparse.Namespace) -> int:
    """List the zoo, or show one card; 2 if there is no such model."""
    try:
        names = zoo.names() if args.name is None else [args.name]
        cards = {name: zoo.card(name) for name in names}
    except ModelError as error:
        complain(error)
        return 2
    if args.json:
        sys.stdout.write(json.dumps(cards if args.name is None else cards[args.name]) + "\n")
        return 0
    lines = _listing(cards) if args.name is None else _card(cards[args.name])
    sys.stdout.write("\n".join(printable(line) for line in lines) + "\n")
    return 0


def _listing(cards: dict[str, dict[str, Any]]) -> Iterator[str]:
    titles = "".join(f"{title:>16}" for title in SHOWN)
    yield f"{'F1, %':26}{'fingers':10}{'MB':>6}{'numbers':>10}{titles}"
    for name, card in cards.items():
        f1 = {
            measured["protocol"]: f"{100 * measured['f1_mean']:.1f} +- "
            f"{100 * measured['f1_std']:.1f}"
            for measured in card["contract"]["measured"]
        }
        default = " (default)" if name == DEFAULT_MODEL else ""
        chosen = (next(filter(None, map(f1.get, group)), "-") for group in SHOWN.values())
        figures = "".join(f"{text:>16}" for text in chosen)
        size = card["file"]["size_bytes"] / 1e6
        fingers = " ".join(card["contract"]["fingers"])
        yield f"{name + default:26}{fingers:10}{size:6.1f}{card['parameters']:>10}{figures}"
    yield ""
    for name, card in cards.items():
        yield f"{name}: {card['what']}"


def _card(card: dict[str, Any]) -> Iterator[str]:
    contract = card["contract"]
    yield f"{contract['name']}: {card['what']}"
    yield ""
    for measured in contract["measured"]:
        title = TITLES.get(measured["protocol"], measured["protocol"])
        yield (
            f"{title + ' (' + measured['protocol'] + ')':44}"
            f"F1 {100 * measured['f1_mean']:.1f} +- {100 * measured['f1_std']:.1f} %, "
            f"accuracy {100 * measured['accuracy_mean']:.1f} % ({measured['folds']} folds)"
        )
    if contract["confidence"]:
        yield ""
        yield "accuracy by coverage, on other objects of the same days:"
        for step in contract["confidence"][:: max(1, len(contract["confidence"]) // 6)]:
            yield (
                f"  confidence {step['confidence']:.2f}: {100 * step['accuracy']:.1f} % right, "
                f"{100 * step['coverage']:.0f} % judged"
            )
    yield ""
    yield "known weak points:"
    for point in card["weak_points"]:
        yield f"  - {point}"
    yield ""
    for dataset in contract["datasets"]:
        yield f"trained on {dataset['name']} ({dataset['rows']} grasps, {dataset['sha256'][:12]})"
    yield f"licence of the data: {card['data']['licence']}"
    yield f"made by: {card['command']}"
