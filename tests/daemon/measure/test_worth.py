"""`graspd report worth`: its figures by hand, and that it runs from table to picture."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch")
pytest.importorskip("matplotlib")

from daemon.commands.report import add_arguments
from daemon.measure import streams as module
from daemon.measure import worth
from daemon.measure.streams import Plan, Stream, live, streams
from daemon.measure.worth import ALLOWED, ALONE, LEARNING, PUBLISHED, RISK, draw, measured
from daemon.trust.risk import RiskLimits
from models.training.data.datasets import Grasps, read_all
from models.training.systems.system import System

GRASPS = 300


def stream(seed: int = 0) -> Stream:
    """A network whose margin knows little, and features that tell the outcome."""
    random = np.random.default_rng(seed)
    slipped = random.random(GRASPS) < 0.5
    features = random.normal(0.0, 1.0, (GRASPS, 6)).astype(np.float32)
    features[:, 0] = np.where(slipped, 1.0, -1.0) * random.uniform(0.5, 2.0, GRASPS)
    margins = random.normal(0.0, 1.0, GRASPS)
    return Stream("A", "palm_45", margins, features, np.full(GRASPS, -1.0), slipped)


def test_the_figures_are_counted_over_all_streams_by_outcomes_told() -> None:
    several = [stream(seed) for seed in range(30)]
    curves = measured(several)
    slipped = np.array([one.slipped for one in several])
    alone = np.array([one.margins < 0.0 for one in several])
    for index, part in enumerate((slice(0, 10), slice(10, 25), slice(25, 50))):
        own, published = curves[ALONE][index], curves[PUBLISHED][index]
        assert published.slips_among_stable == pytest.approx(slipped[:, part].mean())
        assert published.coverage == 1.0
        said, slips = alone[:, part], slipped[:, part]
        assert own.slips_among_stable == pytest.approx((said & slips).sum() / said.sum())
        assert own.coverage == pytest.approx((said & ~slips).sum() / (~slips).sum())
    first, last = curves[LEARNING][0], curves[LEARNING][-1]
    assert last.slips_among_stable < 0.1 < 0.2 < first.slips_among_stable
    assert curves[RISK][-1].coverage > 0.5 > curves[RISK][0].coverage
    assert [point.told for point in curves[RISK]] == [5, 17, 37, 62, 87, 125, 175, 225, 275]


def test_what_is_said_of_a_grasp_does_not_know_its_outcome() -> None:
    whole, limits = stream(), RiskLimits(ALLOWED, warm_up=50, explore=0.05)
    turned = whole.slipped.copy()
    turned[100:] ^= True
    for every in (True, False):
        as_it_was = live(whole, limits, every=every)
        otherwise = live(replace(whole, slipped=turned), limits, every=every)
        np.testing.assert_array_equal(as_it_was.p_slip[:101], otherwise.p_slip[:101])
        assert not np.array_equal(as_it_was.p_slip, otherwise.p_slip)
        assert as_it_was.within
        assert otherwise.within


def test_streams_are_of_objects_and_poses_that_their_networks_did_not_see(
    bts3_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grasps = read_all(bts3_dir)
    grasps = grasps.rows(np.arange(0, len(grasps), 12))
    tables = [grasps.files[table].name for table in grasps.table_of]
    of = {
        one.tobytes(): kind
        for one, kind in zip(grasps.counts, zip(grasps.objects, tables, strict=True), strict=True)
    }
    judged = module.judged

    def watched(
        system: System, seen: Grasps, several: Sequence[NDArray[np.uint16]], seed: int
    ) -> list[tuple[NDArray[np.float64], NDArray[np.float32]]]:
        for counts in several:
            objects, poses = zip(*(of[reading.tobytes()] for reading in counts), strict=True)
            assert set(objects).isdisjoint(seen.objects)
            assert set(poses).isdisjoint(file.name for file in seen.files if file.rows)
        return judged(system, seen, several, seed)

    monkeypatch.setattr(module, "judged", watched)
    plan = Plan(seeds=1, folds=2, epochs=1)
    found = list(streams(grasps, plan))
    assert {(one.protocol, one.table) for one in found} == {
        ("A", "palm_45"),
        *((protocol, table) for protocol in "BC" for table in ("palm_down", "palm_side")),
    }


@pytest.fixture(scope="module")
def pictures() -> tuple[str, str]:
    """Drawn twice, and before a test counts descriptors: matplotlib keeps its fonts open."""
    curves = measured([stream(seed) for seed in range(30)])
    return draw(curves), draw(curves)


def test_the_picture_has_every_method_and_is_drawn_the_same_again(
    pictures: tuple[str, str],
) -> None:
    first, second = pictures
    assert first == second
    assert first.startswith("<?xml")
    for colour in ("#c65d21", "#9a8f2f", "#1f6f8b", "#123f50"):
        assert colour in first


@pytest.fixture(scope="module")
def folder(bts3_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the report, made in this process: it starts slowly."""
    out = tmp_path_factory.mktemp("worth")
    assert worth.run(options("--data", str(bts3_dir), "--out", str(out), "--quick")) == 0
    return out


def options(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return parser.parse_args(["worth", *arguments])


def test_from_tables_to_picture(folder: Path) -> None:
    text = (folder / "worth.md").read_text()
    for name in (PUBLISHED, ALONE, LEARNING, RISK):
        assert re.search(rf"\| {re.escape(name)} +\| (\d+|nan) / \d+ ", text)
    assert (folder / "worth.svg").read_text().count("<svg") == 1


def test_a_folder_without_tables_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert worth.run(options("--data", str(tmp_path))) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
