"""The README's lines install the C++ client, and build with it by CMake and by pkg-config."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import pytest

from tests.clients.building import CPP, skip_unless_it_can_be_compiled
from tests.kit.programs import ran

pytestmark = pytest.mark.slow

README = (CPP.parent / "README.md").read_text()
PROGRAM = "lift_gate"


def block(language: str, first: str) -> list[str]:
    """Return the lines of the README's one code block in `language` that begins with `first`."""
    (code,) = re.findall(rf"```{language}\n({first}.*?)```", README, re.DOTALL)
    return str(code).splitlines()


def run(*words: str | Path, **variables: str) -> str:
    done = ran(*words, env=os.environ | variables)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def prefix(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder below which the C++ client is installed; skips the test if a tool is missing."""
    skip_unless_it_can_be_compiled()
    missing = [tool for tool in ("cmake", "pkg-config") if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"no package of the client without it: apt install {' '.join(missing)}")
    folder = tmp_path_factory.mktemp("installed")
    made = folder / "build"
    # What is moved after it was configured, as by a packager, is found too.
    run("cmake", "-S", CPP, "-B", made, f"-DCMAKE_INSTALL_PREFIX={folder / 'configured'}")
    run("cmake", "--install", made, "--prefix", folder)
    return folder


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Folder with the source of a program, but without the client's header."""
    shutil.copy(CPP / f"{PROGRAM}.cpp", tmp_path)
    return tmp_path


def works(program: Path, folder: Path) -> None:
    """Run the program without a daemon, and assert that it says no, and why."""
    result = ran(program, f"ipc://{folder}/nobody", 0.1)
    assert result.returncode == 1, result.stderr
    assert result.stdout.startswith("unknown [ no-message ]")


def test_cmake_finds_the_installed_client(prefix: Path, project: Path) -> None:
    (project / "CMakeLists.txt").write_text("\n".join(block("cmake", "cmake_minimum")))
    run("cmake", "-S", project, "-B", project / "build", f"-DCMAKE_PREFIX_PATH={prefix}")
    run("cmake", "--build", project / "build")
    works(project / "build" / PROGRAM, project)


def test_pkg_config_finds_the_installed_client(prefix: Path, project: Path) -> None:
    (described,) = prefix.glob("share/**/graspd_client.pc")
    line = block("sh", "cmake -S")[1]
    run("sh", "-c", f"cd {project} && {line}", PKG_CONFIG_PATH=str(described.parent))
    works(project / PROGRAM, project)


def test_a_project_for_another_minor_version_refuses_this_package(
    prefix: Path, project: Path
) -> None:
    lines = "\n".join(block("cmake", "cmake_minimum")).replace("0.1", "0.2")
    (project / "CMakeLists.txt").write_text(lines)
    words = ["cmake", "-S", project, "-B", project / "build", f"-DCMAKE_PREFIX_PATH={prefix}"]
    found = ran(*words)
    assert found.returncode != 0
    assert "version: 0.1.0" in found.stderr
