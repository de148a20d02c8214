"""The emulator's parts: made once, from npm and a C compiler, in a folder that git does not see."""

from __future__ import annotations

import fcntl
import hashlib
import shutil
import subprocess
from pathlib import Path

from tests.conftest import ROOT
from tests.emulated.build import MissingError, check_tools, shared_dir

EMULATOR = ROOT / "tests" / "emulated" / "emulator"
HOST = ROOT / "deploy" / "bridge" / "host"
FOLDER = ROOT / "build" / "emulated"

_ADDON = (EMULATOR / "sensors.c", HOST / "sim_sensor.c", HOST / "counts.c")
_PARTS = (EMULATOR / "package-lock.json", *_ADDON, HOST / "sim_sensor.h", HOST / "counts.h")


def missing() -> str | None:
    """Why nothing can be emulated here, in one line, or None."""
    absent = [command for command in ("node", "npm", "cc") if shutil.which(command) is None]
    if absent:
        return f"no {', '.join(absent)} for the emulated chip"
    try:
        check_tools()
    except MissingError as error:
        return f"{error}, for the emulated chip"
    if shared_dir() is None:
        return "no pico-sdk and boot ROM (shared/pico beside the project), for the emulated chip"
    return None


def boot_rom() -> Path:
    """The RP2040's boot ROM. Raises `MissingError`."""
    shared = shared_dir()
    if shared is None:
        raise MissingError("no boot ROM of the RP2040")
    return shared / "bootrom_b1.bin"


def emulator_folder() -> Path:
    """The folder with `node_modules` and `sensors.node`, made if anything that it is of changed."""
    wanted = hashlib.sha256(b"".join(part.read_bytes() for part in _PARTS)).hexdigest()
    FOLDER.mkdir(parents=True, exist_ok=True)
    made = FOLDER / "made_of"
    with (FOLDER / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.is_file() or made.read_text() != wanted:
            for name in ("package.json", "package-lock.json"):
                shutil.copy(EMULATOR / name, FOLDER)
            _run("npm", "ci", "--no-audit", "--no-fund")
            headers = FOLDER / "node_modules" / "node-api-headers" / "include"
            flags = ("-O2", "-shared", "-fPIC", "-std=c99", "-D_XOPEN_SOURCE=700", f"-I{headers}")
            output = ("-o", str(FOLDER / "sensors.node"))
            _run("cc", *flags, f"-I{HOST}", *map(str, _ADDON), *output)
            made.write_text(wanted)
    return FOLDER


def _run(*command: str) -> None:
    done = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: {done.stdout}{done.stderr}")
