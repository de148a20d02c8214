"""`graspd keys`: make and list the CURVE keys of a daemon and of peers that may connect."""

from __future__ import annotations

import argparse
from pathlib import Path

from graspd.daemon.process.text import complain, printable, write_json, write_lines
from graspd.daemon.publish import keys
from graspd.daemon.publish.keys import KeysError

FOLDER = Path("/etc/graspd/keys")
CLIENTS = "clients"
"""Folder, beside the daemon's own keys, with the public keys of peers that may connect."""
WRONG = 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    actions = parser.add_subparsers(
        dest="action", metavar="ACTION", required=True, help="what to do"
    )
    text = "make a pair of keys: NAME.key and NAME.key_secret"
    make = actions.add_parser("make", help=text, description=f"M{text[1:]}.")
    make.add_argument("name", help="whose keys: `daemon`, or the name of a computer")
    text = "list the keys, and what is wrong with them"
    listing = actions.add_parser("list", help=text, description=f"L{text[1:]}.")
    listing.add_argument("--json", action="store_true", help="one JSON object on stdout")
    for action in (make, listing):
        action.add_argument(
            "--dir",
            type=Path,
            default=FOLDER,
            metavar="DIR",
            help=f"folder of the keys (default: {FOLDER})",
        )


def run(args: argparse.Namespace) -> int:
    """Make or list keys; return 2 if existing keys are wrong. Raises `KeysError`."""
    if args.action == "list":
        return _list(args)
    public, secret = keys.make(args.dir, args.name)
    write_lines(
        f"{printable(str(public))}: public; a client's goes into {CLIENTS}/ beside the daemon's",
        f"{printable(str(secret))}: secret; stays with its owner",
    )
    return 0


def _list(args: argparse.Namespace) -> int:
    own: dict[str, str] = {}
    clients: dict[str, str] = {}
    problems = []
    for path in _secret_keys(args.dir):
        try:
            own[path.stem] = keys.load_own(path)[0].decode()
        except KeysError as error:
            problems.append(str(error))
    folder = args.dir / CLIENTS
    try:
        if folder.is_dir():
            loaded = keys.load_clients(folder)
            clients = {name: key.decode() for key, name in loaded.admitted.items()}
            problems += loaded.refused
    except KeysError as error:
        problems.append(str(error))
    if args.json:
        write_json({"own": own, CLIENTS: clients, "wrong": problems})
    else:
        for kind, entries in (("own", own), (CLIENTS, clients)):
            write_lines(*(f"{kind:8} {printable(name)}  {key}" for name, key in entries.items()))
    if not (own or clients or problems):
        complain(f"{args.dir}: no {keys.SECRET} file, and no key in {CLIENTS}/")
    for problem in problems:
        complain(problem)
    return WRONG if problems else 0


def _secret_keys(folder: Path) -> list[Path]:
    """Return the secret key files of a folder; no files if the default folder is missing.
    Raises `KeysError` for a folder that cannot be read."""
    try:
        return sorted(path for path in folder.iterdir() if path.suffix == keys.SECRET)
    except OSError as error:
        if folder == FOLDER and isinstance(error, FileNotFoundError):
            return []
        raise KeysError(f"{folder}: cannot list the keys: {error.strerror}") from error
