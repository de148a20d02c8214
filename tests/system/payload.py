"""The emulated machine's second disk: wheels, `deploy/`, and the programs that run there."""

from __future__ import annotations

import hashlib
import re
import shutil
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path
from typing import Final

from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from tests.kit.demos import write_stream
from tests.system.image import ImageError, run
from tests.system.lab import GRASPS, RATE_HZ

PROJECT: Final = Path(__file__).parents[2]
GUEST: Final = Path(__file__).parent / "guest"
GUEST_PYTHON: Final = (3, 11)
"""Version of Python in the emulated machine, and so of the Python that makes its wheels."""
EXTRA: Final = "record"
"""Extra of the package that the scenes need."""
RECORDED: Final = 6
"""Number of grasps in the recording that the CAN board plays."""
UNUSED: Final = (
    r"numpy/.*/tests/|numpy/(distutils|f2py)/.*/|onnxruntime/(transformers|quantization|tools)/|"
    r"pydantic/v1/"
)
"""Pattern of files in wheels that nothing imports. They would take the machine a third of the
installation's time."""
SLACK_MIB: Final = 24
"""Space on the disk beyond that of the files, MiB: more than the file system itself takes."""


def make_payload(cache: Path, disk: Path) -> None:
    """Make the disk's image at `disk`; `cache` keeps wheels of other projects.

    Raises `ImageError`, also with another Python than `GUEST_PYTHON`.
    """
    if sys.version_info[:2] != GUEST_PYTHON:
        wanted = ".".join(map(str, GUEST_PYTHON))
        raise ImageError(f"the machine has Python {wanted}: run this with Python {wanted}")
    with tempfile.TemporaryDirectory(dir=disk.parent, prefix="payload-") as scratch:
        content = Path(scratch) / "content"
        wheels = content / "wheels"
        shutil.copytree(_dependencies(cache), wheels)
        _wheel(wheels, "--no-deps", str(PROJECT))
        # The wheel has the package; its links lead out of `deploy/`.
        package = shutil.ignore_patterns("package")
        shutil.copytree(PROJECT / "deploy", content / "deploy", symlinks=True, ignore=package)
        write_recording(content / "recording.csv")
        shutil.copytree(GUEST, content / "guest", ignore=shutil.ignore_patterns("__pycache__"))
        bytes_ = sum(path.stat().st_size for path in content.rglob("*"))
        size = f"{(bytes_ >> 20) * 5 // 4 + SLACK_MIB}M"
        options = ["-t", "ext4", "-E", "root_owner=0:0", "-d", str(content)]
        run(["mke2fs", "-q", *options, str(disk), size])


def write_recording(path: Path) -> None:
    """Write the recording that the CAN board plays: the same grasps each time."""
    grasps = synthetic_grasps(RECORDED, rate_hz=RATE_HZ, durations=GRASPS)
    with path.open("w") as file:
        write_stream(grasps, file, t_decimals=2)


def _dependencies(cache: Path) -> Path:
    """Return a folder in `cache` with the wheels that the project needs; made if missing."""
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    wanted = sorted(project["dependencies"] + project["optional-dependencies"][EXTRA])
    digest = hashlib.sha256("\n".join([*wanted, UNUSED]).encode()).hexdigest()[:16]
    folder = cache / f"wheels-{digest}"
    if not folder.is_dir():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache, prefix="wheels-new-") as scratch:
            made = Path(scratch) / "made"
            _wheel(made, *wanted)
            for wheel in made.glob("*.whl"):
                _slim(wheel)
            for former in cache.glob("wheels-????????????????"):
                shutil.rmtree(former)
            made.rename(folder)
    return folder


def _wheel(folder: Path, *what: str) -> None:
    run([sys.executable, "-m", "pip", "wheel", "--quiet", "--wheel-dir", str(folder), *what])


def _slim(wheel: Path) -> None:
    """Rewrite a wheel without `UNUSED`; pip accepts files that are listed and missing."""
    with zipfile.ZipFile(wheel) as content:
        files = {each: content.read(each) for each in content.namelist()}
    with zipfile.ZipFile(wheel, "w") as content:
        for name, data in files.items():
            if not re.match(UNUSED, name):
                content.writestr(name, data)
