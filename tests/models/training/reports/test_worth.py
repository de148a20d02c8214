"""`graspd report worth`: its figures by hand, and that it runs from table to picture."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")
pytest.importorskip("matplotlib", reason="needs the extra `report`")

from graspd.models import zoo
from graspd.models.training.arrays import Ints
from graspd.models.training.data.datasets import Grasps, read_all
from graspd.models.training.fitting.trained import Trained, train
from graspd.models.training.reports import streams as module
from graspd.models.training.reports.reliability import fitted_scales, slope
from graspd.models.training.reports.streams import Stream, judged, live, streams
from graspd.models.training.reports.worth import (
    ALLOWED,
    ALONE,
    LEARNING,
    PUBLISHED,
    RISK,
    limits,
    measured,
    risk_figures,
)
from graspd.models.training.systems.registry import System
from graspd.models.trust.learner import SCALE
from graspd.models.trust.risk import RiskLimits
from tests.kit.inside import graspd, refused
from tests.models.training.samples import table, write, write_sessions

GRASPS = 300
LIMITS = limits(ALLOWED)


def stream(seed: int = 0) -> Stream:
    """Return a stream with margins unrelated to outcomes, and a first feature that shows them."""
    random = np.random.default_rng(seed)
    slipped = random.random(GRASPS) < 0.5
    features = random.normal(0.0, 1.0, (GRASPS, 6)).astype(np.float32)
    features[:, 0] = np.where(slipped, 1.0, -1.0) * random.uniform(0.5, 2.0, GRASPS)
    rows = {
        "session": seed,
        "split": 0,
        "fold": seed,
        "day": "A",
        "table": "palm_45",
        "order": "random",
        "grasp": np.arange(GRASPS),
        "margin": random.normal(0.0, 1.0, GRASPS),
        "refused": False,
        "published": -1.0,
        "slipped": slipped,
    }
    return Stream(pd.DataFrame(rows), features)


def changed(one: Stream, **columns: object) -> Stream:
    return replace(one, rows=one.rows.assign(**columns))


def lived(several: Sequence[Stream], limits: RiskLimits, *, every: bool) -> pd.DataFrame:
    return pd.concat([live(one, limits, every=every) for one in several], ignore_index=True)


def test_the_figures_are_counted_over_all_streams_by_grasp() -> None:
    several = [stream(seed) for seed in range(30)]
    learning = lived(several, RiskLimits(), every=True)
    curves = measured(learning, lived(several, LIMITS, every=False))
    slipped = np.array([one.rows["slipped"] for one in several])
    alone = np.array([one.rows["margin"] < 0.0 for one in several])
    for index, part in enumerate((slice(0, 10), slice(10, 25), slice(25, 50))):
        own, published = curves[ALONE][index], curves[PUBLISHED][index]
        assert published["slips_among_stable"] == pytest.approx(slipped[:, part].mean())
        assert published["coverage"] == 1.0
        said, slips = alone[:, part], slipped[:, part]
        assert own["slips_among_stable"] == pytest.approx((said & slips).sum() / said.sum())
        assert own["coverage"] == pytest.approx((said & ~slips).sum() / (~slips).sum())
    first, last = curves[LEARNING][0], curves[LEARNING][-1]
    assert last["slips_among_stable"] < 0.1 < 0.2 < first["slips_among_stable"]
    assert curves[RISK][-1]["coverage"] > 0.5 > curves[RISK][0]["coverage"]
    assert [point["grasps"] for point in curves[RISK]] == [5, 17, 37, 62, 87, 125, 175, 225, 275]


def test_a_verdict_does_not_know_the_outcome_of_its_grasp() -> None:
    whole = stream()
    turned = whole.rows["slipped"] ^ (whole.rows["grasp"] >= 100)
    for every in (True, False):
        as_it_was = live(whole, LIMITS, every=every)
        otherwise = live(changed(whole, slipped=turned), LIMITS, every=every)
        assert as_it_was["p_slip"][:101].equals(otherwise["p_slip"][:101])
        assert not as_it_was["p_slip"].equals(otherwise["p_slip"])


def test_networks_saw_neither_objects_nor_poses_of_their_streams(
    bts3_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grasps = read_all(bts3_dir)
    grasps = grasps.rows(np.arange(0, len(grasps), 12))
    tables = [grasps.files[table].name for table in grasps.table_of]
    trained_on: list[Grasps] = []

    def watched(system: System, seen: Grasps, seed: int) -> Trained:
        trained_on.append(seen)
        return train(system, seen, seed)

    def apart(trained: Trained, whole: Grasps, rows: Ints) -> tuple[Any, Any, Any]:
        for seen in trained_on[-2:]:
            objects = {whole.objects[row] for row in rows}
            poses = {tables[row] for row in rows}
            assert objects.isdisjoint(seen.objects)
            assert poses.isdisjoint(seen.files[table].name for table in set(seen.table_of))
        return judged(trained, whole, rows)

    monkeypatch.setattr(module, "train", watched)
    monkeypatch.setattr(module, "judged", apart)
    found = list(streams(grasps, seeds=1, folds=1, epochs=1))
    firsts = [one.rows.iloc[0] for one in found]
    assert {(row["day"], row["table"], row["order"]) for row in firsts} == {
        (day, table, order)
        for day, table in (
            ("A", "palm_45"),
            *((day, table) for day in "BC" for table in ("palm_down", "palm_side")),
        )
        for order in ("random", "by object")
    }


def test_a_refused_grasp_that_would_hold_counts_as_not_stable() -> None:
    whole = stream()
    refused = np.arange(GRASPS) % 2 == 0
    life = live(changed(whole, refused=refused), RiskLimits(), every=True)
    assert life["p_slip"][refused].isna().all()
    assert not life["stable"][refused].any()
    assert life["outcomes"].iloc[-1] == GRASPS // 2 - 1
    figures = risk_figures(life, 0.01, "A")
    held = ~life["slipped"]
    assert figures["kept"] == pytest.approx((life["stable"] & held).sum() / held.sum())
    assert figures["slips"] == pytest.approx(life["slipped"][life["stable"]].mean())
    assert figures["kept"] < 0.5
    assert figures["slips"] > 0.01
    assert figures["above"] == 1.0


def test_the_slope_finds_the_factor_that_shrank_the_log_odds() -> None:
    random = np.random.default_rng(0)
    log_odds = random.normal(0.0, 2.0, 40_000)
    slipped = random.random(40_000) < 1.0 / (1.0 + np.exp(-log_odds))
    for factor in (0.5, 1.0, 2.0):
        p_slip = 1.0 / (1.0 + np.exp(-log_odds / factor))
        rows = pd.DataFrame({"p_slip": p_slip, "slipped": slipped})
        assert slope(rows) == pytest.approx(factor, abs=0.03 * factor)


def test_a_scale_is_fitted_on_other_objects_of_its_split() -> None:
    """Outcomes of the judged objects change the others' scales and not their own."""
    several = [stream(seed) for seed in range(3)]
    other_split = changed(stream(3), split=1, fold=0)
    turned = changed(several[0], slipped=~several[0].rows["slipped"])

    def scales(streams: Sequence[Stream]) -> dict[tuple[int, int], float]:
        lives = [live(one, RiskLimits(), every=True, scale=1.0) for one in streams]
        return fitted_scales(pd.concat(lives, ignore_index=True))

    former, later = scales([*several, other_split]), scales([turned, *several[1:], other_split])
    assert former[0, 0] == later[0, 0]
    assert former[0, 1] != later[0, 1]
    assert former[1, 0] == later[1, 0] == SCALE


