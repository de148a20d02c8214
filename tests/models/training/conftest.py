"""Tests of the training half, which wants the libraries of the extra `train`."""

from importlib.util import find_spec

LIBRARIES = ("torch", "sklearn", "skl2onnx", "rich")

collect_ignore_glob = [] if all(map(find_spec, LIBRARIES)) else ["*"]
