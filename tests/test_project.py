"""Facts that the project states in several places agree: version, tools of CI, links."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from graspd.drivers.spi.messages import FIRMWARE
from tests.bench.attacks.__main__ import ATTACKS

ROOT = Path(__file__).parents[1]
VERSION = "0.1.0"
"""The newest release in the changelog, or the one that it announces."""
PLACES = {
    ("CITATION.cff", r"^version: (\S+)$"): VERSION,
    ("deploy/clients/cpp/CMakeLists.txt", r"^project\(graspd_client VERSION (\S+) "): VERSION,
    ("deploy/clients/README.md", r"find_package\(graspd_client (\S+) "): VERSION.rpartition(".")[0],
    ("deploy/CHANGELOG.md", r"^\| firmware of the bridge \| (\S+) \|$"): (
        f"{FIRMWARE >> 8}.{FIRMWARE & 0xFF}"
    ),
    (".pre-commit-config.yaml", r"repo: (\S+)"): "local",
}
"""By file and pattern: the text that the pattern's group matches, once in the file."""


def found(name: str, pattern: str) -> list[str]:
    return re.findall(pattern, (ROOT / name).read_text(), re.MULTILINE)


def wheel_of(project: Path, folder: Path) -> dict[str, int]:
    """Build a wheel of `project` in `folder`; return the checksum of each file by its name.

    METADATA and RECORD, which contain the version, are left out; it is cut from the names.
    """
    build(project, "wheel", folder)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as content:
        files = {
            re.sub(r"^graspd-[^/]*\.", "", file.filename): file.CRC for file in content.infolist()
        }
    del files["dist-info/METADATA"], files["dist-info/RECORD"]
    return files


def build(project: Path, kind: str, folder: Path) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "--target", kind, "-d", str(folder)]
    subprocess.run(command, cwd=project, check=True, capture_output=True)


def unpacked_sdist(folder: Path) -> Path:
    build(ROOT, "sdist", folder)
    (packed,) = folder.glob("*.tar.gz")
    with tarfile.open(packed) as content:
        assert not any(file.issym() or file.islnk() for file in content)
        content.extractall(folder / "sdist", filter="data")
    (unpacked,) = (folder / "sdist").iterdir()
    return unpacked


def without_links(folder: Path) -> Path:
    """Copy the source tree as git checks it out on Windows, where a link is a file with its target;
    return `folder`."""
    for name in ("daemon", "drivers", "models", "deploy"):
        shutil.copytree(ROOT / name, folder / name, symlinks=True)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    links = [path for path in folder.rglob("*") if path.is_symlink()]
    assert links
    for path in links:
        target = str(path.readlink())
        path.unlink()
        path.write_text(target)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("source", [unpacked_sdist, without_links])
def test_a_wheel_is_the_same_from_any_copy_of_source(
    source: Callable[[Path], Path], tmp_path: Path
) -> None:
    files = wheel_of(ROOT, tmp_path / "wheel")
    assert {name.partition("/")[0] for name in files} == {"data", "dist-info", "graspd"}
    modules = (
        "client.py",
        "daemon/cli.py",
        "daemon/scene/examples/spi.toml",
        "models/zoo/cnn1.onnx",
    )
    assert {f"graspd/{name}" for name in (*modules, "py.typed")} <= set(files)
    assert not [name for name in files if "tests" in name or name.endswith((".pyc", ".so"))]
    folder = tmp_path / "source"
    folder.mkdir()
    assert wheel_of(source(folder), tmp_path / "again") == files


def shell(folder: Path, script: str) -> str:
    command = ["bash", "-euo", "pipefail", "-c", script]
    return subprocess.check_output(command, cwd=folder, text=True).strip()


@pytest.mark.parametrize(
    ("after", "expected"),
    [
        ("true", r"3\.2\.1"),
        ("commit", r"3\.2\.2\.dev1\+g[0-9a-f]{7,}"),
        (
            "commit; mkdir copy; git archive HEAD | tar x -C copy; cd copy",
            r"3\.2\.2\.dev1\+g[0-9a-f]{7,}",
        ),
        (
            "commit; hatchling build -t sdist -d . >/dev/null 2>&1; tar xf *.gz; cd graspd-*/",
            r"3\.2\.2\.dev1\+g[0-9a-f]{7,}",
        ),
        ("commit; git tag -d v3.2.1 >/dev/null", r"0\.1\.dev2\+g[0-9a-f]{7,}"),
        ("rm -rf .git", r"0\.0"),
    ],
)
def test_the_version_follows_from_tag_and_commits(
    after: str, expected: str, tmp_path: Path
) -> None:
    for name in ("pyproject.toml", "README.md", "LICENSE", ".gitattributes", ".git_archival.txt"):
        shutil.copy(ROOT / name, tmp_path)
    script = f"""
    hatchling() {{ {sys.executable} -W ignore -m hatchling "$@"; }}
    commit() {{ git -c user.name=a -c user.email=a@b commit -qm change --allow-empty; }}
    git init -q; git add .; commit; git tag v3.2.1
    {after}
    hatchling version 2>/dev/null
    """
    assert re.fullmatch(expected, shell(tmp_path, script))


def test_the_version_is_the_same_everywhere() -> None:
    assert {place: found(*place) for place in PLACES} == {
        place: [each] for place, each in PLACES.items()
    }


def test_the_changelogs_newest_release_is_this_version_or_missing() -> None:
    headings = found("deploy/CHANGELOG.md", r"^## \[(.*?)\]")
    released = [heading for heading in headings if heading != "Unreleased"]
    assert headings[0] == "Unreleased"
    if released:
        assert released[0] == VERSION
    else:
        assert f"becomes {VERSION}." in (ROOT / "deploy/CHANGELOG.md").read_text()


def test_the_commit_hooks_run_the_lint_steps_of_ci() -> None:
    hooks = found(".pre-commit-config.yaml", r"entry: \.venv/bin/(.*)$")
    (checks,) = re.findall(
        r"step \"lint\"\n(.*?)step \"what", (ROOT / ".ci/run").read_text(), re.DOTALL
    )
    checked = re.findall(r"^(?:nice )?\.venv/bin/(.*) \|\| failed", checks, re.MULTILINE)
    options = r" (--force-exclude|--check|\.(?= |$))"
    assert [re.sub(options, "", each) for each in hooks] == [
        re.sub(options, "", each) for each in checked
    ]
    assert len(hooks) == 5


PAGES = [ROOT / "README.md", *ROOT.glob(".github/*.md"), *ROOT.glob("models/*.md")]
PAGES += ROOT.glob("deploy/**/*.md")


def heading_anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, by which links name them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in headings}


def test_local_links_of_pages_lead_to_existing_files_and_headings() -> None:
    lost = []
    for page in PAGES:
        for link in re.findall(r"\]\((?!https?://)([^)\s]+)\)", page.read_text()):
            name, _, anchor = link.partition("#")
            target = page.parent / name if name else page
            if not target.exists() or (anchor and anchor not in heading_anchors(target)):
                lost.append((page.name, link))
    assert lost == []


def test_files_named_in_contributing_and_architecture_pages_exist() -> None:
    for page in (".github/CONTRIBUTING.md", "deploy/ARCHITECTURE.md"):
        named = found(page, r"[` ]((?:daemon|drivers|models|tests|deploy)/[^`\s]*)`")
        assert len(named) > 10
        assert [name for name in named if not (ROOT / name).exists()] == []


def test_the_page_of_attacks_has_a_row_for_each_attack() -> None:
    assert found("deploy/ATTACKS.md", r"^\| `([a-z0-9-]+)` \|") == list(ATTACKS)
