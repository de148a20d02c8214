"""`graspd models wrap`: an ONNX classifier made elsewhere becomes a model that the daemon takes."""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import runpy
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, compose, helper, numpy_helper

from graspd.biotac import ELECTRODES
from graspd.models import known_grasps, trial, zoo
from graspd.models.contract import (
    CLASSES,
    METADATA_KEY,
    OUTPUT_NAME,
    CountsInput,
    MeasuredError,
    ModelContract,
    ModelError,
)
from graspd.models.inputs import builder
from graspd.models.runtime import check_operators, one_line, single_threaded
from graspd.models.training.commands.common import read_each
from graspd.models.training.data.datasets import DatasetError, Grasps, check_once, concatenate
from graspd.models.training.data.protocols import FOLDS, object_folds
from graspd.models.training.evaluating.files import replacing, to_json, write_whole
from graspd.models.training.fitting.novelty import seen_counts

Train = Callable[[NDArray[np.uint16], NDArray[np.bool_]], bytes]
"""Function of counts (n, fingers, 24) and slipped (n,) that returns an ONNX file's bytes."""
FLOAT_ERROR_MAX = 1e-4
"""Largest distance from 1 of two probabilities' sum."""
REVERSED_AUC = 1 / 3
"""Area under the ROC curve, slip positive, below which a network's classes are reversed.

Networks trained on 20 to 200 grasps of a published table have 0.36 or more on another one, those
trained on all its grasps 0.59 or more, and 0.96 or more on itself."""
STANDARD_ERRORS = 2.0
"""Fewest standard errors between a reversed network's area and one half, that of chance."""
LINEAR = frozenset({"Add", "Gemm", "MatMul"})
"""Last operators of networks that return logits. After these, answers lie in 0..1 by chance."""
SHAPING = frozenset({"Cast", "Flatten", "Identity", "Reshape", "Squeeze", "Unsqueeze"})
"""Operators that do not change values."""
ON_TABLE = "Measured on its own table alone: its worth on other objects and days is not known."
BY_OBJECTS = "Its worth on another day than those of its table was not measured."


def run(args: argparse.Namespace) -> int:
    """Write NAME.onnx and its card. Raises `ModelError` and `DatasetError` for wrong input."""
    source = Path(args.what[1])
    grasps = concatenate(read_each(args.data, None))
    check_once(
        grasps, {file.name: path for file, path in zip(grasps.files, args.data, strict=True)}
    )
    if grasps.slipped.all() or not grasps.slipped.any():
        raise DatasetError(args.data[0], "has one kind of grasps, a model needs both kinds")
    name = args.name or f"{source.stem}-wrapped"
    if not zoo.is_name(name) or name in zoo.names():
        raise ModelError(f"{name!r} cannot be the name of a model: give another --name")
    measured, model = _measured(source, grasps)
    if measured.f1_mean == 0.0:
        raise ModelError(f"{source}: calls every grasp of the table that slipped stable")
    contract = ModelContract(
        version=2,
        name=name,
        input=CountsInput(),
        fingers=grasps.fingers,
        classes=CLASSES,
        seed=0,
        datasets=grasps.files,
        measured=(measured,),
        confidence=(),
        seen=seen_counts(grasps.counts),
    )
    known = known_grasps.as_text(known_grasps.hashes(grasps.counts))
    entries = {METADATA_KEY: contract.to_json(), known_grasps.METADATA_KEY: known}
    helper.set_model_props(model, entries)
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / f"{name}.onnx"
    content: bytes = model.SerializeToString(deterministic=True)
    with replacing(path) as part:
        part.write_bytes(content)
        _try(part, source)
    weak = ON_TABLE if measured.protocol == "table" else BY_OBJECTS
    card = {
        "what": f"made elsewhere, from {source.name}",
        "contract": contract,
        "file": {"sha256": hashlib.sha256(content).hexdigest(), "size_bytes": len(content)},
        "weak_points": (weak, "It keeps no session: it is wrong more often when sensors drift."),
    }
    write_whole(path.with_suffix(".json"), to_json(card))
    f1, of = 100 * measured.f1_mean, f"{measured.folds} folds of objects"
    how = of if measured.protocol == "objects" else "the table itself"
    sys.stdout.write(f"{path}: F1 {f1:.1f} % on {how}\n")
    sys.stdout.write(f"for a scene, below [model]: path = {json.dumps(str(path.absolute()))}\n")
    return 0