def test_wrong_input_is_refused_before_training(tmp_path: Path) -> None:
    data = tmp_path / "data"
    write_sessions(data, 80)
    words = "report", "worth", "--data", data, "--out", tmp_path / "out"
    assert "argument --seeds: '0' is not a whole number" in refused(*words, "--seeds", "0")
    assert "no.json: cannot read" in refused(*words, "--card", tmp_path / "no.json")
    for path in data.iterdir():
        write(path, replace(table(path.stem, 80, 0), objects=("a", "b", "c", "d") * 20))
    (data / "palm_45.csv").unlink()
    assert refused(*words) == "graspd report: the data lack palm_45\n"
    write(data / "palm_45.csv", replace(table("", 80, 1), objects=("a",) * 80))
    assert "palm_45 has no grasp of the objects of fold" in refused(*words)


@pytest.fixture(scope="module")
def folder(bts3_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a report made outside of a test: matplotlib keeps fonts open."""
    out = tmp_path_factory.mktemp("worth")
    path = out / "card.json"
    shutil.copy(zoo.find("small-session").with_suffix(".json"), path)
    words = ("report", "worth", "--data", bts3_dir, "--out", out, "--card", path, "--quick")
    assert graspd(*words).returncode == 0
    return out


def test_the_report_makes_table_picture_and_card(folder: Path) -> None:
    text = (folder / "worth.md").read_text()
    assert text.startswith("**made with --quick")
    for name in (PUBLISHED, ALONE, LEARNING, RISK):
        assert re.search(rf"\| {re.escape(name)} +\| (\d+|nan) / \d+ ", text)
    drawn = (folder / "worth.svg").read_text()
    assert drawn.count("<svg") == 1
    assert "-quick: the figures mean nothing -->" in drawn
    assert text.partition("\n\n")[2].partition("\n\n")[0] in drawn, "the picture's own figures"
    card = json.loads((folder / "card.json").read_text())
    assert card["contract"] == zoo.card("small-session")["contract"]
    assert card["worth"] == json.loads((folder / "worth.json").read_text())
    assert card["worth"]["command"] == "graspd report worth --data DIR --seeds 1 --quick"
