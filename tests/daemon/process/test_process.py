"""What a process of graspd must survive: signals at any time, and streams of any kind."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from graspd.daemon.process.signals import StopSignal
from graspd.daemon.process.text import printable
from graspd.drivers.recordings.csv_player import DEMO_TABLE, SHOW_RECORDING
from tests.daemon.processes import GRASPD, TIMEOUT_S, start, wait_for
from tests.kit.crowd import SELECT_MAX, crowded
from tests.kit.programs import ran
from tests.kit.scenes import demo_scene

ROOT = Path(__file__).parents[3]
DEMO_SCENE = ROOT / "deploy" / "scenes" / "demo.toml"


def python(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run `code`, then graspd with `arguments`, in one process."""
    code += "\nimport sys\nfrom graspd.daemon.__main__ import main\nsys.exit(main())\n"
    return ran(sys.executable, "-c", code, *arguments, cwd=ROOT)


AT_IMPORT = """
import os, signal, sys
class Finder:
    def find_spec(name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder)
"""
"""Code that interrupts its process, as Ctrl-C does, when `module` is imported."""


@pytest.mark.parametrize("module", ["graspd.daemon.cli", "onnxruntime"])
def test_ctrl_c_while_loading_exits_with_130_and_no_output(module: str) -> None:
    result = python(AT_IMPORT.format(module=module), "replay")
    assert (result.returncode, result.stdout, result.stderr) == (130, "", "")


def test_ctrl_c_while_a_driver_is_imported_stops_the_daemon(tmp_path: Path) -> None:
    scene = demo_scene(tmp_path, "loop = true")
    result = python(AT_IMPORT.format(module="graspd.drivers.recordings.csv_player"), "run", scene)
    assert result.returncode == 0, result.stderr
    assert "Traceback" not in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]


FROZEN = """
import atexit, gc
atexit.register(lambda: print(gc.isenabled(), gc.get_freeze_count() > 10_000))
"""


def test_loaded_modules_are_frozen_out_of_garbage_collection() -> None:
    result = python(FROZEN, "check", DEMO_SCENE)
    assert result.stdout.splitlines()[-1] == "True True"


LOADED = """
import sys
from graspd.daemon.run.loop import Loop
run = Loop.run
def noting(self):
    before = set(sys.modules)
    ended = run(self)
    print(sorted(set(sys.modules) - before))
    return ended
Loop.run = noting
"""


def test_the_loop_loads_no_module_while_it_runs(tmp_path: Path) -> None:
    keys = 'pace = "fast"\noutcomes = true'
    scene = demo_scene(tmp_path, keys, recording=SHOW_RECORDING)
    assert python(LOADED, "run", scene).stdout.splitlines() == ["[]"]


def test_graspd_loads_no_plugins_of_pydantic(tmp_path: Path) -> None:
    info = tmp_path / "stranger-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[pydantic]\nstranger = stranger:PLUGIN\n")
    (tmp_path / "stranger.py").write_text(f"open({str(tmp_path / 'was here')!r}, 'w')")
    folders = {"PYTHONPATH": f"{ROOT}:{tmp_path}"}
    ran(*GRASPD, "check", DEMO_SCENE, env=os.environ | folders, check=True)
    assert not (tmp_path / "was here").exists()


WHILE_LEAVING = """
import os, signal
from graspd.daemon.process.signals import StopSignal
leave = StopSignal.__exit__
def leave_and_interrupt(self, *error):
    os.kill(os.getpid(), signal.SIGINT)
    leave(self, *error)
    os.kill(os.getpid(), signal.SIGINT)
StopSignal.__exit__ = leave_and_interrupt
"""
AT_THE_VERY_END = """
import atexit, os, signal
atexit.register(os.kill, os.getpid(), signal.SIGINT)
"""


@pytest.mark.parametrize(
    ("code", "expected"), [(WHILE_LEAVING, 130), (AT_THE_VERY_END, 0)], ids=["leaving", "end"]
)
def test_ctrl_c_while_leaving_ends_without_a_traceback(code: str, expected: int) -> None:
    result = python(code, "replay")
    assert (result.returncode, result.stderr) == (expected, "")


