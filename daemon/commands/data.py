"""`graspd data`: the real grasp recordings, from upstream or from a folder, checked."""

from __future__ import annotations

import argparse
import hashlib
import sys
import urllib.error
import urllib.request
from pathlib import Path

from models.bts3 import CITATIONS, LICENCE, TABLES, TableFile

MAX_BYTES = 16 * 2**20
"""No file of the set has more than 1 MB; an endless answer is cut here."""
TIMEOUT_S = 30.0


UPSTREAM = "https://raw.githubusercontent.com/3dperceptionlab/biotacsp-stability-set-v2/master"
"""Where GitHub serves the files of `models.bts3.REPOSITORY`."""


class DataError(Exception):
    """A file cannot be had, or is not the one it should be."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "--to", type=Path, default=Path("data/bts3"), metavar="DIR", help="(default: data/bts3)"
    )
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--from", dest="folder", type=Path, metavar="DIR", help="copy from here")
    source.add_argument("--url", default=UPSTREAM, help="fetch below this address instead")


def run(args: argparse.Namespace) -> int:
    """Get every file that is not there yet; 0 when all are there and right."""
    try:
        args.to.mkdir(parents=True, exist_ok=True)
        for file in TABLES:
            target = args.to / f"{file.name}.csv"
            if target.exists() and _digest(target.read_bytes()) == file.sha256:
                sys.stdout.write(f"{target}: is there\n")
                continue
            content = _from_folder(args.folder, file) if args.folder else _fetch(args.url, file)
            _store(content, target)
            sys.stdout.write(f"{target}: {file.rows} grasps\n")
    except (DataError, OSError) as error:
        sys.stderr.write(f"graspd: {error}\n")
        return 1
    sys.stdout.write(f"licence: {LICENCE}; please cite\n  " + "\n  ".join(CITATIONS) + "\n")
    return 0


def _from_folder(folder: Path, file: TableFile) -> bytes:
    for name in (f"{file.name}.csv", file.upstream_name):
        if (folder / name).is_file():
            return _checked((folder / name).read_bytes(), file, str(folder / name))
    raise DataError(f"{folder}: has neither {file.name}.csv nor {file.upstream_name}")


def _fetch(base: str, file: TableFile) -> bytes:
    address = f"{base.rstrip('/')}/{file.upstream_name}"
    if not address.startswith(("https://", "http://")):
        raise DataError(f"{address}: only http and https addresses can be fetched")
    try:
        with urllib.request.urlopen(address, timeout=TIMEOUT_S) as answer:
            return _checked(answer.read(MAX_BYTES), file, address)
    except (urllib.error.URLError, TimeoutError) as error:
        raise DataError(f"{address}: {error}; or copy the files and use --from DIR") from error


def _checked(content: bytes, file: TableFile, source: str) -> bytes:
    if _digest(content) != file.sha256:
        raise DataError(f"{source}: is not {file.name}.csv: SHA-256 differs from {file.sha256}")
    return content


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _store(content: bytes, target: Path) -> None:
    partial = target.with_suffix(".partial")
    partial.write_bytes(content)
    partial.replace(target)
