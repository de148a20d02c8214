"""Helpers for the tests of the installer: small wheels, and installations below a folder."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import zipfile
from pathlib import Path

from tests.kit.programs import ran

DEPLOY = Path(__file__).parents[2] / "deploy"
INSTALLER = DEPLOY / "install.sh"


def wheelhouse(folder: Path, version: str, *, starts: bool = True) -> Path:
    """Make a folder with one wheel: a stand-in for graspd that prints its version, without needs.

    The real one needs 100 MB of other wheels; tests/system installs it. `starts` False: the
    stand-in fails when it is run.
    """
    folder.mkdir(parents=True)
    info = f"graspd-{version}.dist-info"
    answer = f'    print("graspd {version}")\n' if starts else '    raise SystemExit("broken")\n'
    files = {
        "graspd/__init__.py": "",
        "graspd/__main__.py": f"def main() -> None:\n{answer}\n\nmain()\n",
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: graspd\nVersion: {version}\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": "[console_scripts]\ngraspd = graspd.__main__:main\n",
    }
    record = "".join(f"{name},,\n" for name in [*files, f"{info}/RECORD"])
    with zipfile.ZipFile(folder / f"graspd-{version}-py3-none-any.whl", "w") as wheel:
        for name, content in {**files, f"{info}/RECORD": record}.items():
            wheel.writestr(name, content)
    return folder


def installer(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run install.sh with `arguments`, and to install with this Python."""
    python = [] if "--uninstall" in arguments else ["--python", sys.executable]
    return ran(INSTALLER, *python, *arguments)


def install(root: Path, wheels: Path, *arguments: str) -> str:
    """Install below `root` from the folder `wheels`; return the installer's output. `arguments`:
    further ones of install.sh. Fails if the installer does."""
    done = installer("--root", root, "--wheelhouse", wheels, *arguments)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


IN_A_CHROOT = """
mount -t tmpfs tmpfs "$1"
mkdir "$1/upper" "$1/work" "$1/root"
mount -t overlay overlay -o "lowerdir=/,upperdir=$1/upper,workdir=$1/work" "$1/root"
mount --rbind /dev "$1/root/dev"
mount --rbind /proc "$1/root/proc"
exec chroot "$1/root" sh -euc "$2"
"""
"""Script that mounts a copy of this computer's files at $1, and runs the script $2 in it, where no
systemd runs."""


def in_a_chroot(folder: Path, script: str) -> subprocess.CompletedProcess[str]:
    """Run a shell script as root on a copy of this computer's files, which is discarded afterwards.

    `folder`: where the copy is mounted; it is empty before and afterwards.
    """
    return ran("unshare", "--mount", "sh", "-euc", IN_A_CHROOT, "sh", folder, script)


def content(root: Path) -> dict[str, str]:
    """Return the paths of all files and links below `root`, with checksum or target."""
    return {
        f"/{path.relative_to(root)}": str(path.readlink())
        if path.is_symlink()
        else hashlib.sha256(path.read_bytes()).hexdigest()
        for path in root.rglob("*")
        if path.is_symlink() or path.is_file()
    }


def version_below(root: Path, prefix: str = "/opt/graspd") -> str:
    """Return what the graspd installed below `root` prints as its version."""
    python = f"{root}{prefix}/venv/bin/python"
    return ran(python, "-I", "-m", "graspd", "--version", check=True).stdout.strip()
