"""How grasps are dealt out to folds."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("sklearn", reason="the train extra is not installed")

from models.training.data.protocols import TooFewGraspsError, folds_of


def test_folds_are_stratified_and_leave_each_grasp_out_once() -> None:
    slipped = np.arange(200) % 4 == 0
    fold_of = folds_of(slipped, 10, seed=0)
    for fold in range(10):
        inside = fold_of == fold
        assert (int(inside.sum()), int(slipped[inside].sum())) == (20, 5)
    assert np.array_equal(fold_of, folds_of(slipped, 10, seed=0))
    assert not np.array_equal(fold_of, folds_of(slipped, 10, seed=1))


def test_too_few_grasps_of_one_class_are_refused() -> None:
    slipped = np.array([True] * 9 + [False] * 30)
    with pytest.raises(TooFewGraspsError, match="10 folds need 10 grasps of each class, one has 9"):
        folds_of(slipped, 10, seed=0)
