"""The demo's verdict `stable` is in doubt until outcomes in its recording support it."""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path

import pytest

from graspd.daemon.judge.reasons import Decision
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.publish.companion import PublishedVerdict
from graspd.daemon.publish.messages import Verdict
from graspd.daemon.run import runner
from graspd.daemon.run.runner import RunLog
from graspd.daemon.trust.lift_book import Report
from graspd.daemon.watch.figures import doubt
from graspd.drivers.recordings.csv_player import SHOW_RECORDING
from graspd.drivers.twins.grasps.whole_grasps import PALM_RATE_HZ

SCENE = Path(__file__).parents[3] / "deploy" / "scenes" / "demo.toml"
LOOPS = 2
"""Number of times that the recording is played, together less than two minutes."""


class Heard(RunLog):
    """Keeps verdicts and outcomes in place of counting verdicts."""

    def __init__(self) -> None:
        super().__init__()
        self.verdicts: list[Verdict] = []
        self.told: dict[int, bool] = {}
        """For each grasp whose outcome was told, whether it slipped."""

    def on_verdict(self, published: PublishedVerdict) -> None:
        self.verdicts.append(published.verdict)

    def on_outcome(self, report: Report) -> None:
        self.told[report.grasp.grasp] = report.outcome == "slip"


def test_the_demos_stable_is_supported_by_outcomes_within_two_minutes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings = ", ".join([f'"{SHOW_RECORDING}"'] * LOOPS)
    text = SCENE.read_text()
    for former, instead in (
        ("loop = true", 'pace = "fast"'),
        ('"../../drivers/recordings/demo/synthetic_show.csv"', recordings),
        ("/tmp/graspd-demo", f"{tmp_path}/v"),
    ):
        assert former in text
        text = text.replace(former, instead)
    scene = tmp_path / "scene.toml"
    scene.write_text(text + "[gate]\nmax_age_ms = 10000\n")
    heard = Heard()
    monkeypatch.setattr(runner, "RunLog", lambda: heard)
    with StopSignal() as stop:
        runner.run_scene(scene, stop)
    verdicts = heard.verdicts
    with SHOW_RECORDING.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(verdicts) == LOOPS * len(rows)
    assert LOOPS * float(rows[-1]["t"]) < 120.0
    stable = [verdict for verdict in verdicts if verdict.verdict is Decision.STABLE]
    assert doubt(stable[0]) is not None  # hollow at first
    assert doubt(stable[-1]) is None
    # The outcomes are those of the recording: of `stable` and supervised lifts, each told once.
    slipped = {}
    for row, verdict in zip(rows * LOOPS, verdicts, strict=True):
        if verdict.verdict is Decision.STABLE or verdict.supervised:
            slipped[verdict.grasp] = row["slipped"] == "1"
    assert heard.told == slipped
    slipped.pop(verdicts[-1].grasp, None)  # its outcome is told after the last verdict
    lifted = {verdict.grasp for verdict in stable} & slipped.keys()
    last = verdicts[-1]
    assert last.risk is not None
    assert last.outcomes == len(slipped)
    assert last.risk.lifts == len(lifted)
    assert last.risk.slips == sum(slipped[grasp] for grasp in lifted)
    held = Counter(verdict.grasp for verdict in verdicts if verdict.contact)
    assert min(held[grasp] for grasp in slipped) > 2.0 * PALM_RATE_HZ
