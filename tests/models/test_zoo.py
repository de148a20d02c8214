"""The committed models: their cards and figures are right, and they know their grasps again."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.models import known_grasps, zoo
from graspd.models.runtime import TactileModel
from graspd.models.training.data.datasets import read_all

CARD: dict[str, Any] = json.loads((zoo.ZOO / "cnn1.json").read_text())


def test_cnn1_reaches_the_published_f1_within_its_spread() -> None:
    # The paper gives 94.2 +- 0.8 % for CNN1.
    assert CARD["contract"]["measured"][0]["f1_mean"] > 0.942 - 0.008
    assert CARD["contract"]["measured"][0]["folds"] == 10


def test_each_card_describes_the_model_file_beside_it() -> None:
    for name in zoo.names():
        model, card = TactileModel(zoo.find(name)), zoo.card(name)
        file, contract = card["file"], card["contract"]
        assert file["sha256"] == hashlib.sha256(model.path.read_bytes()).hexdigest()
        assert file["size_bytes"] == model.path.stat().st_size
        assert contract == json.loads(model.contract.to_json())
        assert file["parity"]["grasps"] == sum(each["rows"] for each in contract["datasets"])
        assert file["parity"]["largest_difference"] <= 1e-5
        assert file["parity"]["verdicts_flipped"] == 0
        assert card["same_seed_same_margins"] is True
        assert contract["name"] == name


def test_the_figures_of_contract_and_card_are_the_same() -> None:
    for card in map(zoo.card, zoo.names()):
        measured = {entry["protocol"]: entry for entry in card["contract"]["measured"]}
        assert list(measured) == list(card["protocols"])
        for protocol, figures in card["protocols"].items():
            # Of `days` there are four days, and four groups of objects.
            folds = 16 if protocol == "days" else 10
            assert measured[protocol]["folds"] == figures["folds"] == folds
            assert measured[protocol]["f1_mean"] == figures["spreads"]["f1"]["mean"]
            (true_stable, false_slip), (missed, hit) = figures["confusion"]
            judged = true_stable + false_slip + missed + hit
            assert judged == sum(palm["grasps"] for palm in figures["palms"].values())
            assert judged == sum(each["share"]["grasps"] for each in figures["objects"].values())
            # Folds are of nearly the same size, so their mean is nearly that of all grasps; those
            # of `days` judge one table or two.
            accuracy, near = (true_stable + hit) / judged, 0.03 if protocol == "days" else 0.01
            assert figures["spreads"]["accuracy"]["mean"] == pytest.approx(accuracy, abs=near)


def test_up_to_four_repaired_dead_electrodes_cost_under_two_points() -> None:
    for name in zoo.names():
        study = zoo.card(name)["broken"]
        dead = {(b["number"], b["reads"]): b for b in study["broken"]}
        assert dead[1, "at 0"]["unnoticed"] < study["sound"] - 0.1
        for number in (1, 2, 4):
            assert dead[number, "at 0"]["known"] > study["sound"] - 0.02


def test_the_card_of_cnn1_describes_the_tables_of_its_training(bts3_dir: Path) -> None:
    columns: list[NDArray[np.int64]] = []
    for stated in CARD["contract"]["datasets"]:
        path = bts3_dir / f"{stated['name']}.csv"
        assert stated["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        table = np.genfromtxt(path, np.int64, delimiter=",", skip_header=1, usecols=range(2, 74))
        assert stated["rows"] == len(table)
        columns.append(table)
    counts = np.concatenate(columns).reshape(-1, 3, 24)
    seen = CARD["contract"]["seen"]
    assert seen["low"] == counts.min(axis=0).tolist()
    assert seen["high"] == counts.max(axis=0).tolist()
    assert seen["margin"] == 100


def test_every_zoo_model_recognises_exactly_its_training_grasps(bts3_dir: Path) -> None:
    grasps = read_all(bts3_dir)
    tables = np.array([file.name for file in grasps.files])[grasps.table_of]
    for name in zoo.names():
        model = TactileModel(zoo.find(name))
        counts = grasps.of_fingers(model.contract.fingers).counts
        known = known_grasps.of_model(model)
        trained = np.isin(tables, [dataset.name for dataset in model.contract.datasets])
        assert (known_grasps.are_among(known_grasps.hashes(counts), known) == trained).all()
        counts[:, 0, 5] ^= 1
        assert not known_grasps.are_among(known_grasps.hashes(counts), known).any()


def test_zoo_models_are_hardly_less_accurate_than_their_confidence() -> None:
    for card in map(zoo.card, zoo.names()):
        losses = card["protocols"][card["calibrated_by"]]["spreads"]["log_loss"]
        assert losses["mean"] < 0.45
        curve = card["contract"]["confidence"]
        surest = [step["confidence"] for step in curve]
        assert surest == sorted(surest)
        # Of the verdicts that are surer than x, more than x are right, within two points and what
        # chance may do to so few (two standard errors).
        grasps = sum(dataset["rows"] for dataset in card["contract"]["datasets"])
        for step in curve:
            accuracy = step["accuracy"]
            chance = np.sqrt(accuracy * (1.0 - accuracy) / (step["coverage"] * grasps))
            assert accuracy > step["confidence"] - 0.02 - 2.0 * chance


def test_no_committed_file_names_the_machine_that_made_it() -> None:
    for path in (each for name in zoo.names() for each in zoo.ZOO.glob(f"{name}.*")):
        text = path.read_bytes().decode("latin-1")
        assert "site-packages" not in text
        assert not re.search(r"/(tmp|home|usr|work|root)/", text)
