"""The published grasp tables (BTS3). Imports nothing heavy, so fetching them is quick."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TableFile:
    """One published grasp table."""

    name: str
    """Pose of the palm; the file is `<name>.csv` in a data folder."""
    upstream_name: str
    """File name in `REPOSITORY`."""
    sha256: str
    rows: int
    """Number of rows, one per grasp."""


REPOSITORY = "https://github.com/3dperceptionlab/biotacsp-stability-set-v2"
LICENCE = "MIT, Copyright (c) 2018 3D Perception Lab"
CITATIONS = (
    "B. S. Zapata-Impata, P. Gil, F. Torres: Non-Matrix Tactile Sensors: How Can Be Exploited "
    "Their Local Connectivity For Predicting Grasp Stability? 2018, arXiv:1809.05551",
    "A. Garcia-Garcia, B. S. Zapata-Impata, S. Orts-Escolano, P. Gil, J. Garcia-Rodriguez: "
    "TactileGCN: A Graph Convolutional Network for Predicting Grasp Stability with Tactile "
    "Sensors, 2019, arXiv:1901.06181",
)

TABLES = (
    TableFile(
        "palm_down",
        "bts3v2_palm_down.csv",
        "7abe522411416909f6c71adc37eabc17d3ee62bed5073da1297757bea951715f",
        1276,
    ),
    TableFile(
        "palm_side",
        "bts3v2_palm_side.csv",
        "79d8ce7220317f9df4061a2b983eb62bdaae56e2b4428a69a7d3369de2457a87",
        1273,
    ),
    TableFile(
        "palm_45",
        "bts3v2_palm_45.csv",
        "6e94f40cd6d4e33fd53fb0a3179c948d0144b57d325d7e8761365d6c4c0ae4cb",
        2133,
    ),
)
"""All published tables; `palm_45` was recorded later, with drifted sensors."""

WHOLE = ("palm_down", "palm_side")
"""Tables of the published figures: 2549 grasps of 41 objects."""
NEW_SESSION = "palm_45"
"""Table of another day and another pose."""
