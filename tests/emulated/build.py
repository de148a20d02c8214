"""Builds the bridge's firmware for a Raspberry Pi Pico, and the emulator, which npm fetches."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pytest

from tests.conftest import ROOT, data_dir
from tests.kit.programs import ran

BRIDGE: Final = ROOT / "deploy" / "bridge"
FOLDER: Final = ROOT / "build" / "pico"
EMULATOR_FOLDER: Final = ROOT / "build" / "emulated"
"""Folder of the emulator, as `FOLDER` is of the firmware; git ignores both."""
COMPILER: Final = "arm-none-eabi-gcc"
NEEDED: Final = {
    COMPILER: "gcc-arm-none-eabi",
    "cmake": "cmake",
    "ninja": "ninja-build",
    "node": "nodejs",
    "npm": "npm",
    "cc": "gcc",
}
"""Programs of a build and of the emulator, and the Debian packages that have them."""
EMULATOR: Final = ROOT / "tests" / "emulated" / "emulator"
HOST: Final = BRIDGE / "host"
_ADDON: Final = (EMULATOR / "sensors.c", HOST / "sim_sensor.c", HOST / "counts.c")
_PARTS: Final = (EMULATOR / "package-lock.json", *_ADDON, HOST / "sim_sensor.h", HOST / "counts.h")
SUBSET: Final = "pico-sdk-*-subset.tar.xz"


def shared_dir() -> Path | None:
    """Return the folder of the pico-sdk's subset and of the boot ROM; None if there is none."""
    data = data_dir()
    beside = ROOT.parent / "shared"
    candidates = [*([data.parent] if data else []), beside]
    found = (folder / "pico" for folder in candidates if any((folder / "pico").glob(SUBSET)))
    return next(found, None)


def image(sensors: int = 3, clock_mhz: int = 125, sequence: str = "electrodes") -> Path:
    """Build the firmware and return its `.bin`, the content of the flash from 0x10000000.

    `clock_mhz` is the chip's system clock (125, 133, 200).
    """
    FOLDER.mkdir(parents=True, exist_ok=True)
    folder = FOLDER / f"{sensors}-{clock_mhz}-{sequence}"
    with _alone(FOLDER / "lock"):
        settings = [
            f"-DPICO_SDK_PATH={pico_sdk()}",
            f"-DBRIDGE_SENSORS={sensors}",
            f"-DBRIDGE_SYS_CLOCK_MHZ={clock_mhz}",
            f"-DBRIDGE_SEQUENCE=BIOTAC_{sequence.upper()}",
        ]
        _run("cmake", "-G", "Ninja", "-S", BRIDGE / "pico", "-B", folder, *settings)
        _run("ninja", "-C", folder, "bridge")
    return folder / "bridge.bin"


def pico_sdk() -> Path:
    """Return the pico-sdk that `PICO_SDK_PATH` names, or the subset, unpacked."""
    named = os.environ.get("PICO_SDK_PATH")
    if named is not None:
        return Path(named)
    shared = shared_dir()
    assert shared is not None
    packed = max(shared.glob(SUBSET))
    sdk = FOLDER / packed.name.removesuffix(".tar.xz")
    if not sdk.is_dir():
        fresh = sdk.with_suffix(".new")
        shutil.rmtree(fresh, ignore_errors=True)
        shutil.unpack_archive(packed, fresh, filter="data")
        (top,) = fresh.iterdir()
        top.rename(sdk)
        fresh.rmdir()
    return sdk


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Hold the lock file at `path` during the block, so that one process builds at a time."""
    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _run(*command: str | Path) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        told = (done.stdout + done.stderr).splitlines()[-40:]
        pytest.fail("\n".join([f"{command[0]}:", *(line[:300] for line in told)]))


def missing() -> str | None:
    """Return why nothing can be emulated here, in one line; None if it can."""
    absent = [package for program, package in NEEDED.items() if shutil.which(program) is None]
    if absent:
        return f"no emulated chip without it: apt install {' '.join(absent)}"
    found = ran(COMPILER, "-print-file-name=nosys.specs", check=True).stdout.strip()
    if not Path(found).is_absolute():
        return "no emulated chip without it: apt install libnewlib-arm-none-eabi"
    if shared_dir() is None:
        return "no pico-sdk and boot ROM (shared/pico beside the project), for the emulated chip"
    return None


def boot_rom() -> Path:
    """Return the file of the RP2040's boot ROM."""
    shared = shared_dir()
    assert shared is not None
    return shared / "bootrom_b1.bin"


def emulator_folder() -> Path:
    """Return the folder with `node_modules` and `sensors.node`; rebuilt if sources changed."""
    digest = hashlib.sha256(b"".join(part.read_bytes() for part in _PARTS)).hexdigest()
    folder = EMULATOR_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    made = folder / "made_of"
    with _alone(folder / "lock"):
        if not made.is_file() or made.read_text() != digest:
            for name in ("package.json", "package-lock.json"):
                shutil.copy(EMULATOR / name, folder)
            _run("npm", "--prefix", folder, "ci", "--no-audit", "--no-fund")
            headers = folder / "node_modules" / "node-api-headers" / "include"
            flags = ("-O2", "-shared", "-fPIC", "-std=c99", "-D_XOPEN_SOURCE=700", f"-I{headers}")
            _run("cc", *flags, f"-I{HOST}", *_ADDON, "-o", folder / "sensors.node")
            made.write_text(digest)
    return folder
