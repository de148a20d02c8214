"""Pictures of summaries: reliability, accuracy-coverage, confusion, objects, young sessions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from sklearn.calibration import CalibrationDisplay
from sklearn.metrics import ConfusionMatrixDisplay

from graspd.models.contract import CLASSES
from graspd.models.training.data.protocols import PROTOCOLS
from graspd.models.training.evaluating.style import (
    BLUE,
    NAVY,
    ORANGE,
    QUIET,
    mark_quick,
    style,
    to_svg,
)
from graspd.models.training.evaluating.summaries import SystemSummary
from graspd.models.training.fitting.standards import SESSION_VARIANTS

FORMATS = ("png", "svg")
DPI = 130
MOST_CURVES = 8
"""Curves in one picture that can still be told apart."""


def draw(summaries: Sequence[SystemSummary], folder: Path, *, quick: bool = False) -> list[Path]:
    """Write the pictures into the folder and return their paths; `quick` marks them as such.

    One of each system in each protocol; one per protocol that compares the best of them; one of
    session calibration, if there is such a system. Raises `OSError`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with style():
        return [
            path
            for name, figure in _figures(summaries)
            for path in _save(figure, folder / name, quick=quick)
        ]


def _figures(summaries: Sequence[SystemSummary]) -> Iterator[tuple[str, Figure]]:
    """Yield the name and the figure of each picture."""
    for summary in summaries:
        yield f"{summary.system}.{summary.protocol}", _report(summary)
    for protocol in PROTOCOLS:
        here = [summary for summary in summaries if summary.protocol == protocol]
        if len(here) > 1:
            yield f"coverage.{protocol}", _comparison(here)
    sessions = [summary for summary in summaries if summary.protocol == "session"]
    sessions = [summary for summary in sessions if len(summary.variants) > 1]
    if sessions:
        yield "session-calibration", _calibration(sessions)


def _save(figure: Figure, stem: Path, *, quick: bool) -> list[Path]:
    # Without a canvas of its own, a figure would ask for a window system.
    FigureCanvasAgg(figure)
    if quick:
        mark_quick(figure)
    bitmap, drawing = (stem.with_name(f"{stem.name}.{suffix}") for suffix in FORMATS)
    figure.savefig(bitmap, dpi=DPI)
    drawing.write_text(to_svg(figure, stem.name, []))
    return [bitmap, drawing]


def _report(summary: SystemSummary) -> Figure:
    figure = Figure(figsize=(13.0, 9.5), layout="constrained")
    f1 = summary.main.spreads["f1"]
    figure.suptitle(
        f"{summary.system}, protocol {summary.protocol} ({summary.headline}): "
        f"F1 {100 * f1.mean:.1f} % over {f1.seeds} x {f1.folds} trainings",
        fontsize=13,
    )
    grid = figure.add_gridspec(3, 2, width_ratios=(1.0, 1.15))
    _reliability(figure.add_subplot(grid[0, 0]), summary)
    _coverage(figure.add_subplot(grid[1, 0]), summary)
    _confusion(figure.add_subplot(grid[2, 0]), summary)
    _objects(figure.add_subplot(grid[:, 1]), summary)
    return figure


def _reliability(axes: Axes, summary: SystemSummary) -> None:
    predicted, slipped, grasps = np.array(summary.main.bins).T
    CalibrationDisplay(slipped, predicted, predicted).plot(ax=axes, color=NAVY)
    axes.scatter(predicted, slipped, s=10.0 + 300.0 * grasps / grasps.sum(), color=ORANGE)
    ece = summary.main.spreads["ece"].mean
    axes.set_title(f"Reliability (ECE of a fold {100 * ece:.1f} %)", fontsize=10)
    axes.set(xlabel="predicted slip probability (size: grasps)", ylabel="share that slipped")


def _coverage(axes: Axes, summary: SystemSummary) -> None:
    axes.plot(*_curve(summary), color=NAVY, label="all verdicts")
    for wanted, threshold in summary.main.thresholds.items():
        if threshold is not None:
            label = f"{100 * float(wanted):g} % from {threshold.confidence:.2f}"
            axes.plot(100.0 * threshold.coverage, 100.0 * threshold.accuracy, "o", label=label)
    axes.legend(loc="lower left", fontsize=8)
    axes.set_title("Accuracy of the most confident verdicts, and reject thresholds", fontsize=10)
    axes.set(xlim=(0.0, 103.0), xlabel="coverage, %", ylabel="accuracy, %")


