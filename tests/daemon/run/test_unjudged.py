"""Where nothing is judged, every summary says why in words, and the exit code is 1."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from graspd import judge
from graspd.drivers.recordings.csv_player import DEMO_RECORDING, DEMO_TABLE
from tests.kit.inside import graspd

Change = Callable[[pd.DataFrame], pd.DataFrame]
REST_ROWS, GRASP_ROWS = 100, 300
"""Rows of the open hand with which the demo begins, and rows until the first grasp is over."""


def times(factor: float) -> Change:
    return lambda stream: stream.assign(t=stream.t * factor)


def every(rows: int) -> Change:
    return lambda stream: stream.iloc[::rows]


def held_without_one_electrode(stream: pd.DataFrame) -> pd.DataFrame:
    """Return `stream` from the first touch on, without values of one electrode."""
    name = next(name for name in stream.columns if name.startswith("th_"))
    return stream[REST_ROWS:].assign(**{name: np.nan})


def held_from_a_saturated_reading_on(stream: pd.DataFrame) -> pd.DataFrame:
    """Return `stream` from the first touch on, with counts of 4095 in the first reading."""
    held = stream[REST_ROWS:].copy()
    held.iloc[0, [place for place, name in enumerate(held) if "biotac" in name]] = 4095
    return held


def without_thumb(stream: pd.DataFrame) -> pd.DataFrame:
    """Return `stream` with the thumb at rest, as in the first row, with noise of three counts."""
    thumb = [name for name in stream.columns if name.startswith("th_")]
    noise = np.random.default_rng(1).normal(0.0, 3.0, (len(stream), len(thumb)))
    stream.loc[:, thumb] = (stream[thumb].iloc[0].to_numpy() + noise).round().astype(int)
    return stream


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (times(1e-6), "readings are 0 us apart: is the time in seconds, with fractions?"),
        (every(10), "readings are 100 ms apart (10 Hz): a grasp settles from 20 Hz on, or"),
        (lambda stream: stream[REST_ROWS:], "no 100 readings of an open hand come first (1 s at"),
        (held_from_a_saturated_reading_on, "no 100 readings of an open hand come first (1 s at"),
        (held_without_one_electrode, "(1 s at this rate), or electrodes were not read (200 r"),
        (every(4), "no 100 readings of an open hand come first (4 s at"),
        (lambda stream: stream[: REST_ROWS + 5], "no finger touched: the hand was open"),
        (without_thumb, "th never touched: all required fingers hold a grasp"),
    ],
)
def test_a_stream_without_a_judgement_says_why(tmp_path: Path, change: Change, cause: str) -> None:
    path = tmp_path / "stream.csv"
    change(pd.read_csv(DEMO_RECORDING)[:GRASP_ROWS]).to_csv(path, index=False)
    done = graspd("replay", path)
    assert done.returncode == 1
    assert "nothing was judged:" in done.stderr
    assert cause in done.stderr
    with pytest.warns(UserWarning, match="nothing was judged") as warned:
        list(judge(path))
    assert cause in str(warned[0].message)


def test_a_finger_that_need_not_touch_is_not_a_cause(tmp_path: Path) -> None:
    scene, stream = tmp_path / "right.toml", tmp_path / "stream.csv"
    scene.write_text(
        '[tactile]\ndriver = "spi"\nport = "/nowhere"\n[gate]\nfingers = ["ff", "mf"]\n'
        f'[session]\nkeep = true\nfolder = "{tmp_path}/kept"\n'
    )
    without_thumb(pd.read_csv(DEMO_RECORDING)[: REST_ROWS + 105]).to_csv(stream, index=False)
    done = graspd("session", "seed", scene, stream)
    assert "nothing was judged:" in done.stderr
    assert "never touched" not in done.stderr


def test_a_table_of_broken_sensors_says_why(tmp_path: Path) -> None:
    table = pd.read_csv(DEMO_TABLE)
    electrodes = [name for name in table.columns if "biotac" in name]
    random = np.random.default_rng(1)
    table[electrodes] = random.choice([0, 4095], (len(table), len(electrodes)))
    table.to_csv(tmp_path / "table.csv", index=False)
    done = graspd("replay", tmp_path / "table.csv")
    assert done.returncode == 1
    said = f"{len(table)} of {len(table)} readings saturated: electrodes at 0 or 4095"
    assert said in done.stderr


def test_a_judged_recording_prints_no_explanation() -> None:
    done = graspd("replay", DEMO_RECORDING)
    assert (done.returncode, done.stderr) == (0, "")