def _measured(source: Path, grasps: Grasps) -> tuple[MeasuredError, onnx.ModelProto]:
    """Return measured scores, and the model with the daemon's input and output. A Python file is
    trained on folds of objects, then on all grasps; an ONNX file is measured on the whole table."""
    if source.suffix != ".py":
        try:
            network = source.read_bytes()
        except OSError as error:
            raise ModelError(f"{source}: cannot read: {error.strerror}") from error
        model = _with_ends(source, network, grasps)
        return _error("table", [_scores(model, grasps, np.arange(len(grasps)))]), model
    with _blaming(source):
        train: Train | None = runpy.run_path(str(source)).get("train")
    if train is None:
        raise ModelError(f"{source}: has no function train(counts, slipped)")
    folds = min(FOLDS, len(set(grasps.objects)))
    if folds < 2:
        raise ModelError("the grasps are of one object: their folds need two or more")
    fold_of = object_folds(grasps.objects, folds, 0)
    scores = []
    for fold in range(folds):
        rows = np.flatnonzero(fold_of != fold)
        network = _made(source, train, grasps.counts[rows], grasps.slipped[rows])
        model = _with_ends(source, network, grasps)
        scores.append(_scores(model, grasps, np.flatnonzero(fold_of == fold)))
    network = _made(source, train, grasps.counts, grasps.slipped)
    return _error("objects", scores), _with_ends(source, network, grasps)


def _made(
    source: Path, train: Train, counts: NDArray[np.uint16], slipped: NDArray[np.bool_]
) -> bytes:
    """Return the network that the user's `train` makes. Raises `ModelError`."""
    with _blaming(source):
        network = train(counts, slipped)
    if not isinstance(network, bytes):
        kind = type(network).__name__
        raise ModelError(f"{source}: train returns {kind}, not the bytes of an ONNX file")
    return network


@contextmanager
def _blaming(source: Path) -> Iterator[None]:
    """Make an error of the user's program a `ModelError`, which names its line."""
    try:
        yield
    except Exception as error:  # it may be any
        frames = traceback.extract_tb(error.__traceback__)
        at = [f":{frame.lineno}" for frame in frames if frame.filename == str(source)][-1:]
        text = f"{type(error).__name__}: {one_line(error)}"
        raise ModelError(f"{source}{''.join(at)}: {text}") from error


def _scores(model: onnx.ModelProto, grasps: Grasps, rows: NDArray[np.int64]) -> tuple[float, float]:
    """Return F1, slip positive, and accuracy on these rows."""
    from sklearn.metrics import accuracy_score, f1_score

    session = _session(model.SerializeToString())
    given = builder(CountsInput(), len(grasps.fingers))
    inputs = given.build_batch(grasps.counts[rows])[0]
    said = [session.run([OUTPUT_NAME], {given.name: each[np.newaxis]})[0][0, 1] for each in inputs]
    slips, slipped = np.array(said) >= 0.5, grasps.slipped[rows]
    return float(f1_score(slipped, slips)), float(accuracy_score(slipped, slips))


def _try(part: Path, source: Path) -> None:
    """Load the file `part` as the daemon does. Raises `ModelError`, which names the `source`."""
    try:
        trial.load(part)
    except ModelError as error:
        raise ModelError(str(error).replace(str(part), str(source))) from error


def _error(protocol: str, scores: list[tuple[float, float]]) -> MeasuredError:
    f1, accuracy = np.array(scores).T
    means = float(f1.mean()), float(f1.std()), float(accuracy.mean()), float(accuracy.std())
    return MeasuredError(protocol, len(scores), *means)


def _session(network: bytes) -> Any:  # noqa: ANN401 - onnxruntime has no types
    try:
        return single_threaded(network)
    except Exception as error:  # onnxruntime's exceptions share no narrower base
        raise ModelError(f"not a usable ONNX model: {one_line(error)}") from error


def _with_ends(source: Path, network: bytes, grasps: Grasps) -> onnx.ModelProto:
    """Return the network with the daemon's input and output. Raises `ModelError` for other shapes,
    answers that are not logits (or, of two, probabilities), or reversed classes."""
    check_operators(source, network)  # onnxruntime would look for weights in the current folder
    fingers = len(grasps.fingers)
    session = _session(network)
    inputs, outputs = session.get_inputs(), session.get_outputs()
    of_two = [each for each in outputs if each.type == "tensor(float)" and each.shape[1:] == [2]]
    of_one = [each for each in outputs if each.type == "tensor(float)" and each.shape[1:] == [1]]
    shapes = ([fingers, ELECTRODES], [fingers * ELECTRODES])
    fits = len(inputs) == 1 and inputs[0].type == "tensor(float)" and inputs[0].shape[1:] in shapes
    ends = [f"{each.name} {each.type} {each.shape}" for each in (*inputs, *outputs)]
    refusal = (
        f"the network must take float counts (n, {fingers}, 24) or (n, {24 * fingers}) and "
        "return (n, 2), stable and slip, or (n, 1), log-odds of slip; it has "
        f"{', '.join(ends)}"
    )
    if not fits or not (of_two or of_one):
        raise ModelError(refusal)
    given, answer = inputs[0], (of_two or of_one)[0]
    try:
        read = _answers(given.name, answer.name, grasps.counts, given.shape[1:], session)
    except Exception as error:  # onnxruntime's exceptions share no narrower base
        raise ModelError(f"{refusal}; of one grasp: {one_line(error)}") from error
    if read.shape != (len(grasps), answer.shape[1]):
        raise ModelError(f"{refusal}, and returned {read.shape} of {len(grasps)} grasps")
    model = compose.add_prefix(onnx.load_from_string(network), "made/")
    graph, width = model.graph, fingers * ELECTRODES
    shape = np.array([-1, *given.shape[1:]], np.int64)
    graph.initializer.append(numpy_helper.from_array(shape, "shape"))
    name = builder(CountsInput(), fingers).name
    graph.node.insert(0, helper.make_node("Reshape", [name, "shape"], [f"made/{given.name}"]))
    graph.node.extend(_last(f"made/{answer.name}", read, graph))
    _check_order(read, grasps.slipped)
    del graph.input[:], graph.output[:]
    graph.input.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", width]))
    graph.output.append(helper.make_tensor_value_info(OUTPUT_NAME, TensorProto.FLOAT, ["N", 2]))
    del graph.value_info[:]
    return model


