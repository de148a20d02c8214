"""`graspd data`: the real grasp recordings, from upstream or from a folder, checked."""

from __future__ import annotations

import argparse
import hashlib
import http.client
import shlex
import urllib.request
from pathlib import Path

from graspd.daemon.process.files import write_atomically
from graspd.daemon.process.text import complain, printable, write_lines
from graspd.models.bts3 import CITATIONS, LICENCE, TABLES, TableFile

MAX_BYTES = 16 * 2**20
"""Most bytes that are read of an answer or a file. No file of the set has more than 1 MB."""
TIMEOUT_S = 30.0
"""Longest silence of a server, s."""
MESSAGE_MAX = 320
"""Longest error, characters: it may quote what the server sent."""

UPSTREAM = "https://raw.githubusercontent.com/3dperceptionlab/biotacsp-stability-set-v2/master"
"""Address of the files of `graspd.models.bts3.REPOSITORY` at GitHub."""


class DataError(Exception):
    """A file is not available, or has another content than expected."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "--to",
        type=Path,
        default=Path("data/bts3"),
        metavar="DIR",
        help="into here (default: data/bts3)",
    )
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--from", dest="folder", type=Path, metavar="DIR", help="copy from here")
    source.add_argument("--url", default=UPSTREAM, help="fetch below this address instead")


def run(args: argparse.Namespace) -> int:
    """Get every file that is missing or differs; return 0, or 1 at the first that cannot be got."""
    for file in TABLES:
        try:
            said = _get(args, file)
        except OSError as error:
            complain(f"{error.filename or args.to}: {error.strerror}")
            return 1
        except DataError as error:
            complain(error)
            return 1
        write_lines(printable(said))
    write_lines(f"licence: {LICENCE}; please cite", *(f"  {text}" for text in CITATIONS))
    return 0


def _get(args: argparse.Namespace, file: TableFile) -> str:
    """Get one file unless it is there unchanged; return text on what was done."""
    target: Path = args.to / f"{file.name}.csv"
    args.to.mkdir(parents=True, exist_ok=True)
    if target.exists():
        if not target.is_file():
            raise DataError(f"{target}: is there and is not a regular file")
        if _digest(_read(target)) == file.sha256:
            return f"{target}: is there"
    content = _from_folder(args.folder, file) if args.folder else _fetch(args.url, file)
    write_atomically(target, content, mode=0o644)
    return f"{target}: {file.rows} grasps"


def _from_folder(folder: Path, file: TableFile) -> bytes:
    names = f"{file.name}.csv", file.upstream_name
    for name in names:
        if (folder / name).is_file():
            return _checked(_read(folder / name), file, str(folder / name))
    below = (f"{deeper}/{name}" for deeper in ("*", "*/*") for name in names)
    nearest = next((path for each in below for path in folder.glob(each)), None)
    hint = "" if nearest is None else f"; try --from {shlex.quote(str(nearest.parent))}"
    raise DataError(f"{folder}: has neither {' nor '.join(names)}{hint}")


def _fetch(base: str, file: TableFile) -> bytes:
    address = f"{base.rstrip('/')}/{file.upstream_name}"
    if not address.startswith(("https://", "http://")):
        raise DataError(f"{address}: only http and https addresses can be fetched")
    try:
        with urllib.request.urlopen(address, timeout=TIMEOUT_S) as answer:
            content: bytes = answer.read(MAX_BYTES)
    except (OSError, http.client.HTTPException, ValueError) as error:
        why = printable(str(error) or type(error).__name__, MESSAGE_MAX)
        raise DataError(f"{address}: {why}; or copy the files and use --from DIR") from error
    return _checked(content, file, address)


def _read(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(MAX_BYTES)


def _checked(content: bytes, file: TableFile, source: str) -> bytes:
    if _digest(content) != file.sha256:
        raise DataError(f"{source}: is not {file.name}.csv: SHA-256 differs from {file.sha256}")
    return content


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
