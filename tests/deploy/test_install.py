"""The installer, staged below a folder: no root, no service manager, nothing of this computer."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.deploy.staging import (
    DEPLOY,
    INSTALLER,
    content,
    in_a_chroot,
    install,
    installer,
    version_below,
    wheelhouse,
)
from tests.kit.programs import ran

FILES = {
    "/usr/local/bin/graspd",
    "/usr/local/lib/systemd/system/graspd@.service",
    "/usr/local/lib/sysusers.d/graspd.conf",
    "/usr/local/lib/tmpfiles.d/graspd.conf",
    "/usr/local/lib/udev/rules.d/70-graspd.rules",
    "/usr/local/share/man/man1/graspd.1",
    "/etc/graspd/right.toml",
}
"""Files that the installer always makes outside the prefix."""
BACKOFF = "/usr/local/lib/systemd/system/graspd@.service.d/backoff.conf"
"""File that is installed only if systemd is new enough."""
NETWORK = "/usr/local/lib/systemd/network/80-graspd-can.network"
"""File that is installed only with `--can`."""

pytestmark = pytest.mark.slow
pytest.importorskip("ensurepip", reason="no venv: apt install python3-venv")


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return wheelhouse(tmp_path_factory.mktemp("wheels") / "first", "0.1.0")


@pytest.fixture(scope="module")
def pristine(wheels: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A staged installation that no test changes."""
    root = tmp_path_factory.mktemp("pristine")
    install(root, wheels)
    return root


@pytest.fixture
def staged(pristine: Path, tmp_path: Path) -> Path:
    """A staged installation of the test's own."""
    return shutil.copytree(pristine, tmp_path / "root", symlinks=True)


def test_every_file_goes_to_its_place(pristine: Path) -> None:
    outside = {path for path in content(pristine) if not path.startswith("/opt/")}
    assert outside - {BACKOFF} == FILES
    link = pristine / "usr/local/bin/graspd"
    assert str(link.readlink()) == "/opt/graspd/venv/bin/graspd"
    assert version_below(pristine) == "graspd 0.1.0"


def test_no_installed_file_contains_the_staging_path(pristine: Path) -> None:
    files = [path for path in pristine.rglob("*") if path.is_file() and not path.is_symlink()]
    assert [path for path in files if str(pristine).encode() in path.read_bytes()] == []
    environment = (pristine / "opt/graspd/venv").readlink()
    program = (pristine / "opt/graspd/venv/bin/graspd").read_text()
    assert program.startswith(f"#!/opt/graspd/{environment}/bin/python")


def test_the_installer_compiles_byte_code(pristine: Path) -> None:
    assert list(pristine.glob("opt/graspd/venv/lib/*/site-packages/graspd/__pycache__/__main__*"))


def test_a_second_run_changes_nothing_and_says_so(staged: Path, wheels: Path) -> None:
    before = content(staged)
    assert install(staged, wheels) == "graspd: nothing to change in /opt/graspd\n"
    assert content(staged) == before


