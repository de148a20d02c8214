"""All commands, by a user without rights, with unusable paths: none ends in a traceback.

`python -m tests.daemon.commands.test_places FOLDER PLACE` runs all, in FOLDER, with one such path.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from graspd.drivers.recordings.csv_player import DEMO_TABLE
from tests.kit.inside import graspd

WITHOUT_RIGHTS = ("setpriv", "--bounding-set=-all", "--inh-caps=-all")
"""Words that run a command without root's privileges, as a user who owns root's files."""
PLACES = ("missing", "shut/below", "folder", "/dev/null", "dangling", "loop")
DEMO = f'[tactile]\ndriver = "replay"\npace = "fast"\nrecordings = ["{DEMO_TABLE}"]\n'
PALM = '[tactile]\ndriver = "palm"\nsource = "udp://127.0.0.1:0"\n'
FILES = (
    DEMO.replace(str(DEMO_TABLE), "PLACE"),
    f'{DEMO}[model]\npath = "PLACE"\n',
    f'{DEMO}[session]\nkeep = true\nfolder = "PLACE"\n',
    f'{DEMO}[record]\ndirectory = "PLACE"\n',
    f'{DEMO}[publish]\nendpoint = "ipc://PLACE"\n[ask]\nendpoint = "ipc://PLACE.ask"\n',
    f'{DEMO}[publish]\nendpoint = "ipc://PLACE/v"\n',
    f'{DEMO}[curve]\nsecret_key = "PLACE"\nclients = "folder"\n',
    f'{DEMO}[curve]\nsecret_key = "d.key_secret"\nclients = "PLACE"\n',
    f'{PALM}[joints]\ndriver = "palm"\ncalibration = "PLACE"\n',
)
"""Scenes that name one unusable path, `PLACE`. `graspd run` ends on them by itself."""
PORTS = (
    '[tactile]\ndriver = "spi"\nport = "PLACE"\n',
    '[tactile]\ndriver = "can"\ninterface = "slcan"\nchannel = "PLACE"\n',
)
LOOKS = ("check SCENE", "doctor SCENE --listen 0.1")
SESSION = ("session show SCENE", "session reset SCENE")
COMMANDS = (
    "check PLACE",
    "doctor PLACE --listen 0.1",
    "run PLACE",
    "replay PLACE",
    "replay --scene PLACE log",
    "replay --model PLACE",
    "replay --session PLACE",
    "watch PLACE --web",
    "watch --keys PLACE --server-key PLACE --web",
    "models PLACE",
    "models PLACE.onnx",
    "session show PLACE",
    "session seed PLACE TABLE",
    "session settle PLACE",
    "keys make PLACE",
    "keys make name --dir PLACE",
    "keys list --dir PLACE",
    "data --to PLACE --from PLACE",
    "export-grasps PLACE --out out.csv",
    "export-grasps TABLE --out PLACE --force",
    "train small-session --own PLACE --out out",
    "train small-session --own TABLE --out PLACE --folds 1000",
    "evaluate small-session --own PLACE --out out",
    "evaluate --table PLACE --out PLACE",
    "report worth --data PLACE",
)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("place", PLACES)
def test_no_command_ends_in_a_traceback_on_unusable_paths(tmp_path: Path, place: str) -> None:
    can_lose = os.geteuid() == 0 and shutil.which(WITHOUT_RIGHTS[0])
    before = WITHOUT_RIGHTS if can_lose else ()
    walk = (sys.executable, "-m", "tests.daemon.commands.test_places", str(tmp_path), place)
    walked = subprocess.run([*before, *walk], capture_output=True, text=True, check=False)
    assert walked.returncode == 0, walked.stdout[-500:] + walked.stderr
    assert walked.stdout.count("\n") > len(COMMANDS)
    assert "Traceback" not in walked.stdout + walked.stderr, walked.stdout + walked.stderr
    is_denied = place == "shut/below" and (before or os.geteuid() != 0)
    assert ("you may not reach the port" in walked.stdout) == bool(is_denied)


def furnish(folder: Path) -> None:
    """Make the unusable paths of `PLACES` in `folder`."""
    (folder / "folder").mkdir()
    (folder / "shut").mkdir()
    (folder / "shut/below").touch()
    (folder / "shut").chmod(0)
    (folder / "dangling").symlink_to("nowhere")
    (folder / "loop").symlink_to("loop")


def run(line: str) -> None:
    """Run a command of graspd; print it, its exit code and the start of its output."""
    sys.stdout.write(f"{line}: ")
    result = graspd(*line.split())
    sys.stdout.write(f"{result.returncode} {(result.stderr or result.stdout)[:200]!r}\n")


def main(folder: Path, place: str) -> None:
    """Run all commands in `folder`, with `place` as each path."""
    furnish(folder)
    os.chdir(folder)
    for command in COMMANDS:
        run(command.replace("PLACE", place).replace("TABLE", str(DEMO_TABLE)))
    for kind in (*FILES, *PORTS):
        scene = kind.replace("PLACE", str(folder / place))
        if "[publish]" not in scene:
            scene += f'[publish]\nendpoint = "ipc://{folder}/v"\n'
        Path("scene.toml").write_text(scene)
        commands = LOOKS if kind in PORTS else (*LOOKS, "run SCENE")
        for command in (*commands, *SESSION) if "[session]" in kind else commands:
            run(command.replace("SCENE", "scene.toml"))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
