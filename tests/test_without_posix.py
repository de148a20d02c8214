"""Everything but the daemon runs where Python lacks POSIX, as by `tests/without_posix.py`."""

from __future__ import annotations

import json
import re
import signal
import sys
from pathlib import Path

import pytest

from graspd.drivers.recordings.csv_player import DEMO_DAY
from tests.daemon.processes import TIMEOUT_S, start
from tests.kit.inside import graspd
from tests.kit.programs import ran
from tests.ports import free_port

WITHOUT = (sys.executable, str(Path(__file__).with_name("without_posix.py")))
SCENES = Path(__file__).parents[1] / "deploy" / "scenes"
GRASPS = DEMO_DAY.with_name("synthetic_grasps.csv")
STREAM = DEMO_DAY.with_name("synthetic_stream.csv")
JUDGE = f"""
import graspd
grasps = graspd.read_grasps({str(GRASPS)!r})
model = graspd.load("small-session")
print(model.predict_proba(grasps, session=grasps).tolist())
print(sum(verdict.judged for verdict in graspd.judge({str(GRASPS)!r})))
"""
SAID_OF = """
import contextlib, io, json, logging
from graspd.daemon import cli

said = []
for line in lines:
    logging.getLogger().handlers = []
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = cli.main(line.split())
        except SystemExit as left:
            code = left.code
    said.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(said))
"""
TIMES = re.compile(r"in [0-9.]+ s| +[0-9]+ us")
"""Times in an output, which differ from run to run."""
NEED_LINUX = {
    "commands.run",
    *(f"publish.{name}" for name in ("listener", "porter", "questions", "sockets")),
    "watch.terminal",
}
DRIVERS_THAT_NEED_IT = {"spi.driver", "twins.spi"}


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the first rows of the demo stream, 3 s, and the first forty grasps."""
    folder = tmp_path_factory.mktemp("short")
    for path, rows in ((GRASPS, 41), (STREAM, 301)):
        lines = path.read_text().splitlines(keepends=True)[:rows]
        (folder / path.name).write_text("".join(lines))
    return folder


def without(*arguments: object) -> tuple[int, str, str]:
    """Run graspd with `arguments` without POSIX; return exit code, stdout without times, stderr."""
    done = ran(*WITHOUT, *arguments)
    return done.returncode, TIMES.sub("", done.stdout), done.stderr


def said_of(*lines: str) -> list[tuple[int, str, str]]:
    """Run each of `lines` of graspd without POSIX; return exit codes, stdout without times, and
    stderr."""
    _, out, _ = without("-c", f"lines = {lines!r}\n{SAID_OF}")
    found: list[tuple[int, str, str]] = json.loads(out)
    return found


def test_without_posix_only_modules_that_need_linux_fail_to_import() -> None:
    code, refused, problem = without("--refused")
    assert code == 0, problem
    expected = {f"graspd.daemon.{name}" for name in NEED_LINUX}
    expected |= {f"graspd.drivers.{name}" for name in DRIVERS_THAT_NEED_IT}
    assert set(refused.split()) == expected


@pytest.mark.slow
def test_commands_print_the_same_without_posix(
    short: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(short)
    lines = (
        f"replay {GRASPS.name} --verbose",
        f"replay {STREAM.name}",
        "models",
        "models small-session",
        f"check {SCENES / 'demo.toml'}",
        "scene --example can",
    )
    for line, (code, out, problem) in zip(lines, said_of(*lines), strict=True):
        assert code == 0, problem
        assert out == TIMES.sub("", graspd(*line.split()).stdout)


def test_the_library_judges_the_same_without_posix(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, problem = without("-c", JUDGE)
    assert code == 0, problem
    exec(JUDGE, {})
    assert out == capsys.readouterr().out


def test_commands_that_need_linux_say_so_in_one_line() -> None:
    for code, out, problem in said_of(
        "run demo.toml",
        "doctor demo.toml",
        "keys --help",
        "replay --publish tcp://127.0.0.1:1",
        f"session reset {SCENES / 'spi.toml'}",
    ):
        assert (code, out) == (2, "")
        assert problem.startswith("graspd: ")
        assert problem.endswith(" needs Linux\n")
        assert problem.count("\n") == 1


def test_the_web_page_is_served_without_posix_until_interrupted() -> None:
    port = free_port()
    words = ("watch", "--web", SCENES / "demo.toml", "--port", port)
    with start(*words, program=WITHOUT) as watch:
        assert watch.stdout is not None
        assert f"http://127.0.0.1:{port}/" in watch.stdout.readline()
        watch.send_signal(signal.SIGINT)
        assert watch.wait(TIMEOUT_S) == 0


@pytest.mark.slow
def test_a_model_is_trained_and_tried_without_posix(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs the extra `train`")
    words = ("--own", GRASPS, "--folds", 2, "--only", "cv", "--quiet", "--out", tmp_path)
    code, _, problem = without("train", "small-session", *words)
    assert code == 0, problem
    (made,) = tmp_path.glob("*.onnx")
    assert without("models", made)[0] == 0
