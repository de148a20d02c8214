"""Every kind of system as a file that judges as its trainer does."""

from __future__ import annotations

import functools
import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

import onnx
import onnxruntime as ort

from graspd.models.contract import (
    CountsInput,
    ImageInput,
    ModelContract,
    SessionInput,
    Sharpness,
    VectorInput,
)
from graspd.models.inputs import builder, raw_features
from graspd.models.runtime import TactileModel
from graspd.models.training.estimators.classical import FittedClassical
from graspd.models.training.estimators.configs import (
    BoostingConfig,
    ForestConfig,
    MlpConfig,
    NetworkConfig,
    Recipe,
    SecondConvolution,
    SvmConfig,
)
from graspd.models.training.estimators.graphs import Fitted
from graspd.models.training.fitting.trained import fit
from graspd.models.training.making.export import ExportError, export
from graspd.models.training.systems.registry import (
    SESSION,
    BlendConfig,
    Estimator,
    Member,
    SessionFeatures,
    System,
    SystemInput,
)
from tests.daemon.fakes import contract
from tests.models.training.samples import separable_counts

COUNTS, SLIPPED = separable_counts(90)
OTHER_COUNTS = separable_counts(200, seed=12)[0]
RAW = raw_features(COUNTS)
IMAGE = ImageInput("D1", "neighbour-mean", "filled-image", "channels")
SIDE_BY_SIDE = ImageInput("D2a", "least-contact", "filled-image", "horizontal")
VECTOR = VectorInput()
COUNTS_INPUT = CountsInput()
STATISTICS = SessionInput(
    mean=tuple(RAW.mean(axis=0).tolist()),
    spread=tuple(RAW.std(axis=0).tolist()),
    clip=3.0,
    prior_grasps=5.0,
    calibrated_from=20.0,
    sharpness=(Sharpness(0.0, 1.0),),
)
TINY = NetworkConfig(filters=4, hidden=8)
QUICK = Recipe(epochs=2)
BLEND = BlendConfig(
    (
        Member(SvmConfig(3.0, 0.003)),
        Member(BoostingConfig(iterations=15, leaves=5)),
        Member(ForestConfig(11, None)),
        Member(MlpConfig((8,), epochs=20)),
        Member(TINY, QUICK),
    )
)


def system(kind: SystemInput, estimator: Estimator, recipe: Recipe | None = None) -> System:
    return System("made", kind, estimator, recipe, standardise=kind == COUNTS_INPUT)


CASES = {
    "image network": system(IMAGE, TINY, QUICK),
    "side by side": system(SIDE_BY_SIDE, replace(TINY, batch_norm=False), QUICK),
    "deep network": system(
        IMAGE, replace(TINY, pool=True, second=SecondConvolution(5), dropout=0.3), QUICK
    ),
    "session network": system(SESSION, replace(TINY, dropout=0.3), QUICK),
    "svm": system(VECTOR, SvmConfig(3.0, 0.1)),
    "mlp": system(VECTOR, MlpConfig((8, 8), epochs=30)),
    "forest": system(VECTOR, ForestConfig(199, None)),
    "boosting": system(SESSION, BoostingConfig(iterations=30, leaves=5, features=0.5)),
    "standardised forest": system(COUNTS_INPUT, ForestConfig(11, None)),
    "blend": system(SESSION, BLEND),
}


def contract_of(name: str) -> ModelContract:
    kind = CASES[name].input
    wanted = STATISTICS if isinstance(kind, SessionFeatures) else kind
    return msgspec.structs.replace(contract(), input=wanted)


def trained(name: str) -> Fitted:
    inputs = builder(contract_of(name).input, 3).build_batch(COUNTS)[0]
    return fit(CASES[name], inputs, SLIPPED, seed=0)


fitted = functools.cache(trained)


@pytest.mark.parametrize("name", sorted(CASES))
def test_the_file_judges_unseen_grasps_as_the_trainer(name: str, tmp_path: Path) -> None:
    contract = contract_of(name)
    path = tmp_path / "made.onnx"
    counts = np.concatenate((COUNTS, OTHER_COUNTS))
    parity = export(fitted(name), 1.7, contract, counts, path)
    assert parity.grasps == 290
    assert parity.largest_difference < 1e-5
    assert parity.verdicts_flipped == 0
    assert [entry.name for entry in tmp_path.iterdir()] == ["made.onnx"]
    model = TactileModel(path)
    assert model.contract == contract
    inputs = builder(contract.input, 3).build_batch(counts)[0]
    slip = 1.0 / (1.0 + np.exp(-fitted(name).margins(inputs) / 1.7))
    session = ort.InferenceSession(path, providers=["CPUExecutionProvider"])
    for number in (290, 7, 2, 1):
        (answers,) = session.run(["probability"], {model.inputs.name: inputs[:number]})
        assert answers[:, 1] == pytest.approx(slip[:number], abs=1e-5)
        assert answers[:, 0] == pytest.approx(1.0 - slip[:number], abs=1e-5)


@pytest.mark.parametrize("name", ["session network", "svm", "forest", "boosting"])
def test_equal_trainings_make_equal_bytes_without_local_paths(name: str, tmp_path: Path) -> None:
    contract = contract_of(name)
    files = [tmp_path / "once.onnx", tmp_path / "again.onnx"]
    for path, made in zip(files, (fitted(name), trained(name)), strict=True):
        export(made, 0.8, contract, COUNTS[:5], path)
    once, twice = (path.read_bytes() for path in files)
    assert once == twice
    text = once.decode("latin-1")
    for trace in (str(Path(__file__).parents[4]), str(Path.home()), "site-packages", ".py"):
        assert trace not in text
    assert not re.search(r"/(tmp|home|usr|work|root)/", text)


def test_a_file_that_judges_otherwise_is_not_written(tmp_path: Path) -> None:
    class Warmer(FittedClassical):
        def to_onnx(self, temperature: float, input_name: str) -> onnx.ModelProto:
            return super().to_onnx(temperature * 1.01, input_name)

    made = fitted("svm")
    assert isinstance(made, FittedClassical)
    path = tmp_path / "made.onnx"
    path.write_bytes(b"the file before")
    with pytest.raises(ExportError, match="differs from the system"):
        export(Warmer(made.model), 1.0, contract_of("svm"), COUNTS, path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["made.onnx"]
    assert path.read_bytes() == b"the file before"