def test_a_change_of_any_file_in_the_wheel_is_noticed(tmp_path: Path) -> None:
    """The installer lists what it compares; pyproject.toml says what goes into the wheel."""
    functions = INSTALLER.read_text().removesuffix('main "$@"\n')
    script = f"{functions}\npython=$1 source=$2 scratch=$3\ninputs\n"
    listed = ran("sh", "-c", script, INSTALLER, sys.executable, DEPLOY.parent, tmp_path, check=True)
    compared = {line.rpartition("  ")[2] for line in listed.stdout.splitlines()}
    project = tomllib.loads((DEPLOY.parent / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    for part in (*wheel["only-include"], *wheel["force-include"], *wheel["shared-data"]):
        assert [path for path in compared if path == part or path.startswith(f"{part}/")], part


def test_a_scene_is_never_overwritten(staged: Path, wheels: Path) -> None:
    scene = staged / "etc/graspd/right.toml"
    scene.write_text("# mine\n")
    install(staged, wheels)
    assert scene.read_text() == "# mine\n"
    scene.rename(scene.with_name("left.toml"))
    install(staged, wheels)
    assert not scene.exists(), "an example was put beside a scene that is in use"


def test_an_upgrade_keeps_the_former_version_while_it_is_used(staged: Path, tmp_path: Path) -> None:
    folder = staged / "opt/graspd"
    former = folder / (folder / "venv").readlink()
    newer = wheelhouse(tmp_path / "second", "0.2.0")
    with something_that_uses(former):
        said = install(staged, newer)
        assert "venv is new: from graspd 0.1.0 to graspd 0.2.0\n" in said
        assert f"kept /opt/graspd/{former.name}" in said
        assert former.is_dir()
        assert version_below(staged) == "graspd 0.2.0"
    assert f"removed the former /opt/graspd/{former.name}" in install(staged, newer)
    current = str((folder / "venv").readlink())
    assert sorted(path.name for path in folder.iterdir()) == ["venv", current]


@contextlib.contextmanager
def something_that_uses(environment: Path) -> Iterator[None]:
    """Run a process that has a file of `environment` mapped, as a daemon has its libraries."""
    code = (
        "import mmap, sys\n"
        "with open(sys.argv[1], 'rb') as file, mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ):\n"
        "    print('mapped', flush=True)\n"
        "    sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", code, str(environment / "inputs.sha256")]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "mapped\n"
        yield


@pytest.mark.parametrize("kind", ["no wheel at all", "one that does not start"])
def test_a_failed_upgrade_leaves_the_former_version_unchanged(
    kind: str, staged: Path, tmp_path: Path
) -> None:
    newer = wheelhouse(tmp_path / "second", "0.2.0", starts=False)
    if kind == "no wheel at all":
        (newer / "graspd-0.2.0-py3-none-any.whl").write_text("junk")
    before = content(staged)
    done = installer("--root", staged, "--wheelhouse", newer)
    assert done.returncode == 1
    assert "nothing has changed" in done.stderr
    assert content(staged) == before
    assert version_below(staged) == "graspd 0.1.0"


def test_an_upgrade_killed_at_the_exchange_leaves_a_graspd_that_starts(
    staged: Path, tmp_path: Path
) -> None:
    newer = wheelhouse(tmp_path / "second", "0.2.0")
    exchange = tmp_path / "bin/mv"
    exchange.parent.mkdir()
    exchange.write_text('#!/bin/sh\n/bin/mv "$@"\nkill -TERM $PPID\n')
    exchange.chmod(0o755)
    path = f"PATH={exchange.parent}:{os.environ['PATH']}"
    words = ["--python", sys.executable, "--root", staged, "--wheelhouse", newer]
    assert ran("env", path, INSTALLER, *words).returncode == 143
    assert version_below(staged) == "graspd 0.2.0"


def test_several_wheels_of_graspd_are_refused(staged: Path, tmp_path: Path) -> None:
    wheels, before = wheelhouse(tmp_path / "both", "0.2.0"), content(staged)
    older = next(wheelhouse(tmp_path / "older", "0.1.0").iterdir())
    older.rename(wheels / older.name)
    done = installer("--root", staged, "--wheelhouse", wheels)
    assert done.returncode == 1
    refused = f"graspd: {wheels} has several wheels of graspd: leave the one to install\n"
    assert done.stderr.endswith(refused)
    assert content(staged) == before


def test_an_uninstall_leaves_the_scenes_and_what_was_learned(staged: Path) -> None:
    session = staged / "var/lib/graspd/right.session/1.session"
    session.parent.mkdir(parents=True)
    session.write_text("{}")
    done = installer("--root", staged, "--uninstall")
    assert done.returncode == 0, done.stderr
    assert set(content(staged)) == {
        "/etc/graspd/right.toml",
        "/var/lib/graspd/right.session/1.session",
    }
    again = installer("--root", staged, "--uninstall")
    assert again.stdout.endswith("graspd: nothing to remove\n")


def test_a_purge_leaves_nothing(staged: Path, wheels: Path) -> None:
    install(staged, wheels, "--can")
    (staged / "opt/graspd/venv.new").symlink_to("venv-0")  # as an interrupted exchange leaves it
    done = installer("--root", staged, "--uninstall", "--purge")
    assert done.returncode == 0, done.stderr
    assert content(staged) == {}
    assert not [path for path in staged.rglob("*") if "graspd" in path.name]


def test_another_prefix_is_named_everywhere_and_remembered(wheels: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    install(root, wheels, "--prefix", "/srv/hand")
    unit = (root / "usr/local/lib/systemd/system/graspd@.service").read_text()
    assert "ExecStart=/srv/hand/venv/bin/graspd run" in unit
    assert "/opt/graspd" not in unit
    assert version_below(root, "/srv/hand") == "graspd 0.1.0"
    assert install(root, wheels) == "graspd: nothing to change in /srv/hand\n"
    elsewhere = installer("--root", root, "--wheelhouse", wheels, "--prefix", "/a")
    assert elsewhere.returncode == 1
    assert "uninstall that first" in elsewhere.stderr
    assert installer("--root", root, "--uninstall").returncode == 0
    assert set(content(root)) == {"/etc/graspd/right.toml"}


@pytest.mark.parametrize(
    ("prefix", "why"),
    [
        ("/home/hand", "cannot see"),
        ("/opt/../dev/shm/hand", "/dev/shm/hand is on no disk"),
        ("/srv/a/../../tmp/hand", "cannot see /tmp/hand"),
        ("/srv/../../hand", "leads out of"),
        ("/srv/link/hand", "others may write /srv/link, on the way"),
        ("/srv/away/hand", "leads out of"),
        ("/srv/shared/below/hand", "others may write /srv/shared,"),
        ("/srv/shared/below/../../hand", "others may write /srv/shared"),
        ("/srv/to-shared/hand", "others may write /srv/shared, on the way"),
        ("/srv/team/hand", "others may write /srv/team, on the way to /srv/team/hand (mode 775)"),
        pytest.param(
            "/srv/theirs/hand",
            "/srv/theirs, on the way to /srv/theirs/hand, is not root's",
            marks=pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder away"),
        ),
    ],
)
def test_an_unsafe_or_unusable_prefix_is_refused_without_changes(
    tmp_path: Path, wheels: Path, prefix: str, why: str
) -> None:
    root = tmp_path / "root"
    for name, mode in (("tmp", 0o1777), ("srv/shared/below", 0o755), ("srv/team", 0o775)):
        (root / name).mkdir(parents=True)
        (root / name).chmod(mode)
    (root / "srv/shared").chmod(0o1777)
    (root / "srv/theirs").mkdir()
    if os.geteuid() == 0:
        os.chown(root / "srv/theirs", 12345, -1)
    (root / "srv/link").symlink_to("../tmp")
    (root / "srv/away").symlink_to("/opt")
    (root / "srv/to-shared").symlink_to("shared/below")
    before = sorted(root.rglob("*"))
    done = installer("--root", root, "--wheelhouse", wheels, "--prefix", prefix)
    assert (done.returncode, sorted(root.rglob("*"))) == (1, before), done.stdout
    assert why in done.stderr


def test_the_installer_works_where_no_systemd_runs(tmp_path: Path, wheels: Path) -> None:
    (tmp_path / "copy").mkdir()
    if os.geteuid() != 0 or in_a_chroot(tmp_path / "copy", ":").returncode != 0:
        pytest.skip("only root can make a chroot of this computer's files, and not everywhere")
    python = "/mnt/python{}.{}".format(*sys.version_info[:2])  # a service sees nothing of /root
    install = f"sh {INSTALLER} --python {python} --wheelhouse {wheels} --enable right"
    script = f"""
        [ ! -e /run/systemd/system ]
        rm -rf /etc/graspd
        mkdir /mnt/base
        mount --bind {sys.base_prefix} /mnt/base
        ln -s base/bin/{Path(python).name} {python}
        {install}
        id -gn graspd
        systemctl is-enabled graspd@right
        stat -c '%U %a' /var/lib/graspd
        test -f {DEPLOY.parent}/pyproject.toml -a -f /usr/local/share/man/man1/graspd.1
        /usr/local/bin/graspd
        echo again
        {install}
        echo busy
        setpriv --reuid graspd --regid graspd --clear-groups sleep 300 &
        sh {INSTALLER} --uninstall --purge && exit 6 || [ $? = 1 ] || exit 7
        kill $!
        wait $! || true
        echo purge
        sh {INSTALLER} --uninstall --purge
        ls -d /usr/local/share /usr/local/lib
        systemctl is-enabled graspd@right && exit 4
        id graspd && exit 5
        find /etc /usr/local /var/lib /run /opt/graspd -name '*graspd*' 2>/dev/null || true
    """
    done = in_a_chroot(tmp_path / "copy", script)
    assert done.returncode == 0, done.stdout + done.stderr
    first, again, _, purge = re.split("again\n|busy\n|purge\n", done.stdout)
    assert first.splitlines()[-8:] == [
        "graspd: installed in /opt/graspd",
        "graspd: graspd@right is enabled: it runs after every boot",
        "graspd: systemd does not run here: no service is reloaded or started",
        "graspd",
        "enabled",
        "graspd 750",
        "graspd 0.1.0",
        "graspd 0.1.0",
    ], done.stdout + done.stderr
    assert again.startswith("graspd: nothing to change in /opt/graspd\n")
    assert "the user graspd stays; end its processes" in done.stderr
    assert purge.splitlines()[-3:] == ["graspd: uninstalled", "/usr/local/lib", "/usr/local/share"]
    assert content(tmp_path) == {}


def test_an_installation_in_a_writable_folder_can_be_removed(staged: Path) -> None:
    (staged / "opt").chmod(0o777)
    assert installer("--root", staged, "--uninstall").returncode == 0
    assert set(content(staged)) == {"/etc/graspd/right.toml"}


def test_unknown_extra_is_refused_before_anything_is_made(staged: Path, wheels: Path) -> None:
    before = content(staged)
    done = installer("--root", staged, "--wheelhouse", wheels, "--extras", "record,nosuch")
    assert (done.returncode, content(staged)) == (2, before), done.stdout + done.stderr
    assert "no part nosuch; it has: train " in done.stderr
    assert " record " in done.stderr


def test_the_can_option_installs_and_later_renews_the_network_file(
    staged: Path, wheels: Path
) -> None:
    install(staged, wheels, "--can")
    file = staged / NETWORK.lstrip("/")
    assert file.read_text() == (DEPLOY / "network/80-graspd-can.network").read_text()
    file.write_text("# of a former version\n")
    assert f"wrote {NETWORK}" in install(staged, wheels)


def test_the_file_of_another_program_is_not_replaced(tmp_path: Path, wheels: Path) -> None:
    foreign = tmp_path / "usr/local/bin/graspd"
    foreign.parent.mkdir(parents=True)
    foreign.write_text("theirs")
    for action in (["--wheelhouse", str(wheels)], ["--uninstall"]):
        done = installer("--root", tmp_path, *action)
        assert done.returncode == 1
        assert "was not made here" in done.stderr
    assert set(content(tmp_path)) == {"/usr/local/bin/graspd"}


def test_a_python_that_is_too_old_is_refused(tmp_path: Path, wheels: Path) -> None:
    old = tmp_path / "python3.10"
    old.write_text('#!/bin/sh\ncase $* in --version) echo "Python 3.10.0" ;; *) exit 1 ;; esac\n')
    old.chmod(0o755)
    root = tmp_path / "root"
    done = installer("--root", root, "--wheelhouse", wheels, "--python", old)
    assert done.returncode == 1
    assert "Python 3.10.0; graspd needs Python 3.11 or newer" in done.stderr
    assert content(root) == {}


@pytest.mark.parametrize(
    "arguments",
    [
        ["--unknown"],
        ["--prefix", "relative"],
        ["--prefix", "/"],
        ["--prefix", "/opt/with space"],
        ["--root", "/"],
        ["--purge"],
        ["--enable", "right", "--root", "staged"],
        ["--enable", "Right; reboot"],
        ["--extras", "a b"],
        ["--uninstall", "--rebuild"],
        ["--uninstall", "--extras", "record"],
    ],
    ids=" ".join,
)
def test_a_wrong_command_line_is_refused(arguments: list[str]) -> None:
    done = installer(*arguments)
    assert done.returncode == 2, done.stdout + done.stderr
    assert "--help" in done.stderr
