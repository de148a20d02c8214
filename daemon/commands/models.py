"""`graspd models`: which models there are, what each is worth, where it ends; and adding others."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from graspd.daemon.assembly.assembly import DEFAULT_MODEL
from graspd.daemon.process.files import write_atomically
from graspd.daemon.process.text import complain, printable, write_json, write_lines
from graspd.models import own, zoo
from graspd.models.contract import MeasuredError, ModelContract, ModelError
from graspd.models.runtime import read

TITLES = {
    "cv": "known objects",
    "unknown": "the paper's 8 other objects",
    "objects": "other objects",
    "objects-whole": "other objects, same days",
    "session": "other objects, another day",
    "days": "other objects, each day by others",
}
"""Question of each protocol, for people."""
SHOWN = {
    "known objects": ("cv",),
    "other objects": ("objects", "objects-whole"),
    "another day": ("session",),
    "each other day": ("days",),
}
"""Columns of the list: the first of these protocols that a card has."""
LEFT_COLUMNS = 2
"""Columns of the list that begin at the left: name and fingers."""
ADD, REMOVE = "add", "remove"
FAILED = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.usage = """graspd models [--json] [NAME | FILE]
       graspd models add FILE [--name NAME] [--user | --system] [--force]
       graspd models remove NAME [--user | --system]"""
    parser.add_argument(
        "what",
        nargs="?",
        metavar="NAME",
        help="show the card of this model, or of an .onnx file; without it, list all. 'add' copies "
        "a model file and its card to where [model] name of a scene, and --model, find it by name; "
        "'remove' takes it away again",
    )
    parser.add_argument("which", nargs="?", metavar="FILE", help="what to add, or to remove")
    parser.add_argument(
        "--name", help="with add: name to give it (default: the one in its contract)"
    )
    parser.add_argument("--force", action="store_true", help="with add: replace what is called so")
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--user",
        dest="is_system",
        action="store_false",
        default=os.geteuid() == 0,
        help="in ~/.local/share/graspd/models, for this user only (default, except for root)",
    )
    where.add_argument(
        "--system",
        dest="is_system",
        action="store_true",
        help=f"in {own.SYSTEM_FOLDER}, for services and all who may read there (default for root)",
    )
    parser.add_argument("--json", action="store_true", help="the cards as JSON on stdout")


def run(args: argparse.Namespace) -> int:
    """List, show, add or remove; 1 if a folder cannot be written. Raises `ModelError`."""
    try:
        if args.what in (ADD, REMOVE):
            if args.which is None:
                raise ModelError(f"{args.what} needs a {'FILE' if args.what == ADD else 'NAME'}")
            return _add(args) if args.what == ADD else _remove(args)
        if args.which is not None:
            raise ModelError(f"only {ADD} and {REMOVE} take a second word: {args.which}")
        return _show(args)
    except OSError as error:
        if error.filename is None and args.what not in (ADD, REMOVE):
            raise  # of standard output
        complain(f"{error.filename or args.which}: {error.strerror or error}")
        return FAILED


def _show(args: argparse.Namespace) -> int:
    if args.what is None:
        added = own.added()
        contents: dict[str, Any] = {}
        cards: dict[str, _ShownCard] = {}
        for name, path in {**{name: zoo.find(name) for name in zoo.names()}, **added}.items():
            try:
                content = _card_of(path)
                cards[name] = _parsed(content)
            except ModelError as error:
                complain(error)
            else:
                contents[name] = content
        lines, document = _listing(cards, added), contents
    else:
        document = _content_of(args.what)
        lines = _details(_parsed(document))
    if args.json:
        write_json(document)
    else:
        write_lines(*map(printable, lines))
    return 0


def _content_of(what: str) -> dict[str, Any]:
    """Return the card of a name or a file, as it is."""
    if what in zoo.names():
        return _card_of(zoo.find(what))
    is_file = what.endswith(".onnx") or os.sep in what
    return own.card(Path(what) if is_file else own.find(what))


def _card_of(path: Path) -> dict[str, Any]:
    """Return the card beside a model. Raises `ModelError` if it is of another file."""
    zoo.ships(path, read(path).sha256)
    return zoo.read_card(path.with_suffix(".json"))


class _Size(msgspec.Struct):
    size_bytes: int


class _Data(msgspec.Struct):
    licence: str


class _ShownCard(msgspec.Struct):
    """Shown fields of a card. Cards of added models may lack the fields with a default."""

    what: str
    contract: ModelContract
    file: _Size
    parameters: int | None = None
    weak_points: tuple[str, ...] = ("not stated",)
    data: _Data | None = None
    command: str | None = None


def _parsed(content: dict[str, Any]) -> _ShownCard:
    """Raise `ModelError` if a part that is shown has another form."""
    try:
        return msgspec.convert(content, _ShownCard)
    except msgspec.ValidationError as error:
        raise ModelError(f"a card is wrong: {error}") from error


def _add(args: argparse.Namespace) -> int:
    source = Path(args.which)
    file = read(source)
    content = own.card(source, file)
    card = _parsed(content)
    name = card.contract.name if args.name is None else args.name
    if name in zoo.names():
        raise ModelError(f"graspd ships a model '{name}': give yours another --name")
    if not own.is_name(name) or name in (ADD, REMOVE):
        raise ModelError(
            f"{name!r} is no name for a model: up to {own.NAME_MAX} letters, digits, '.', '_' and "
            "'-' (--name)"
        )
    folder = _folder(args)
    target = folder / f"{name}.onnx"
    if target.exists() and not args.force:
        raise ModelError(f"{target} is there already: --force replaces it")
    if not folder.is_dir():
        folder.mkdir(parents=True)
        folder.chmod(0o755)  # whatever the umask: the service reads it as another user
    write_atomically(target.with_suffix(".json"), json.dumps(content).encode(), mode=0o644)
    write_atomically(target, file.data, mode=0o644)
    where = printable(str(target))
    write_lines(f'{where}: added; in a scene, below [model]: name = "{name}"')
    first = own.find(name)
    if first != target:
        complain(f"{first} has this name too, and comes first for you")
    elif not args.is_system:
        complain(f"for you alone; for a service: sudo graspd models add --system --name {name} ...")
    return 0


def _remove(args: argparse.Namespace) -> int:
    name, target = args.which, _folder(args) / f"{args.which}.onnx"
    if name in zoo.names():
        raise ModelError(f"'{name}' ships with graspd and stays")
    if not own.is_name(name) or not target.exists():
        raise ModelError(f"no model '{name}' in {target.parent} (see --user and --system)")
    target.unlink()
    with suppress(FileNotFoundError):
        target.with_suffix(".json").unlink()
    write_lines(f"{printable(str(target))}: removed")
    return 0


def _folder(args: argparse.Namespace) -> Path:
    folder = own.SYSTEM_FOLDER if args.is_system else own.user_folder()
    if folder is None:
        raise ModelError("there is no home folder to keep it in: --system")
    return folder


def _listing(cards: dict[str, _ShownCard], added: dict[str, Path]) -> Iterator[str]:
    rows = [["F1, %", "fingers", "MB", "numbers", *SHOWN]]
    for name, card in cards.items():
        contract = card.contract
        f1 = {measured.protocol: f1_percent(measured) for measured in contract.measured}
        mark = " (default)" if name == DEFAULT_MODEL else " (own)" if name in added else ""
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
        where = f" ({added[name]})" if name in added else ""
        yield f"{name}: {card.what}{where}"


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
