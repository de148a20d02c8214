"""The machine's disk: a small Debian with its own kernel, made by mmdebstrap and kept by recipe.

`python -m tests.system.image` builds it, if it is not there; any Python does, without packages.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

RELEASE: Final = "bookworm"
PACKAGES: Final = (
    "linux-image-amd64",  # the cloud kernel has no vcan
    "systemd-sysv",
    "udev",
    "dbus",
    "qemu-guest-agent",  # runs what the test asks for
    "python3",
    "python3-venv",
    "iproute2",
    "kmod",
    "procps",  # ps
)
MODULES: Final = (
    "arch",
    "crypto",
    "lib",
    "block",
    "net/can",
    "fs/ext4",
    "fs/jbd2",
    "fs/mbcache.ko",
    "fs/autofs",
    "fs/binfmt_misc.ko",
    "drivers/virtio",
    "drivers/block/virtio_blk.ko",
    "drivers/char/virtio_console.ko",
    "drivers/net/can",
    "drivers/usb/core",
    "drivers/usb/common",
    "drivers/usb/host",
    "drivers/usb/serial",
    "drivers/usb/class",
    "drivers/acpi",
)
"""Kernel modules that the machine can use: a tenth of all, for a faster boot."""
UNWANTED: Final = ("doc", "man", "locale", "info", "i18n", "bug", "lintian")
"""Folders of /usr/share."""
MASKED: Final = (
    "apt-daily.timer",
    "apt-daily-upgrade.timer",
    "dpkg-db-backup.timer",
    "e2scrub_all.timer",
    "e2scrub_reap.service",
    "fstrim.timer",
    "systemd-timesyncd.service",
    "getty@tty1.service",
    "serial-getty@ttyS0.service",
)
"""Units that would run in the middle of a measurement, or offer logins."""
SIZE_MIB: Final = 1600
"""Room for two virtual environments of graspd at once, as an upgrade needs."""
BUILD_TIMEOUT_S: Final = 900.0


CACHE: Final = Path.home() / ".cache" / "graspd-system"
"""Keeps image and wheels, for all working copies."""


class ImageError(Exception):
    """The image cannot be built; the message says why."""


@dataclass(frozen=True, slots=True)
class Image:
    """What QEMU boots."""

    disk: Path
    """ext4, raw, without partitions."""
    kernel: Path
    initrd: Path


def image(cache: Path, *, rebuild: bool = False) -> tuple[Image, bool]:
    """The image of this recipe, and whether it had to be built. Raises `ImageError`."""
    recipe = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16]
    folder = cache / f"debian-{recipe}"
    made = Image(folder / "disk.ext4", folder / "vmlinuz", folder / "initrd")
    if folder.is_dir() and not rebuild:
        return made, False
    cache.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache, prefix="building-") as scratch:
        _build(Path(scratch))
        for former in cache.glob("debian-*"):
            shutil.rmtree(former)
        (Path(scratch) / "made").rename(folder)
    return made, True


def _build(scratch: Path) -> None:
    """Make `scratch`/made. Any user may: namespaces or fakeroot stand in for root."""
    made = scratch / "made"
    made.mkdir()
    tar = scratch / "root.tar"
    run(["mmdebstrap", *_options(), RELEASE, str(tar), *_sources()])
    boot = scratch / "boot"
    boot.mkdir()
    run(["tar", "-xf", str(tar), "-C", str(boot), "--wildcards", "./boot/vmlinuz*", "./boot/in*"])
    for name, kind in (("vmlinuz", "vmlinuz-*"), ("initrd", "initrd.img-*")):
        (found,) = (boot / "boot").glob(kind)
        found.rename(made / name)
    content = scratch / "content"
    content.mkdir()
    script = 'tar -xf "$1" -C "$2" && mke2fs -q -t ext4 -d "$2" "$3" "$4" && rm -rf "$2"'
    as_root = [] if os.geteuid() == 0 else ["fakeroot", "--"]
    words = [str(tar), str(content), str(made / "disk.ext4"), f"{SIZE_MIB}M"]
    run([*as_root, "sh", "-c", script, "sh", *words])


def _options() -> list[str]:
    left_out = [f"path-exclude=/usr/share/{name}/*" for name in UNWANTED]
    left_out += ["path-exclude=/lib/modules/*/kernel/*"]
    left_out += [f"path-include=/lib/modules/*/kernel/{name}*" for name in MODULES]
    options = [f"--dpkgopt={option}" for option in left_out]
    return [
        "--quiet",
        "--variant=minbase",
        "--format=tar",
        f"--include={','.join(PACKAGES)}",
        '--aptopt=APT::Install-Recommends "false"',
        *options,
        f'--customize-hook=systemctl --quiet --root="$1" mask {" ".join(MASKED)}',
        '--customize-hook=echo machine > "$1/etc/hostname"; : > "$1/etc/resolv.conf"',
    ]


def _sources() -> list[str]:
    """Where this machine's apt has the release from; nothing: mmdebstrap knows a place itself."""
    fields = "$(ORIGIN)|$(TARGET_OF)|$(REPO_URI)|$(RELEASE)|$(COMPONENT)"
    listed = run(["apt-get", "indextargets", "--format", fields, "Created-By: Packages"])
    lines = set()
    for line in listed.splitlines():
        origin, kind, uri, release, component = line.split("|")
        if origin == "Debian" and release.split("-")[0] == RELEASE:
            lines.add(f"{kind} {uri} {release} {component}")
    return sorted(lines)


def run(command: list[str]) -> str:
    """What a program of this machine prints. Raises `ImageError` if it fails."""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=BUILD_TIMEOUT_S, check=False
        )
    except FileNotFoundError as error:
        raise ImageError(f"{command[0]} is not installed") from error
    except subprocess.TimeoutExpired as error:
        raise ImageError(f"{command[0]} took longer than {BUILD_TIMEOUT_S:g} s") from error
    if done.returncode:
        raise ImageError(f"{command[0]} failed ({done.returncode}):\n{done.stderr.strip()[-4000:]}")
    return done.stdout


if __name__ == "__main__":
    image(CACHE)
