"""Recognise grasps that a model was trained on, by a hash of each finger's counts. Copies and parts
of a table are recognised under any file name."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graspd.biotac import TABLE_FINGERS, Finger
from graspd.models import zoo
from graspd.models.bts3 import TABLES
from graspd.models.contract import ModelError
from graspd.models.runtime import TactileModel

METADATA_KEY = "graspd-grasps"
"""Key in an ONNX file's metadata, beside its contract, of the training grasps' hashes as text."""
PUBLISHED = zoo.ZOO / "published-grasps.crc32"
"""Hashes of the grasps of all published tables, little-endian, in the order of `TABLES`."""

Hashes = NDArray[np.uint32]
"""CRC-32 of the counts of each finger of N grasps, shape (N, fingers)."""


def hashes(counts: NDArray[np.uint16]) -> Hashes:
    """Return the CRC-32 of each finger of grasps (N, fingers, 24), shape (N, fingers)."""
    fingers = counts.astype("<u2").reshape(-1, counts.shape[2])
    each = [zlib.crc32(finger.tobytes()) for finger in fingers]
    return np.array(each, np.uint32).reshape(counts.shape[:2])


def as_text(grasps: Hashes) -> str:
    """Return hashes as base64 text for `METADATA_KEY`."""
    return base64.b64encode(grasps.astype("<u4").tobytes()).decode()


def are_among(grasps: Hashes, others: Hashes) -> NDArray[np.bool_]:
    """Return True for each grasp that has the hashes of one of the `others`, shape (N,)."""
    known = set(map(tuple, others.tolist()))
    return np.array([tuple(each) in known for each in grasps.tolist()], np.bool_)


def of_model(model: TactileModel) -> Hashes:
    """Return the hashes of a model's training grasps.

    A file without hashes gets those of its published tables; without these, no rows. Raises
    `ModelError` if the file's hashes are broken.
    """
    fingers = model.contract.fingers
    text = model.metadata(METADATA_KEY)
    if text is None:
        return _of_published([each.sha256 for each in model.contract.datasets], fingers)
    try:
        values = np.frombuffer(base64.b64decode(text, validate=True), "<u4")
        return values.reshape(-1, len(fingers)).astype(np.uint32)
    except ValueError as error:
        raise ModelError(f"{model.path}: hashes of its grasps are broken: {error}") from error


def _of_published(digests: Sequence[str], fingers: Sequence[Finger]) -> Hashes:
    """Return the hashes of all grasps of the published tables with these digests (SHA-256); no rows
    if the tables lack a finger."""
    if not set(fingers) <= set(TABLE_FINGERS):
        return np.empty((0, len(fingers)), np.uint32)
    rows = np.fromfile(PUBLISHED, "<u4").reshape(-1, len(TABLE_FINGERS))
    table_of = np.repeat([table.sha256 for table in TABLES], [table.rows for table in TABLES])
    columns = [TABLE_FINGERS.index(finger) for finger in fingers]
    return rows[np.isin(table_of, digests)][:, columns].astype(np.uint32)