def test_repeated_sigints_stop_a_replay_and_leave_no_files(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/graspd"
    with start("replay", "--loop", "--speed", 1, "--json", "--publish", endpoint) as process:
        wait_for(tmp_path / "graspd")
        while process.poll() is None:
            process.send_signal(signal.SIGINT)
            time.sleep(0.001)  # else it may do nothing but receive signals
        _, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode in (130, -signal.SIGINT)  # both are 130 to a shell
    assert "Traceback" not in errors
    assert list(tmp_path.iterdir()) == []


def test_run_raises_the_soft_descriptor_limit_to_the_hard_one(tmp_path: Path) -> None:
    scene = demo_scene(tmp_path, "loop = true")
    with start("run", scene, before=("prlimit", "--nofile=512:8192")) as process:
        wait_for(tmp_path / "v")
        limits = resource.prlimit(process.pid, resource.RLIMIT_NOFILE)
        process.terminate()
    assert limits == (8192, 8192)


def redirected(redirection: str, *arguments: object, **environment: str) -> tuple[int, str, str]:
    """Run graspd with `arguments` by a shell with a redirection, and with `environment` added.

    Return exit code, output and errors.
    """
    result = subprocess.run(
        ["sh", "-c", f'exec "$@" {redirection}', "sh", *GRASPD, *map(str, arguments)],
        capture_output=True,
        timeout=TIMEOUT_S,
        check=False,
        env=os.environ | environment,
        cwd=ROOT,
    )
    return result.returncode, result.stdout.decode("latin-1"), result.stderr.decode()


@pytest.mark.parametrize(
    ("arguments", "redirection", "why"),
    [
        (["replay"], ">/dev/full", "No space left on device"),
        (["replay"], ">&-", "Bad file descriptor"),
        (["--help"], ">/dev/full", "No space left on device"),
    ],
)
def test_a_failed_write_to_stdout_is_one_line_on_stderr(
    arguments: list[str], redirection: str, why: str
) -> None:
    code, _, errors = redirected(redirection, *arguments)
    assert errors == f"graspd: cannot write to standard output: {why}\n"
    assert code == 1


def test_a_daemon_runs_with_all_standard_streams_closed(tmp_path: Path) -> None:
    scene = demo_scene(tmp_path, 'pace = "fast"')
    assert redirected("<&- >&- 2>&-", "run", scene) == (0, "", "")


@pytest.mark.parametrize("redirection", ["2>&-", "2>/dev/full"])
def test_a_closed_or_full_stderr_does_not_change_the_exit_code(redirection: str) -> None:
    assert redirected(redirection, "run", "absent.toml") == (2, "", "")


def test_a_broken_pipe_other_than_stdout_is_not_silent() -> None:
    code = """
import graspd.daemon.commands.texts
def run(args):
    raise BrokenPipeError(32, "the serial line broke")
graspd.daemon.commands.texts.run = run
"""
    result = python(code, "schema")
    assert result.returncode == 1
    assert "the serial line broke" in result.stderr


def recording_of(folder: Path, name: str) -> Path:
    """Write the demo recording with the first object called `name`; return its path."""
    header, first, *rest = DEMO_TABLE.read_text().splitlines()
    recording = folder / "grasps.csv"
    text = "\n".join([header, name + first[first.index(",") :], *rest]) + "\n"
    recording.write_text(text, encoding="utf-8", newline="")
    return recording


def test_characters_that_the_output_encoding_lacks_are_escaped(tmp_path: Path) -> None:
    recording = recording_of(tmp_path, "größe 漢")
    code, output, errors = redirected(
        "", "replay", "--verbose", recording, PYTHONIOENCODING="latin-1"
    )
    assert (code, errors) == (0, "")
    assert "  größe \\u6f22 (was " in output.splitlines()[0]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("größe", "größe"),
        ("a\nb", r"a\nb"),
        ("\x1b[0m", r"\x1b[0m"),
        ("\u202egum", r"\u202egum"),
        ("\udcff", r"\udcff"),
        ("\U000e0001", r"\U000e0001"),
    ],
)
def test_only_unprintable_characters_are_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_waiting_for_a_signal_works_above_descriptor_1024() -> None:
    with crowded(), StopSignal() as stop:
        assert stop.fileno() >= SELECT_MAX
        assert not stop.wait(0.0)
        signal.raise_signal(signal.SIGTERM)
        assert stop.wait(100.0)


@pytest.mark.parametrize(("handler", "ends"), [(signal.SIG_DFL, True), (signal.SIG_IGN, False)])
def test_a_hangup_stops_unless_it_is_ignored(handler: signal.Handlers, ends: bool) -> None:
    former = signal.signal(signal.SIGHUP, handler)
    try:
        with StopSignal() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert (stop.received is signal.SIGHUP) is ends
    finally:
        signal.signal(signal.SIGHUP, former)
