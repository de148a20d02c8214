"""References of the commands: stdout, stderr and exit code, `references/commands/<name>.txt`.

Each runs in this process, in a folder of its own with the files that `_prepare` makes.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import re
import shlex
import shutil
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from subprocess import CompletedProcess
from tempfile import TemporaryDirectory
from typing import Final

import pytest

from graspd.drivers.recordings.csv_player import DEMO_DAY, DEMO_RECORDING, DEMO_TABLE
from tests.kit.inside import graspd
from tests.process_replay.judging import Case, run
from tests.process_replay.streams import CHECKOUT, demo

FOLDER: Final = CHECKOUT / "tests" / "references" / "commands"
LONG: Final = 12_000
"""Most characters of an output that is kept as text; a longer one is kept as a checksum."""
TOLERANCE: Final = 1.1e-3
"""Largest difference of numbers with a point, absolute or relative: `p_slip` has three digits."""

COMMANDS: Final[Mapping[str, str]] = {
    "none": "",
    "unknown": "rnu",
    "help": "--help",
    "version": "--version",
    "option-first": "--json check demo.toml",
    "mistyped": "--verison",
    "wrong-option": "check demo.toml --jsn",
    "run": "run demo.toml",
    "run-absent": "run absent.toml",
    "run-wrong-key": "run wrong.toml",
    "run-wrong-recording": "run not-there.toml",
    "run-wrong-fingers": "run fingers.toml",
    "run-no-folder": "run no-folder.toml",
    "run-no-scene": "run",
    "replay-demo": "replay",
    "replay-stream": "replay stream.csv",
    "replay-json": "replay few.csv --json",
    "replay-table": "replay table.csv --outcomes --max-slip-when-stable 0.1 --warm-up 5",
    "replay-lifted": "replay day.csv --outcomes --only-lifted --min-confidence 0.6 --verbose",
    "replay-no-session": "replay table.csv --session off --model cnn1",
    "replay-recorded": "replay recorded.mcap",
    "replay-absent": "replay absent.csv",
    "replay-absent-table": "replay bts3v2_palm_down.csv",
    "replay-no-recording": "replay demo.toml",
    "replay-no-model": "replay table.csv --model small-sesion",
    "replay-no-outcomes": "replay recorded.mcap --max-slip-when-stable 0.1",
    "replay-wait": "replay table.csv --wait 3",
    "replay-only-lifted": "replay table.csv --only-lifted",
    "replay-warm-up": "replay table.csv --warm-up 3",
    "replay-scene": "replay table.csv --scene demo.toml",
    "replay-recorded-scene": "replay recorded.mcap --scene absent.toml",
    "replay-session-absent": "replay table.csv --session absent.json",
    "replay-speed": "replay --speed nan",
    "replay-publish": "replay --publish tcp://1.2.3.4:5",
    "replay-publish-any-path": "replay --publish ipc://*",
    "replay-publish-any-port": "replay --publish tcp://127.0.0.1:*",
    "replay-nobody": "replay --publish ipc://nobody --wait 0.1",
    "replay-warm-up-below-0": "replay --max-slip-when-stable 0.1 --warm-up -1",
    "replay-risk-untold": "replay table.csv --max-slip-when-stable 0.1",
    "replay-mixed": "replay table.csv stream.csv",
    "replay-every": "replay recorded.mcap --gate every",
    "replay-mistyped": "replay --max-slip-when-stabel=0.1",
    "replay-mistyped-gate": "replay --gate setled",
    "check": "check demo.toml can.toml palm.toml spi.toml two-fingers.toml",
    "check-json": "check demo.toml --json",
    "check-all-wrong": "check wrong.toml absent.toml",
    "doctor-absent": "doctor absent.toml",
    "models": "models",
    "models-card": "models small-session",
    "models-json": "models small-session --json",
    "models-unknown": "models cnn2",
    "models-mistyped": "models smal-session",
    "train-mistyped": "train smal-session",
    "models-no-file": "models absent.onnx",
    "session-seed": "session seed kept.toml table.csv",
    "session-show": "session show kept.toml",
    "replay-session": "replay day.csv --session session/1.session --verbose",
    "session-reset": "session reset kept.toml",
    "session-none": "session show kept.toml",
    "session-no-model": "session show cnn1.toml",
    "session-mistyped": "session shwo kept.toml",
    "keys-make": "keys make arm --dir keys",
    "keys-make-again": "keys make arm --dir keys",
    "keys-list": "keys list --dir keys",
    "schema": "schema",
    "scene-example": "scene --example spi",
    "export-grasps": "export-grasps recorded.mcap --out grasps.csv",
    "export-grasps-there": "export-grasps recorded.mcap --out grasps.csv",
    "export-grasps-table": "export-grasps table.csv --out other.csv",
    "data-absent": "data --from nowhere",
    "manual": "manual",
    "report-unknown": "report accuracy",
    "watch-wrong-port": "watch --port 0",
    "watch-no-terminal": "watch --connect ipc:///tmp/x",
    "watch-wrong-endpoint": "watch --connect nonsense",
    "watch-no-server-key": "watch --connect tcp://127.0.0.1:1 --keys x",
    "watch-server-key-alone": "watch --connect ipc:///tmp/x --server-key x",
    "watch-port-alone": "watch --connect ipc:///tmp/x --port 9",
    "watch-web-wrong-port": "watch --connect ipc:///tmp/x --port 0 --web",
    "watch-both": "watch --connect ipc:///tmp/x demo.toml",
    "watch-absent": "watch absent.toml",
    "watch-nine": "watch" + 9 * " --connect ipc:///tmp/x",
    "twin-unknown": "twin hand",
    "twin-drop": "twin spi --drop 2",
    "twin-dead": "twin spi --dead th",
    "twin-can-id": "twin can --arbitration-id 0x20000000",
    "twin-mistyped": "twin spi --stuk-clock",
    "twin-other-fault": "twin palm --one-byte-at-a-time",
    **{
        f"help-{words.replace(' ', '-')}": f"{words} --help"
        for words in (
            *("run", "replay", "watch", "scene", "check", "doctor", "twin", "data", "schema"),
            *("models", "session", "export-grasps", "keys", "train", "evaluate", "report"),
            *("manual", "twin spi", "twin can", "twin palm", "twin joints"),
            *("session show", "session reset", "session seed", "keys make", "keys list"),
        )
    },
}
"""Command lines by the names of their references, run in this order."""
NAMES: Final = tuple(COMMANDS)

DEMO_SCENE: Final = (
    '[tactile]\ndriver = "replay"\npace = "fast"\nrecordings = ["stream.csv"]\n'
    '[publish]\nendpoint = "ipc://{folder}/graspd"\n[gate]\nmax_age_ms = 10000\n'
)
SCENES: Final[Mapping[str, str]] = {
    "demo": DEMO_SCENE,
    "wrong": DEMO_SCENE.replace("[gate]", "[gaet]"),
    "not-there": DEMO_SCENE.replace("stream.csv", "absent.csv"),
    "fingers": DEMO_SCENE + '[hand]\nfingers = ["th", "mf", "ff"]\n',
    "no-folder": DEMO_SCENE.replace("/graspd", "/absent/graspd"),
    "cnn1": DEMO_SCENE + '[model]\nname = "cnn1"\n[learn]\nenabled = false\n',
    "kept": DEMO_SCENE + '[session]\nkeep = true\nfolder = "session"\n',
}

_MASKS: Final = (
    (r" +[0-9]+ us\b", " * us"),
    (r"(?<=after )[0-9.]+(?= s: )", "*"),
    (r"(readings|verdicts) in [0-9.]+ s", r"\1 in * s"),
    (r'"(p50|p99|max|wall_s|t|t_mono_ns|age_ms|latency_us)": ?[0-9.e+-]+', r'"\1": *'),
    (r'"boot_id": ?"[0-9a-f]{32}"', '"boot_id": *'),
    (r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d, \d+ minutes ago", "*"),
    (
        r"\b(graspd|Python|libzmq|onnxruntime|numpy|pyzmq|python-can|pyserial)"
        r" [0-9][\w.+]*( at \S+)?",
        r"\1 *",
    ),
    (r"(?<=  arm  )\S{40}", "*"),
)


NUMBER: Final = re.compile(r"(?<=[\[:, ])-?\d+(?:\.\d+(?:e[-+]?\d+)?|e[-+]?\d+)(?=[\],} \n]|$)")
"""Pattern of a number with a point or exponent, which may differ a little; others must be equal."""


def execute(arguments: Sequence[str], folder: Path) -> CompletedProcess[str]:
    """Run a graspd command in this process, with `folder` as working and home folder.

    Help texts have a fixed width.
    """
    with contextlib.chdir(folder), pytest.MonkeyPatch.context() as patched:
        patched.setenv("COLUMNS", "80")
        patched.setenv("HOME", str(folder))
        patched.setattr("os.nice", lambda _more: 0)
        return graspd(*arguments)


def path_of(name: str) -> Path:
    """Return the file of a reference."""
    return FOLDER / f"{name}.txt"


def made(name: str) -> str:
    """Return the text of a reference as it would be now."""
    return _all()[name]


@cache
def _all() -> dict[str, str]:
    """Return the texts of all references. Some commands use files that earlier ones write."""
    found = {}
    with TemporaryDirectory() as name:
        folder = Path(name)
        _prepare(folder)
        for command, line in COMMANDS.items():
            found[command] = _text(line, execute(shlex.split(line), folder), folder)
    return found


def _prepare(folder: Path) -> None:
    """Make the files in `folder` that the commands use: recordings, tables, scenes, keys."""
    for name, source, rows in (
        ("stream.csv", DEMO_RECORDING, 700),
        ("table.csv", DEMO_TABLE, 60),
        ("few.csv", DEMO_TABLE, 12),
        ("day.csv", DEMO_DAY, 40),
    ):
        lines = source.read_text().splitlines(keepends=True)
        (folder / name).write_text("".join(lines[: rows + 1]))
    for name, text in SCENES.items():
        (folder / f"{name}.toml").write_text(text.replace("{folder}", str(folder)))
    for name in ("can", "palm", "spi", "two-fingers"):
        shutil.copy(CHECKOUT / "deploy" / "scenes" / f"{name}.toml", folder)
    (folder / "keys").mkdir()
    case = Case(readings=demo, joints=True, tells=True, readings_max=1400)
    run(case, record_in=folder / "record")
    for path in (folder / "record").glob("*.mcap"):
        path.rename(folder / "recorded.mcap")


def _text(line: str, done: CompletedProcess[str], folder: Path) -> str:
    parts = [f"$ graspd {line}\nexit code {done.returncode}\n"]
    for name, output in (("stdout", done.stdout), ("stderr", done.stderr)):
        text = output.replace(str(folder), "FOLDER").replace(str(CHECKOUT), "CHECKOUT")
        for pattern, instead in _MASKS:
            text = re.sub(pattern, instead, text)
        if len(text) > LONG:
            text = f"sha256 {hashlib.sha256(text.encode()).hexdigest()}\n"
        if text:
            parts.append(f"--- {name}\n{text}")
    return "".join(parts)


def differences(before: str, now: str) -> list[str]:
    """Return where two texts differ, line by line."""
    return lines_apart(before.splitlines(), now.splitlines(), TOLERANCE)


def lines_apart(before: Sequence[str], now: Sequence[str], tolerance: float) -> list[str]:
    """Return where lines differ, as text. Numbers with a point may differ by `tolerance`,
    absolute or relative."""
    found = [
        f"line {number}: {was}\n  became: {is_now}"
        for number, (was, is_now) in enumerate(zip(before, now, strict=False), start=1)
        if was != is_now and not _alike(was, is_now, tolerance)
    ]
    if len(before) != len(now):
        found.append(f"{len(before)} lines became {len(now)}")
    return found


def _alike(was: str, is_now: str, tolerance: float) -> bool:
    if NUMBER.sub("*", was) != NUMBER.sub("*", is_now):
        return False
    pairs = zip(NUMBER.findall(was), NUMBER.findall(is_now), strict=True)
    return all(
        math.isclose(float(left), float(right), rel_tol=tolerance, abs_tol=tolerance)
        for left, right in pairs
    )
