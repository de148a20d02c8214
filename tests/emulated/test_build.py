"""How the firmware's images are built, and what is said where they cannot be."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.emulated import build
from tests.emulated.conftest import Image


def test_an_image_is_built_once(image: Image, monkeypatch: pytest.MonkeyPatch) -> None:
    made = image("pico")
    monkeypatch.setattr(build, "_build", lambda *_: pytest.fail("built again"))
    assert image("pico") == made


@pytest.mark.parametrize("port", ["pico", "sketch"])
def test_an_image_leaves_most_of_the_chip_free(port: str, image: Image) -> None:
    flash, ram = build.flash_and_ram(image(port))
    assert 10_000 < flash < 64 * 1024, "of 2 MB"
    assert 4_000 < ram < 64 * 1024, "of 264 kB"


def test_picotool_is_fetched_if_the_option_asks_for_it(image: Image, tmp_path: Path) -> None:
    image("pico")  # or skip: no tools, no SDK
    nowhere = tmp_path / "nowhere"
    options = {"PICO_NO_PICOTOOL": 0, "PICOTOOL_GIT_REPOSITORY_URL": nowhere}
    settings = [f"-D{name}={value}" for name, value in options.items()]
    command: list[str | Path] = [
        "cmake",
        "-S",
        build.BRIDGE / "pico",
        "-B",
        tmp_path / "build",
        *settings,
    ]
    command.append(f"-DPICO_SDK_PATH={build.pico_sdk()}")
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode != 0, done.stdout
    assert "Downloading Picotool" in done.stderr
    assert str(nowhere) in done.stdout + done.stderr


@pytest.mark.parametrize("program", build.NEEDED)
def test_a_missing_program_is_named_with_its_package(
    program: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None if name == program else f"/{name}")
    with pytest.raises(
        build.MissingError, match=f"^no {program}: install {build.NEEDED[program]}$"
    ):
        build.image()


def test_a_folder_that_is_no_sdk_is_named(
    image: Image, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PICO_SDK_PATH", str(tmp_path))
    with pytest.raises(build.MissingError, match=f"^no pico-sdk at PICO_SDK_PATH '{tmp_path}'$"):
        image()
