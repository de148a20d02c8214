"""Load an ONNX model and run it on one reading, without allocation per run."""

from __future__ import annotations

import hashlib
import stat
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from graspd.models import zoo
from graspd.models.contract import METADATA_KEY, OUTPUT_NAME, ModelContract, ModelError
from graspd.models.inputs import InputBuilder, builder

MAX_MODEL_BYTES = 256 * 2**20
"""Largest model file, bytes; the published CNN1 has 12 MB."""
WARM_UP_RUNS = 20
"""Number of runs before the first verdict, which cause all lazy allocation and page faults."""


class ModelFile:
    """Content of a model file and its SHA-256, hexadecimal; hashing 12 MB takes 10 ms."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.sha256 = hashlib.sha256(data).hexdigest()


class TactileModel:
    """A loaded, warm model whose input and output are fixed buffers.

    Fill `input` (float32, shape `inputs.shape`) with `inputs.build`, then call `run`.
    """

    def __init__(self, path: Path, tried: ModelFile | None = None) -> None:
        """Load the model file. Raises `ModelError` if it is missing, broken or inconsistent.

        `tried`: its content, if `graspd.models.trial` has read and checked it.
        """
        file = read(path) if tried is None else tried
        self.path = path
        self.sha256 = file.sha256
        if tried is None and not zoo.ships(path, self.sha256):
            check_operators(path, file.data)
        self._session = _session(path, file.data)
        self.contract, self.inputs = _contract(path, self._session)
        _check_signature(path, self._session, self.inputs)
        self._batch = np.zeros((1, *self.inputs.shape), dtype=np.float32)
        self.input: NDArray[np.float32] = self._batch[0]
        self._probability = np.zeros((1, 2), dtype=np.float32)
        self._binding = self._session.io_binding()
        self._binding.bind_input(
            self.inputs.name, "cpu", 0, np.float32, self._batch.shape, self._batch.ctypes.data
        )
        self._binding.bind_output(
            OUTPUT_NAME, "cpu", 0, np.float32, (1, 2), self._probability.ctypes.data
        )
        for _ in range(WARM_UP_RUNS):
            self.run()

    def run(self) -> tuple[float, float]:
        """Return the probabilities (stable, slip) for `input`. Raises `ModelError`."""
        try:
            self._session.run_with_iobinding(self._binding)
        except Exception as error:  # onnxruntime's exceptions share no narrower base
            raise ModelError(f"{self.path}: {one_line(error)}") from error
        p_stable, p_slip = self._probability[0].tolist()
        return p_stable, p_slip

    def metadata(self, key: str) -> str | None:
        """Return an entry of the file's metadata; None: there is no such entry."""
        text: str | None = self._session.get_modelmeta().custom_metadata_map.get(key)
        return text


def read(path: Path) -> ModelFile:
    """Return the content of a model file. Raises `ModelError`."""
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            raise ModelError(f"{path}: cannot read the model: not a regular file")
        if about.st_size > MAX_MODEL_BYTES:
            raise ModelError(f"{path}: larger than {MAX_MODEL_BYTES} bytes, not a model")
        return ModelFile(path.read_bytes())
    except OSError as error:
        raise ModelError(f"{path}: cannot read the model: {error.strerror}") from error
    except ValueError as error:  # a NUL in the path
        raise ModelError(f"{str(path)!r}: cannot read the model: {error}") from error


def check_operators(path: Path, data: bytes) -> None:
    """Raise `ModelError` unless the file is self-contained and its operators surely end."""
    from graspd.models import onnx_file  # not needed for models of the zoo

    try:
        onnx_file.check(data)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error


def single_threaded(model: bytes) -> ort.InferenceSession:
    """Return an onnxruntime session on one thread, as in the daemon. Raises its exceptions."""
    options = ort.SessionOptions()
    # One thread, no spinning: a second thread gains nothing on a small network, and spinning
    # between readings would burn a core of the robot's PC.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Not ORT format: `check_operators` reads only ONNX.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.log_severity_level = 3
    return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def _session(path: Path, data: bytes) -> ort.InferenceSession:
    try:
        return single_threaded(data)
    except Exception as error:  # onnxruntime's exceptions share no narrower base
        raise ModelError(f"{path}: not a usable ONNX model: {one_line(error)}") from error


def one_line(error: Exception) -> str:
    """Return the text of an error without its line breaks."""
    return " ".join(str(error).split())


def _contract(path: Path, session: ort.InferenceSession) -> tuple[ModelContract, InputBuilder]:
    text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    if text is None:
        raise ModelError(f"{path}: has no contract (no metadata entry '{METADATA_KEY}')")
    try:
        contract = ModelContract.from_json(text)
        return contract, builder(contract.input, len(contract.fingers))
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error


def _check_signature(path: Path, session: ort.InferenceSession, expected: InputBuilder) -> None:
    inputs = {node.name: node for node in session.get_inputs()}
    outputs = {node.name: node for node in session.get_outputs()}
    if set(inputs) != {expected.name} or OUTPUT_NAME not in outputs:
        raise ModelError(
            f"{path}: has inputs {sorted(inputs)} and outputs {sorted(outputs)}, "
            f"not {expected.name} and {OUTPUT_NAME}"
        )
    node = inputs[expected.name]
    if node.type != "tensor(float)" or tuple(node.shape[1:]) != expected.shape:
        raise ModelError(
            f"{path}: takes {node.type} {node.shape}, its contract says {expected.shape}"
        )
    node = outputs[OUTPUT_NAME]
    if node.type != "tensor(float)" or tuple(node.shape[1:]) != (2,):
        raise ModelError(f"{path}: returns {node.type} {node.shape}, not float (N, 2)")
