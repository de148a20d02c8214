"""A trained network into the ONNX file that the daemon runs, proven to judge as it does."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import nn

from models.contract import INPUT_NAME, METADATA_KEY, OUTPUT_NAME, ModelContract
from models.runtime import TactileModel
from models.training.networks import IMAGE_SHAPE, for_inference
from models.training.recipe import logits

OPSET = 18
"""What the exporter is written for; every onnxruntime that the project allows knows it."""
TOLERANCE = 1e-5
"""Largest allowed difference of a probability between the network and its file."""


class ExportError(Exception):
    """The exported file does not judge as the trained network does: our bug, nothing is written."""


@dataclass(frozen=True, slots=True)
class Parity:
    """How far the file is from the network it was made from, over `grasps` grasps."""

    grasps: int
    largest_difference: float
    """Of a probability: file against PyTorch, before batch norm and temperature were folded."""
    verdicts_flipped: int


def export(
    network: nn.Sequential,
    temperature: float,
    contract: ModelContract,
    counts: NDArray[np.uint16],
    path: Path,
) -> Parity:
    """Write `softmax(logits / temperature)` with its contract to `path`, one self-contained file.

    The same weights and contract give the same bytes. The file is run as the daemon runs it on
    every reading of counts (N, fingers, 24) first. Raises `ExportError` if a probability differs by
    more than `TOLERANCE` or a verdict flips, and leaves `path` as it was.
    """
    model = _to_onnx(for_inference(network, temperature))
    onnx.helper.set_model_props(model, {METADATA_KEY: contract.to_json()})
    onnx.checker.check_model(model, full_check=True)
    part = path.with_name(path.name + ".part")
    try:
        part.write_bytes(model.SerializeToString(deterministic=True))
        parity = _compare(part, network, temperature, counts)
        # Not "greater than": that would let a NaN pass.
        if not parity.largest_difference <= TOLERANCE or parity.verdicts_flipped:
            raise ExportError(
                f"the exported file differs from the network by {parity.largest_difference:.1e} "
                f"and flips {parity.verdicts_flipped} verdicts of {parity.grasps}"
            )
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return parity


def _to_onnx(network: nn.Sequential) -> onnx.ModelProto:
    # Two images, because one would let the exporter take the batch for a constant.
    example = torch.zeros(2, *IMAGE_SHAPE)
    with _quiet_exporter():
        program = torch.onnx.export(
            network,
            (example,),
            input_names=[INPUT_NAME],
            output_names=[OUTPUT_NAME],
            dynamic_shapes=({0: torch.export.Dim("N")},),
            opset_version=OPSET,
            external_data=False,
            dynamo=True,
            verbose=False,
        )
    if program is None:
        raise ExportError("the exporter returned nothing")
    model = program.model_proto
    _strip(model)
    return model


def _strip(model: onnx.ModelProto) -> None:
    """Take out what tells of the machine: stack traces with paths, in each part's metadata."""
    graph = model.graph
    parts = (graph, *graph.node, *graph.initializer, *graph.value_info, *graph.input, *graph.output)
    for part in (model, *parts):
        del part.metadata_props[:]
        part.doc_string = ""
    del graph.value_info[:]


def _compare(
    path: Path, network: nn.Sequential, temperature: float, counts: NDArray[np.uint16]
) -> Parity:
    model = TactileModel(path)
    images = np.empty((len(counts), *model.image.shape), dtype=np.float32)
    actual = np.empty((len(counts), 2))
    for index, reading in enumerate(counts):
        model.imager.build(reading, model.image)
        images[index] = model.image
        actual[index] = model.run()
    expected = torch.from_numpy(logits(network, images) / temperature).softmax(dim=1).numpy()
    return Parity(
        grasps=len(counts),
        largest_difference=float(np.abs(actual - expected).max()),
        verdicts_flipped=int((actual.argmax(axis=1) != expected.argmax(axis=1)).sum()),
    )


@contextmanager
def _quiet_exporter() -> Iterator[None]:
    """Hold back what the exporter says of its own inside: nothing that a user could act on."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=FutureWarning)
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            yield
    finally:
        logger.setLevel(level)
