"""Pictures of figures: reliability, accuracy-coverage, confusion, objects, young sessions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from sklearn.calibration import CalibrationDisplay
from sklearn.metrics import ConfusionMatrixDisplay

from graspd.models.contract import CLASSES
from graspd.models.training.data.protocols import PROTOCOLS
from graspd.models.training.evaluating.figures import Figures, right
from graspd.models.training.evaluating.metrics import confusion, coverage_curve
from graspd.models.training.evaluating.style import BLUE, NAVY, QUIET, mark_quick, style, to_svg
from graspd.models.training.fitting.standards import SESSION_VARIANTS, Variant

DPI = 130
MOST_CURVES = 8
"""Curves in one picture that can still be told apart."""


def draw(several: Sequence[Figures], folder: Path, *, quick: bool = False) -> list[Path]:
    """Write the pictures into the folder and return their paths; `quick` marks them as such.

    One of each system in each protocol; one per protocol that compares the best of them; one of
    session calibration, if there is such a system. Raises `OSError`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with style():
        return [
            path
            for name, figure in _pictures(several)
            for path in _save(figure, folder / name, quick=quick)
        ]


def _pictures(several: Sequence[Figures]) -> Iterator[tuple[str, Figure]]:
    """Yield the name and the figure of each picture."""
    for one in several:
        yield f"{one.system}.{one.protocol}", _report(one)
    for protocol in PROTOCOLS:
        here = [one for one in several if one.protocol == protocol]
        if len(here) > 1:
            yield f"coverage.{protocol}", _comparison(here)
    sessions = [one for one in several if one.headline == Variant.N50]
    if sessions:
        yield "session-calibration", _calibration(sessions)


def _save(figure: Figure, stem: Path, *, quick: bool) -> list[Path]:
    # Without a canvas of its own, a figure would ask for a window system.
    FigureCanvasAgg(figure)
    if quick:
        mark_quick(figure)
    bitmap, drawing = (stem.with_name(f"{stem.name}.{suffix}") for suffix in ("png", "svg"))
    figure.savefig(bitmap, dpi=DPI)
    drawing.write_text(to_svg(figure, stem.name, []))
    return [bitmap, drawing]


def _report(one: Figures) -> Figure:
    figure = Figure(figsize=(13.0, 9.5), layout="constrained")
    f1, rows = one.spread(), one.of_variant()
    figure.suptitle(
        f"{one.system}, protocol {one.protocol} ({one.headline}): "
        f"F1 {100 * f1.mean:.1f} % over {f1.seeds} x {f1.folds} trainings",
        fontsize=13,
    )
    grid = figure.add_gridspec(3, 2, width_ratios=(1.0, 1.15))
    reliability = figure.add_subplot(grid[0, 0])
    CalibrationDisplay.from_predictions(
        rows["slipped"], rows["probability"], n_bins=15, ax=reliability, color=NAVY
    )
    ece = one.spread("ece").mean
    reliability.set_title(f"Reliability (ECE of a fold {100 * ece:.1f} %)", fontsize=10)
    reliability.set(xlabel="predicted slip probability", ylabel="share that slipped")
    _coverage(figure.add_subplot(grid[1, 0]), [one])
    judged = figure.add_subplot(grid[2, 0])
    ConfusionMatrixDisplay(confusion(rows), display_labels=CLASSES).plot(
        ax=judged, cmap="Blues", colorbar=False
    )
    judged.grid(visible=False)
    judged.set(title="Confusion (grasps of all seeds)", xlabel="judged", ylabel="was")
    _objects(figure.add_subplot(grid[:, 1]), one)
    return figure


def _coverage(axes: Axes, several: Sequence[Figures]) -> None:
    for one in several:
        rows = one.of_variant()
        curve = coverage_curve(rows["probability"], rows["slipped"])
        axes.plot(
            [100.0 * point.coverage for point in curve],
            [100.0 * point.accuracy for point in curve],
            label=f"{one.system} ({100 * one.accuracy_at(0.8):.1f} % at 80 %)",
        )
    axes.axvline(80.0, color=QUIET, linewidth=0.8, linestyle="--")
    axes.set_title("Accuracy of the most confident verdicts", fontsize=10)
    axes.set(xlabel="coverage, %", ylabel="accuracy, %")
    axes.legend(fontsize=8, loc="lower left")


def _objects(axes: Axes, one: Figures) -> None:
    """Accuracy of each object's grasps: the worst object on top."""
    rows = one.of_variant()
    shares = right(rows).groupby(rows["object"]).agg(["mean", "count"])
    shares = shares.sort_values("mean", ascending=False)
    places = range(len(shares))
    axes.barh(places, 100.0 * shares["mean"], color=BLUE, alpha=0.45)
    names = [f"{name} ({count})" for name, count in shares["count"].items()]
    axes.set_yticks(places, names, fontsize=7.5)
    axes.set(ylim=(-0.8, len(shares) - 0.2), xlim=(0.0, 101.0), xlabel="accuracy, %")
    axes.set_title("Objects (grasps of all seeds)", fontsize=10, loc="left")
    axes.grid(visible=False, axis="y")


def _comparison(several: Sequence[Figures]) -> Figure:
    """Accuracy-coverage curves of the best systems of a protocol."""
    ranked = sorted(several, key=lambda one: -one.accuracy_at(0.8))[:MOST_CURVES]
    figure = Figure(figsize=(8.0, 5.5), layout="constrained")
    figure.suptitle(f"Protocol {ranked[0].protocol}", fontsize=11)
    _coverage(figure.subplots(), ranked)
    return figure


def _calibration(several: Sequence[Figures]) -> Figure:
    """F1 in a later session by the number of unlabelled grasps, and of a running session."""
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots()
    for one in several[:MOST_CURVES]:
        values = [100.0 * one.spread(variant=variant).mean for variant in SESSION_VARIANTS]
        axes.plot(SESSION_VARIANTS, values, "o-", label=one.system)
    axes.set(
        title="Protocol session: palm_45 by palm_down + palm_side, objects left out",
        xlabel="what calibrates the session",
        ylabel="F1, %",
    )
    axes.legend(fontsize=8, loc="lower right")
    return figure