def _curve(summary: SystemSummary) -> tuple[list[float], list[float]]:
    """Return coverage and accuracy, %."""
    curve = summary.main.curve
    return [100.0 * point.coverage for point in curve], [100.0 * point.accuracy for point in curve]


def _confusion(axes: Axes, summary: SystemSummary) -> None:
    display = ConfusionMatrixDisplay(np.array(summary.main.confusion), display_labels=CLASSES)
    display.plot(ax=axes, cmap="Blues", colorbar=False)
    axes.grid(visible=False)
    axes.set(title="Confusion (grasps of all seeds)", xlabel="judged", ylabel="was")


def _objects(axes: Axes, summary: SystemSummary) -> None:
    """F1 as bars, accuracy with its interval as points: the worst object on top."""
    ranked = sorted(summary.main.objects.items(), key=lambda item: -item[1].f1)
    places = range(len(ranked))
    axes.barh(places, [100.0 * one.f1 for _, one in ranked], color=BLUE, alpha=0.45, label="F1")
    shares = [one.share for _, one in ranked]
    axes.errorbar(
        [100.0 * share.accuracy for share in shares],
        places,
        xerr=(
            [100.0 * (share.accuracy - share.low) for share in shares],
            [100.0 * (share.high - share.accuracy) for share in shares],
        ),
        fmt="o",
        markersize=3,
        linewidth=0.9,
        color=NAVY,
        label="accuracy, 95 %",
    )
    axes.set_yticks(places, [f"{name} ({one.share.grasps})" for name, one in ranked], fontsize=7.5)
    axes.set(ylim=(-0.8, len(ranked) - 0.2), xlim=(0.0, 101.0), xlabel="%")
    axes.set_title("Objects (grasps), slip positive", fontsize=10, loc="left")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.995), ncols=2, fontsize=8, frameon=False)
    axes.grid(visible=False, axis="y")


def _comparison(summaries: Sequence[SystemSummary]) -> Figure:
    """Accuracy-coverage curves of the best systems of a protocol."""
    ranked = sorted(summaries, key=lambda one: -one.main.coverages["0.8"])[:MOST_CURVES]
    figure = Figure(figsize=(8.0, 5.5), layout="constrained")
    axes = figure.subplots()
    for summary in ranked:
        right = 100 * summary.main.coverages["0.8"]
        axes.plot(*_curve(summary), label=f"{summary.system} ({right:.1f} % at 80 %)")
    axes.axvline(80.0, color=QUIET, linewidth=0.8, linestyle="--")
    title = f"Accuracy of the most confident verdicts, protocol {ranked[0].protocol}"
    axes.set(title=title, xlabel="coverage, %", ylabel="accuracy, %")
    axes.legend(fontsize=8, loc="lower left")
    return figure


def _calibration(summaries: Sequence[SystemSummary]) -> Figure:
    """F1 in a later session by the number of unlabelled grasps, and of a running session."""
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots()
    variants, shown = SESSION_VARIANTS, len(SESSION_VARIANTS) - 2  # without the running ones
    for index, summary in enumerate(summaries[:MOST_CURVES]):
        values = [100.0 * summary.variants[name].spreads["f1"].mean for name in variants]
        colour = f"C{index}"
        axes.plot(range(shown), values[:shown], "o-", color=colour, label=summary.system)
        axes.plot(range(shown, len(variants)), values[shown:], "s", color=colour)
    labels = [name.removeprefix("n") if name[1:].isdigit() else name for name in variants]
    axes.set_xticks(range(len(variants)), [label.replace("-", ",\n") for label in labels])
    axes.set(
        title="Protocol session: palm_45 by palm_down + palm_side, objects left out",
        xlabel="unlabelled grasps of the session that calibrate it",
        ylabel="F1, %",
    )
    axes.legend(fontsize=8, loc="lower right")
    return figure
