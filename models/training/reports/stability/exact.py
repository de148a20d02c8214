"""Reference for input and answer of a model, nearly without rounding.

Inputs are made in extended precision and straight from the definition: pixels are filled one by
one in passes, moments are taken in two passes. It uses no shortcut of `graspd.models.tactile_image`
or `graspd.models.inputs`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from graspd.models.contract import (
    OUTPUT_NAME,
    CountsInput,
    ImageInput,
    ModelContract,
    SessionInput,
)
from graspd.models.inputs import SPREAD_FLOOR_COUNTS
from graspd.models.judge.grasp_judge import TINY
from graspd.models.layout import D1
from graspd.models.session_statistics import SessionState

if TYPE_CHECKING:
    import onnx

Exact = NDArray[np.longdouble]
Standard = tuple[Exact, Exact]
"""Mean and spread by which features are standardised, shape (features,) each."""
CHUNK = 128
"""Number of readings at a time; the products of their convolution take 30 MB."""
STEPPED = frozenset({"TreeEnsembleClassifier", "TreeEnsembleRegressor"})
"""Discontinuous operators: a tiny change of an input may change the answer by a step."""


class Reference:
    """The network of one ONNX file in float64: constants are widened, narrowing casts left out.

    It is evaluated by onnx's own reference implementation, which shares nothing with onnxruntime
    but the file.
    """

    def __init__(self, path: Path) -> None:
        import onnx
        from onnx.reference import ReferenceEvaluator

        model = onnx.load(path)
        operators = frozenset(node.op_type for node in model.graph.node)
        self.is_stepped = bool(operators & STEPPED)
        """True if the answer jumps, so that only the same input can give the same answer."""
        self._input_name = model.graph.input[0].name
        _widen(model)
        self._evaluator = ReferenceEvaluator(model)

    def probabilities(self, inputs: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return probabilities (N, 2), stable and slip, of inputs (N, *shape) of any float type."""
        wide = inputs.astype(np.float64)
        starts = range(0, len(wide), CHUNK)
        parts = [self._run(wide[start : start + CHUNK]) for start in starts]
        return np.concatenate([np.empty((0, 2)), *parts])

    def _run(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        (answer,) = self._evaluator.run([OUTPUT_NAME], {self._input_name: inputs})
        return np.asarray(answer, dtype=np.float64)


def _widen(model: onnx.ModelProto) -> None:
    """Turn all narrower floats of a model into float64, in place."""
    from onnx import TensorProto, numpy_helper

    narrow = TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.BFLOAT16
    tensors = list(model.graph.initializer)
    for node in model.graph.node:
        for attribute in node.attribute:
            if attribute.HasField("t"):
                tensors.append(attribute.t)
            elif node.op_type == "Cast" and attribute.i in narrow:
                attribute.i = TensorProto.DOUBLE
    for tensor in tensors:
        if tensor.data_type in narrow:
            values = numpy_helper.to_array(tensor).astype(np.float64)
            tensor.CopyFrom(numpy_helper.from_array(values, tensor.name))


def exact_input(
    contract: ModelContract,
    counts: NDArray[np.generic],
    standard: Standard | None = None,
) -> tuple[Exact, Exact]:
    """Return inputs (N, *shape) and spreads (N, fingers) of counts (N, fingers, 24).

    Features are standardised by `standard`, mean and spread (features,), or by the training's.
    Z-values and pixels of a flat finger are zero.
    """
    values = counts.astype(np.longdouble)
    match contract.input:
        case ImageInput():
            return _image(values)
        case CountsInput():
            return values.reshape(len(values), -1), _z_scores(values)[2]
        case SessionInput() as session:
            return _features(values, session, standard)
        case _:
            z, _, spread = _z_scores(values)
            return z.reshape(len(z), -1), spread


def exact_standard(session: SessionInput, state: SessionState) -> Standard:
    """Return mean and spread of the features of a session: its own, blended with the training's."""
    features = len(session.mean)
    own, prior = np.longdouble(state.weight), np.longdouble(session.prior_grasps)
    mean = np.array(state.mean[:features], dtype=np.longdouble)
    squares = np.array(state.squares[:features], dtype=np.longdouble)
    prior_mean = np.array(session.mean, dtype=np.longdouble)
    prior_spread = np.array(session.spread, dtype=np.longdouble)
    return (
        (prior * prior_mean + own * mean) / (prior + own),
        np.sqrt((prior * prior_spread**2 + squares) / (prior + own)),
    )


def exact_softening(
    p_stable: NDArray[np.float64],
    p_slip: NDArray[np.float64],
    temperature: float,
    threshold: float,
) -> NDArray[np.float64]:
    """Return the probability of slip in a young session.

    The distance of the log odds from those of the threshold is divided by the temperature.
    Probabilities that are passed count as at least `TINY`.
    """
    slip = np.maximum(p_slip, TINY).astype(np.longdouble)
    stable = np.maximum(p_stable, TINY).astype(np.longdouble)
    zero = np.log(np.longdouble(threshold)) - np.log(np.longdouble(1.0 - threshold))
    margin = zero + (np.log(slip / stable) - zero) / np.longdouble(temperature)
    softened: NDArray[np.float64] = (1.0 / (1.0 + np.exp(-margin))).astype(np.float64)
    return softened


def _moments(values: Exact) -> tuple[Exact, Exact]:
    """Return mean and population standard deviation over the last axis, in two passes."""
    mean = values.mean(axis=-1)
    deviations = values - mean[..., np.newaxis]
    return mean, np.sqrt((deviations * deviations).mean(axis=-1))


def _divided(deviations: Exact, spread: Exact) -> Exact:
    """Return deviations over their spread; zero if that is below the floor or NaN."""
    sound = spread >= SPREAD_FLOOR_COUNTS
    scale = np.where(sound, spread, 1)[..., np.newaxis]
    quotient: Exact = np.where(sound[..., np.newaxis], deviations / scale, 0)
    return quotient


def _z_scores(values: Exact) -> tuple[Exact, Exact, Exact]:
    mean, spread = _moments(values)
    return _divided(values - mean[..., np.newaxis], spread), mean, spread


def _features(
    values: Exact,
    session: SessionInput,
    standard: Standard | None,
) -> tuple[Exact, Exact]:
    z, mean, spread = _z_scores(values)
    raw = np.concatenate((z.reshape(len(z), -1), mean, spread), axis=1)
    centre, width = standard or (
        np.array(session.mean, dtype=np.longdouble),
        np.array(session.spread, dtype=np.longdouble),
    )
    clipped: Exact = np.clip((raw - centre) / width, -session.clip, session.clip)
    return clipped, spread


def _image(values: Exact) -> tuple[Exact, Exact]:
    """Return images (N, height, width, fingers) of counts, as the zoo's `cnn1` has them.

    Each finger on D1 is standardised over its filled image.
    """
    filled = _filled(values)
    pixels = filled.reshape(*filled.shape[:2], -1)
    mean, spread = _moments(pixels)
    planes = _divided(pixels - mean[..., np.newaxis], spread)
    return planes.reshape(filled.shape).transpose(0, 2, 3, 1), spread


def _filled(values: Exact) -> Exact:
    """Return images (N, fingers, height, width) of counts (N, fingers, 24), paper section II-A."""
    height, width = D1.shape
    images = np.zeros((*values.shape[:2], height, width), dtype=np.longdouble)
    known = np.zeros((height, width), dtype=np.bool_)
    for electrode, (row, column) in enumerate(zip(D1.rows, D1.columns, strict=True)):
        images[..., row, column] = values[..., electrode]
        known[row, column] = True
    while not known.all():
        before, was_known = images.copy(), known.copy()
        for row, column in np.argwhere(~was_known).tolist():
            around = [
                (r, c)
                for r in range(max(row - 1, 0), min(row + 2, height))
                for c in range(max(column - 1, 0), min(column + 2, width))
                if was_known[r, c]
            ]
            if around:
                total = sum(before[..., r, c] for r, c in around)
                images[..., row, column] = total / np.longdouble(len(around))
                known[row, column] = True
    return images