def _answers(
    name: str,
    answer: str,
    counts: NDArray[np.uint16],
    shape: list[int],
    session: Any,  # noqa: ANN401
) -> NDArray[np.float32]:
    """Return a network's answers to counts, run one grasp at a time in an onnxruntime `session`.

    `name`, `shape`: of its input, for one grasp. `answer`: name of its output.
    """
    one = (each.reshape(1, *shape).astype(np.float32) for each in counts)
    return np.concatenate([session.run([answer], {name: each})[0] for each in one])


def _last(answer: str, read: NDArray[np.float32], graph: onnx.GraphProto) -> list[onnx.NodeProto]:
    """Return the nodes that convert the network's output `answer` to two probabilities; add their
    constants to `graph`. `read`: answers on the table, which show the form of the output. Raises
    `ModelError` if they are not finite, or like probabilities but not two that add up to 1."""
    if not np.isfinite(read).all():
        raise ModelError("the network answers grasps of the table with values that are not numbers")
    two = np.array([-1, read.shape[-1]], np.int64)
    graph.initializer.append(numpy_helper.from_array(two, "answer_shape"))
    nodes = [helper.make_node("Reshape", [answer, "answer_shape"], ["answer"])]
    sums = np.abs(read.sum(axis=1) - 1.0)
    if read.shape[-1] == 2 and read.min() >= 0.0 and sums.max() <= FLOAT_ERROR_MAX:
        nodes[0].output[0] = OUTPUT_NAME
        return nodes
    in_0_to_1 = read.min() >= 0.0 and read.max() <= 1.0 + FLOAT_ERROR_MAX
    if in_0_to_1 and _last_operator(answer, graph) not in LINEAR:
        needed = ": log-odds of slip are needed"
        if read.shape[-1] == 2:
            needed = " that do not add up to 1: logits are needed"
        raise ModelError(
            f"the network answers all grasps in 0..1, like probabilities{needed}, leave the last "
            "Sigmoid out"
        )
    if read.shape[-1] == 1:
        column = np.array([[0.0, 1.0]], np.float32)
        graph.initializer.append(numpy_helper.from_array(column, "stable_slip"))
        nodes.append(helper.make_node("MatMul", ["answer", "stable_slip"], ["logits"]))
        return [*nodes, helper.make_node("Softmax", ["logits"], [OUTPUT_NAME], axis=1)]
    return [*nodes, helper.make_node("Softmax", ["answer"], [OUTPUT_NAME], axis=1)]


def _last_operator(answer: str, graph: onnx.GraphProto) -> str:
    """Return the operator that computes `answer`, before those of `SHAPING`; "" for a constant."""
    made_by = {name: node for node in graph.node for name in node.output}
    node = made_by.get(answer)
    while node is not None and node.op_type in SHAPING:
        node = made_by.get(node.input[0])
    return "" if node is None else str(node.op_type)


def _check_order(read: NDArray[np.float32], slipped: NDArray[np.bool_]) -> None:
    """Raise `ModelError` if grasps that held have the higher answers, by more than chance.

    `read`: answers to grasps, shape (N, 1) or (N, 2). `slipped`: outcomes, shape (N,)."""
    from sklearn.metrics import roc_auc_score

    slips = int(slipped.sum())
    error = math.sqrt((len(slipped) + 1) / 12 / slips / (len(slipped) - slips))
    right = roc_auc_score(slipped, read[:, -1].astype(np.float64) - read[:, :-1].sum(axis=1))
    if right < min(REVERSED_AUC, 0.5 - STANDARD_ERRORS * error):
        output = "log-odds of stable" if read.shape[-1] == 1 else "(slip, stable)"
        raise ModelError(f"the network calls stable what slips: is its output {output}?")
