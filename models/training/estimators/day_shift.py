"""Session features as they might have been on another day: other sensors, another palm pose."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from models.contract import FEATURES_PER_FINGER
from models.layout import ELECTRODES


@dataclass(frozen=True, slots=True)
class DayShift:
    """How far the features of one day differ from those of another, beyond their standardising.

    Measured by what helped networks on days that they were not trained on; twice as much helps
    networks of a single training day more, and costs the others.
    """

    gain: float = 0.3
    """Each feature is multiplied by `exp(gain * e)`, e standard normal."""
    finger_gain: float = 0.3
    """All 24 z-values of a finger are multiplied by the same `exp(finger_gain * e)`."""
    offset: float = 0.7
    """Standard deviation of what is added to each finger's mean and to its spread."""


def on_another_day(features: torch.Tensor, shift: DayShift) -> torch.Tensor:
    """Standardised session features (N, fingers * 26), each grasp's shifted by a draw of its own.

    Draws from torch's global random state; the features themselves are not changed. Raises
    `ValueError` if these are no session features.
    """
    if features.ndim != 2 or features.shape[1] % FEATURES_PER_FINGER:
        raise ValueError(f"inputs {tuple(features.shape[1:])} are no session features")
    grasps, width = features.shape
    fingers = width // FEATURES_PER_FINGER
    electrodes = fingers * ELECTRODES
    exponent = shift.gain * torch.randn(grasps, width)
    of_finger = shift.finger_gain * torch.randn(grasps, fingers)
    exponent[:, :electrodes] += of_finger.repeat_interleave(ELECTRODES, dim=1)
    shifted = features * exponent.exp()
    shifted[:, electrodes:] += shift.offset * torch.randn(grasps, width - electrodes)
    return shifted
