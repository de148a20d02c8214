"""Tactile images of grasps for users and their own networks (paper, section II-A)."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graspd.biotac import ELECTRODES, TABLE_FINGERS
from graspd.extras import require
from graspd.models.counts import column_names, counts_of, fingers_of
from graspd.models.layout import LAYOUTS, Layout
from graspd.models.tactile_image import Fill, fill_matrix

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def tactile_images(
    counts: ArrayLike, layout: str = "D1", *, fill: str = "neighbour-mean"
) -> NDArray[np.float64]:
    """Return the images of n grasps in counts, shape (n, height, width, fingers): D1 is 12 x 11.

    `counts`: as `GraspModel.predict` takes them, of any fingers. `layout`: `D1`, `D2a`, `D2b` or
    `D3`. `fill`: value of a pixel without an electrode, and of a broken one; `neighbour-mean`: mean
    of its 8 neighbours, in passes; `least-contact`: the finger's largest count. The image of a
    finger without a working electrode is NaN. Raises `ValueError`.
    """
    if layout not in LAYOUTS:
        raise ValueError(f"no layout is called {layout!r}: they are {', '.join(LAYOUTS)}")
    if fill not in list(Fill):
        raise ValueError(f"no fill is called {fill!r}: they are {', '.join(Fill)}")
    values, places = counts_of(counts), LAYOUTS[layout]
    broken = np.isnan(values)
    sound = np.where(broken, 0.0, values)
    terms = np.concatenate([sound, sound.max(axis=2, keepdims=True)], axis=2)
    images = terms @ _matrix(places, Fill(fill), tuple(range(ELECTRODES))).T
    for grasp, finger in np.argwhere(broken.any(axis=2)):
        work = tuple(np.flatnonzero(~broken[grasp, finger]).tolist())
        images[grasp, finger] = np.nan
        if work:
            images[grasp, finger] = _matrix(places, Fill(fill), work) @ terms[grasp, finger]
    return images.transpose(0, 2, 1).reshape(len(values), *places.shape, values.shape[1])


def plot_grasp(counts: ArrayLike, layout: str = "D1", *, fill: str = "neighbour-mean") -> Figure:
    """Return a figure of one grasp: each finger's image, with its electrodes' numbers in place.

    `counts`: of one grasp, shape (fingers, 24) or (1, fingers, 24), or a table of one row. Save the
    figure with `savefig`. Raises `ValueError`, and `ModuleNotFoundError` without matplotlib.
    """
    require("matplotlib", "plot_grasp", "report")
    from matplotlib import pyplot as plt

    names = column_names(counts)
    if not names and np.ndim(counts) == 2:
        counts = [counts]  # type: ignore[assignment]  # of length 1
    one = counts_of(counts)
    if len(one) != 1:
        raise ValueError(f"it draws one grasp, and {len(one)} were given")
    if np.isnan(one).all():
        raise ValueError("no electrode of this grasp works")
    images = tactile_images(one, layout, fill=fill)[0]
    number = images.shape[2]
    titles = fingers_of(names) or (TABLE_FINGERS if number == len(TABLE_FINGERS) else ())
    figure = plt.figure(figsize=(3.2 * number + 0.8, 3.6), layout="constrained")
    plt.close(figure)  # a notebook would draw the figure twice
    panels = figure.subplots(1, number, squeeze=False)[0]
    for finger, axes in enumerate(panels):
        drawn = axes.imshow(images[..., finger], vmin=np.nanmin(images), vmax=np.nanmax(images))
        axes.set_title(titles[finger] if titles else f"finger {finger + 1}")
        axes.set_axis_off()
        _number_electrodes(axes, LAYOUTS[layout], np.isnan(one[0, finger]))
    figure.colorbar(drawn, ax=panels, label="count (contact lowers it)")
    return figure


@lru_cache(maxsize=64)
def _matrix(layout: Layout, fill: Fill, electrodes: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the fill matrix, cached: broken electrodes are mostly the same in all grasps."""
    return fill_matrix(layout, fill, electrodes)


def _number_electrodes(axes: Axes, layout: Layout, broken: NDArray[np.bool_]) -> None:
    """Write each electrode's number, from 1, on its pixel; red for a broken one."""
    for place in range(ELECTRODES):
        colour = "red" if broken[place] else "white"
        axes.text(
            layout.columns[place],
            layout.rows[place],
            str(place + 1),
            ha="center",
            va="center",
            size=8,
            color=colour,
            bbox={"boxstyle": "circle,pad=0.15", "facecolor": "#1f2328", "edgecolor": "none"},
        )
