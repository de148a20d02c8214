"""Session features of other days: what is drawn for what, and how far."""

from __future__ import annotations

import pytest
import torch

from graspd.models.training.estimators.configs import DayShift
from graspd.models.training.estimators.recipe import on_another_day

GRASPS = 4000


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


def test_another_day_without_a_shift_is_the_same_day() -> None:
    features = torch.randn(5, 78)
    assert torch.equal(on_another_day(features, DayShift(0.0, 0.0, 0.0)), features)


def test_each_feature_of_each_grasp_has_a_gain_of_its_own() -> None:
    shifted = on_another_day(torch.ones(GRASPS, 52), DayShift(0.3, 0.0, 0.0))
    exponents = shifted.log()
    assert exponents.std(dim=0).numpy() == pytest.approx(0.3, abs=0.02)
    assert torch.corrcoef(exponents.T).fill_diagonal_(0.0).abs().max() < 0.1


def test_a_finger_gain_is_one_for_its_24_electrodes_and_none_for_mean_and_spread() -> None:
    shifted = on_another_day(torch.ones(GRASPS, 52), DayShift(0.0, 0.3, 0.0))
    ff, th, rest = shifted[:, :24], shifted[:, 24:48], shifted[:, 48:]
    assert torch.equal(ff, ff[:, :1].expand(-1, 24))
    assert torch.equal(th, th[:, :1].expand(-1, 24))
    assert not torch.equal(ff[:, 0], th[:, 0])
    assert ff[:, 0].log().std().item() == pytest.approx(0.3, abs=0.02)
    assert torch.equal(rest, torch.ones(GRASPS, 4))


def test_an_offset_is_of_means_and_spreads_alone() -> None:
    shifted = on_another_day(torch.zeros(GRASPS, 26), DayShift(0.0, 0.0, 0.7))
    assert torch.equal(shifted[:, :24], torch.zeros(GRASPS, 24))
    assert shifted[:, 24:].std(dim=0).numpy() == pytest.approx(0.7, abs=0.04)


@pytest.mark.parametrize("shape", [(2, 72), (2, 3, 26), (2, 3, 12, 11)])
def test_other_inputs_have_no_other_day(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="no session features"):
        on_another_day(torch.zeros(shape), DayShift())
