"""`graspd models`: which models exist, what each is worth, and its weak points."""

from __future__ import annotations

import argparse
import importlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from graspd.daemon.assembly.assembly import DEFAULT_MODEL
from graspd.daemon.commands.arguments import UsageError, check_folder
from graspd.daemon.process.text import printable, write_json, write_lines
from graspd.models import trial, zoo
from graspd.models.contract import MeasuredError, ModelContract, ModelError
from graspd.models.runtime import read

OUT = Path("runs")
"""Folder of wrapped models unless `--out` says otherwise."""
WRAP = "graspd.models.training.commands.wrap"
TITLES = {
    "table": "the table it came with",
    "cv": "known objects",
    "unknown": "the paper's 8 other objects",
    "objects": "other objects",
    "objects-whole": "other objects, same days",
    "session": "other objects, another day",
    "days": "other objects, each day by others",
}
"""Meaning, in words for users, of each protocol of evaluation."""
SHOWN = {
    "known objects": ("cv",),
    "other objects": ("objects", "objects-whole"),
    "another day": ("session",),
    "each other day": ("days",),
}
"""Columns of the list by title; each shows the first of its protocols that a card has."""
SYSTEMS = "graspd.models.training.systems.registry"
"""Module that names the systems that can be trained; it imports no library of the training."""
LEFT_COLUMNS = 2
"""Columns of the list that begin at the left: name and fingers."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "what",
        nargs="*",
        metavar="NAME",
        help="show the card of this model, or of an .onnx file; without it, list all. `wrap FILE` "
        "makes a model for a scene of an ONNX network (extra: train)",
    )
    parser.add_argument(
        "--data",
        type=Path,
        action="append",
        default=[],
        metavar="TABLE",
        help="with wrap: a grasp table, by which the model's bounds are worked out",
    )
    parser.add_argument("--name", help="with wrap: name of the model (FILE-wrapped)")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"with wrap: folder for the model and its card ({OUT})",
    )
    parser.add_argument("--json", action="store_true", help="the cards as JSON on stdout")


def run(args: argparse.Namespace) -> int:
    """List the models, show the card of one, or wrap one. Raises `ModelError`, `UsageError`."""
    is_wrap = args.what[:1] == ["wrap"]
    if len(args.what) > 1 + is_wrap or (is_wrap and (len(args.what) != 2 or not args.data)):
        raise UsageError("give one NAME, or `wrap FILE --data TABLE`")
    if is_wrap:
        if args.json:
            raise UsageError("--json is for cards: it does not go with wrap")
        args.out = args.out or OUT
        exists = (folder for folder in (args.out, *args.out.absolute().parents) if folder.exists())
        check_folder(next(exists))  # now, not after minutes of measuring
        code: int = importlib.import_module(WRAP).run(args)
        return code
    if args.data or args.name is not None or args.out is not None:
        raise UsageError("--data, --name and --out are for `wrap FILE`")
    if not args.what:
        cards = {name: _card_of(zoo.find(name)) for name in zoo.names()}
        lines = _listing({name: _parsed(content) for name, content in cards.items()})
        document: dict[str, Any] = cards
    else:
        document = _content_of(args.what[0])
        lines = _details(_parsed(document))
    if args.json:
        write_json(document)
    else:
        write_lines(*map(printable, lines))
    return 0


def _content_of(what: str) -> dict[str, Any]:
    """Return the unchecked card of a model, by name or file. Raises `ModelError`."""
    if what in zoo.names():
        return _card_of(zoo.find(what))
    if what in importlib.import_module(SYSTEMS).SYSTEMS:
        made_by = f"`graspd train {what} --data DIR`, or --own FILE, makes it (extra `train`)"
        raise ModelError(f"{what} is a system that graspd does not ship: {made_by}")
    is_file = what.endswith(".onnx") or os.sep in what
    return trial.card(Path(what) if is_file else zoo.find(what))


def _card_of(path: Path) -> dict[str, Any]:
    """Return the card beside a model. Raises `ModelError` if it is of another file."""
    zoo.ships(path, read(path).sha256)
    return zoo.read_card(path.with_suffix(".json"))


class _Size(msgspec.Struct):
    size_bytes: int


class _Data(msgspec.Struct):
    licence: str


class _ShownCard(msgspec.Struct):
    """Shown fields of a card. A model of one's own may lack the fields with a default."""

    what: str
    contract: ModelContract
    file: _Size
    parameters: int | None = None
    weak_points: tuple[str, ...] = ("not stated",)
    data: _Data | None = None
    command: str | None = None


def _parsed(content: dict[str, Any]) -> _ShownCard:
    """Return the shown fields of a card. Raises `ModelError` if one has another form."""
    try:
        return msgspec.convert(content, _ShownCard)
    except msgspec.ValidationError as error:
        raise ModelError(f"a card is wrong: {error}") from error


def _listing(cards: dict[str, _ShownCard]) -> Iterator[str]:
    rows = [["F1, %", "fingers", "MB", "numbers", *SHOWN]]
    for name, card in cards.items():
        contract = card.contract
        f1 = {measured.protocol: f1_percent(measured) for measured in contract.measured}
        mark = " (default)" if name == DEFAULT_MODEL else ""
        chosen = (next(filter(None, map(f1.get, group)), "-") for group in SHOWN.values())
        size = f"{card.file.size_bytes / 1e6:.1f}"
        parameters = str(card.parameters or "-")
        rows.append([name + mark, " ".join(contract.fingers), size, parameters, *chosen])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [
            f"{text:{'<' if place < LEFT_COLUMNS else '>'}{width}}"
            for place, (text, width) in enumerate(zip(row, widths, strict=True))
        ]
        yield "  ".join(cells).rstrip()
    yield ""
    for name, card in cards.items():
        yield f"{name}: {card.what}"


def f1_percent(measured: MeasuredError) -> str:
    """Return F1 with its standard deviation, such as `83.5 +- 1.2`."""
    return f"{100 * measured.f1_mean:.1f} +- {100 * measured.f1_std:.1f}"


def _details(card: _ShownCard) -> Iterator[str]:
    contract = card.contract
    yield f"{contract.name}: {card.what}"
    yield ""
    for measured in contract.measured:
        title = TITLES.get(measured.protocol, measured.protocol)
        yield (
            f"{title + ' (' + measured.protocol + ')':44}F1 {f1_percent(measured)} %, "
            f"accuracy {100 * measured.accuracy_mean:.1f} % ({measured.folds} folds)"
        )
    steps = contract.confidence
    if steps:
        yield ""
        yield "accuracy by coverage, on other objects of the same days:"
    for step in steps[:: max(1, len(steps) // 6)]:
        yield (
            f"  confidence {step.confidence:.2f}: {100 * step.accuracy:.1f} % right, "
            f"{100 * step.coverage:.0f} % judged"
        )
    yield ""
    yield "known weak points:"
    for point in card.weak_points:
        yield f"  - {point}"
    yield ""
    for dataset in contract.datasets:
        yield f"trained on {dataset.name} ({dataset.rows} grasps, {dataset.sha256[:12]})"
    if card.data is not None:
        yield f"licence of the data: {card.data.licence}"
    if card.command is not None:
        yield f"made by: {card.command}"
