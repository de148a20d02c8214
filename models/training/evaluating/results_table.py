"""RESULTS.md: the paper's figures beside ours, and all systems, as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress

from graspd.models.training.data.protocols import ABOUT, PROTOCOLS, STANDARD, EvalProtocol
from graspd.models.training.evaluating.findings import FINDINGS, HOW_SURE
from graspd.models.training.evaluating.metrics import Spread, paired_difference
from graspd.models.training.evaluating.summaries import GROUPS, HEADLINE, SystemSummary
from graspd.models.training.fitting.standards import RUNNING, RUNNING_SORTED, SESSION_VARIANTS
from graspd.models.training.systems.registry import SYSTEMS, PaperFigure, System

NOT_RUN = "-"
REFERENCE = "cnn1"
"""The paper's best network: what every system is compared with."""
FIGURES = ("f1", "accuracy", "precision", "recall")
"""Figures that the paper gives."""

ONE_ROW = (
    "A row is made again by its system, its protocols and its seeds in place of those of the "
    "command; of several commands the first stands for all rows that have no other."
)


Row = Sequence[str]
ByGroup = dict[tuple[str, EvalProtocol], SystemSummary]


def results_table(
    summaries: Sequence[SystemSummary],
    command: str,
    made_with: Mapping[str, str],
    *,
    quick: bool = False,
) -> str:
    """Return the whole document as Markdown; what was not run is `-`.

    `command`, `made_with`: the command line, and versions by name, that made the summaries.
    """
    by_group: ByGroup = {(summary.system, summary.protocol): summary for summary in summaries}
    sections = (
        _head(summaries, quick=quick),
        _findings(by_group),
        _paper(by_group),
        _systems(by_group),
        _sessions(by_group),
        _days(by_group),
        _differences(by_group),
        _everything(summaries),
        _how(summaries, command, made_with),
    )
    return "\n\n".join(paragraph for section in sections for paragraph in section) + "\n"


def _head(summaries: Sequence[SystemSummary], *, quick: bool) -> Iterator[str]:
    yield "# Results"
    yield (
        "This page is for those who compare models. Figures are F1 in %, slip positive, unless a "
        "column says otherwise. `+-` is the standard deviation over the folds (`unknown`: over the "
        "trainings), s.e. the standard error over the split seeds. A model's card (`graspd models "
        "NAME`) has the first seed alone."
    )
    if quick:
        yield "**Made with `--quick`: hardly trained, on few grasps. The figures mean nothing.**"
    shown = {*STANDARD, *(summary.protocol for summary in summaries)}
    yield "\n".join(f"- `{name}`: {ABOUT[name]}" for name in PROTOCOLS if name in shown)


def _findings(by_group: ByGroup) -> Iterator[str]:
    figures = _figures(by_group)
    lines = []
    for finding in FINDINGS:
        with suppress(KeyError):  # of what was not run
            lines.append(f"- {finding.format_map(figures)}")
    if lines:
        yield "## Findings"
        yield "\n".join(lines)
        yield HOW_SURE


def _figures(by_group: ByGroup) -> dict[str, str]:
    """Return the figures of all summaries by their key in a finding."""
    figures = {}
    for (system, protocol), summary in by_group.items():
        key, spreads = f"{system}/{protocol}", summary.main.spreads
        figures[key] = _value(spreads["f1"])
        figures[f"{key}/auc"] = f"{spreads['auc'].mean:.2f}"
        reference = by_group.get((REFERENCE, protocol))
        if reference is not None:
            figures[f"{key}/difference"] = _difference(summary, reference)
        for published in SYSTEMS[system].published:
            if published.protocol == protocol:
                figures[f"{key}/paper"] = _of_paper(published.f1)
    return figures


def _paper(by_group: ByGroup) -> Iterator[str]:
    yield "## 1. The paper's systems"
    yield _table(
        ("system", "protocol", "figure", "paper", "ours", "difference"),
        (
            row
            for system in SYSTEMS.values()
            for published in system.published
            for row in _published(system, published, by_group)
        ),
    )


def _published(system: System, published: PaperFigure, by_group: ByGroup) -> Iterator[Row]:
    """A row for each figure that the paper gives."""
    summary = by_group.get((system.name, published.protocol))
    for figure in FIGURES:
        paper = getattr(published, figure)
        if paper is None:
            continue
        ours = summary.main.spreads[figure] if summary else None
        yield (
            f"`{system.name}`",
            f"`{published.protocol}`",
            figure.replace("f1", "F1"),
            _of_paper(paper),
            _value(ours),
            f"{100 * ours.mean - paper[0]:+.1f}" if ours else NOT_RUN,
        )


def _of_paper(figure: tuple[float, float]) -> str:
    return f"{figure[0]:.1f} +- {figure[1]:.1f}"


def _systems(by_group: ByGroup) -> Iterator[str]:
    yield "## 2. All systems, all protocols"
    yield (
        f"In `session`, systems with session calibration have seen {HEADLINE[1:]} unlabelled "
        "grasps of other objects of that session, the others none. `parameters` are the most of "
        "any protocol."
    )
    rows = []
    for name in SYSTEMS:
        row = [by_group.get((name, protocol)) for protocol in STANDARD]
        if any(row):
            size = max(summary.parameters for summary in row if summary)
            rows.append((f"`{name}`", f"{size:,}", *(_with_error(summary) for summary in row)))
    yield _table(("system", "parameters", *(f"`{protocol}`" for protocol in STANDARD)), rows)


def _sessions(by_group: ByGroup) -> Iterator[str]:
    yield "## 3. Session calibration"
    yield (
        "Protocol `session`, by what the session has shown before: nothing; 5 to 50 unlabelled "
        "grasps of other objects; all of them; a running session from nothing, each grasp judged "
        "before it counts, with the objects mixed or one after the other."
    )
    columns = [
        variant[1:] if variant[1:].isdigit() else variant.replace("-", ", ")
        for variant in SESSION_VARIANTS
    ]
    here = {
        name: by_group[name, "session"].variants
        for name in SYSTEMS
        if (name, "session") in by_group
    }
    shown = []
    for name, variants in here.items():
        f1 = {key: variant.spreads["f1"] for key, variant in variants.items()}
        shown.append((f"`{name}`", *(_value(f1.get(key)) for key in SESSION_VARIANTS)))
    yield _table(("system", *columns), shown)
    young = {name: variants[RUNNING].ages for name, variants in here.items() if RUNNING in variants}
    if young:
        yield "Accuracy, %, in a running session (objects mixed), by grasps before:"
        bounds = sorted({age.grasps_before for ages in young.values() for age in ages})
        rows = []
        for name, ages in young.items():
            by_bound = {age.grasps_before: f"{100 * age.share.accuracy:.1f}" for age in ages}
            rows.append((f"`{name}`", *(by_bound.get(bound, NOT_RUN) for bound in bounds)))
        yield _table(("system", *map(str, bounds)), rows)


def _days(by_group: ByGroup) -> Iterator[str]:
    yield "## 4. Other days"
    here = [by_group[name, "days"] for name in SYSTEMS if (name, "days") in by_group]
    trainings = ", ".join(f"`{one.system}` {len(one.seeds)} x {one.folds}" for one in here)
    yield (
        "Protocol `days`: each table is a session from nothing, its grasps judged one after the "
        "other before they count, without labels. F1 / slips among what is called stable, "
        "%, every grasp judged, in random order; seeds times trainings: " + (trainings or NOT_RUN)
    )
    order = {RUNNING: "random", RUNNING_SORTED: "object by object"}
    rows, more = [], []
    for one in here:
        cells = (
            f"{_percent(each.every.f1)} / {_percent(each.every.slips_among_stable)}"
            for each in one.main.days.values()
        )
        rows.append((f"`{one.system}`", *cells))
        for name, variant in one.variants.items():
            figures = variant.days["all"]
            every, judged = figures.every, figures.judged
            fractions = (
                *(every.f1, every.slips_among_stable),
                *(every.slips_called_stable, every.stable_called_slip),
                *(figures.coverage, judged.f1, judged.slips_among_stable, figures.refused_slipped),
            )
            names = f"`{one.system}`", order.get(name, "any")
            more.append((*names, *map(_percent, fractions)))
    yield _table(("system", *GROUPS), rows)
    yield (
        "All streams together. The daemon calls `unknown` what is like nothing in the training: "
        "those grasps are in the first columns and not in those of `judged`."
    )
    head = ("F1", "slips among stable", "slips called stable", "stable called slip", "judged")
    of_judged = ("F1 of judged", "slips among stable of judged", "slips among refused")
    yield _table(("system", "order", *head, *of_judged), more)


def _differences(by_group: ByGroup) -> Iterator[str]:
    yield "## 5. Differences on the same splits"
    yield (
        f"F1 less that of `{REFERENCE}`, and less that of the protocol's best, in percentage "
        "points. The standard error is over all folds of all seeds, corrected for trainings that "
        "share their grasps (Nadeau and Bengio 2003); in `unknown` it is over the trainings."
    )
    rows = []
    for protocol in PROTOCOLS:
        here = [by_group[name, protocol] for name in SYSTEMS if (name, protocol) in by_group]
        if len(here) < 2:
            continue
        best = max(here, key=lambda summary: summary.main.spreads["f1"].mean)
        reference = by_group.get((REFERENCE, protocol))
        for summary in here:
            to_others = [_difference(summary, other) for other in (reference, best)]
            if to_others != [NOT_RUN, NOT_RUN]:
                rows.append((f"`{summary.system}`", f"`{protocol}`", *to_others))
    yield _table(("system", "protocol", f"to `{REFERENCE}`", "to the best"), rows)


def difference(ours: SystemSummary, theirs: SystemSummary) -> tuple[float, float | None] | None:
    """Return our mean F1 less theirs on the splits that both have judged, and its standard error.
    None: no split is the same, for other data or another number of folds, say."""
    seeds = [seed for seed in ours.seeds if seed in theirs.seeds]
    if not seeds or ours.folds != theirs.folds or ours.data != theirs.data:
        return None
    pairs = [
        (one, other)
        for seed in seeds
        for one, other in zip(_f1_of(ours, seed), _f1_of(theirs, seed), strict=True)
        if one is not None and other is not None
    ]
    if not pairs:
        return None
    overlap = ours.test_grasps / ours.train_grasps if ours.folds > 1 else 0.0
    return paired_difference([one for one, _ in pairs], [other for _, other in pairs], overlap)


def _f1_of(summary: SystemSummary, seed: int) -> list[float | None]:
    return summary.main.figures["f1"][summary.seeds.index(seed)]


def _everything(summaries: Sequence[SystemSummary]) -> Iterator[str]:
    yield "## 6. Every figure"
    yield (
        "Means. Accuracy, precision and recall are in %. The expected calibration error (ECE) is "
        "of probabilities calibrated by a temperature of the other folds. `at 80 %` is the "
        "accuracy, %, of the 80 % most confident verdicts, `s` the seconds of one training."
    )
    percent, fractions = ("accuracy", "precision", "recall"), ("auc", "ece")
    yield _table(
        (
            *("system", "protocol", "accuracy", "precision", "recall"),
            *("AUC", "ECE", "at 80 %", "seeds", "s"),
        ),
        (
            (
                f"`{summary.system}`",
                f"`{summary.protocol}`",
                *(_percent(summary.main.spreads[name].mean) for name in percent),
                *(f"{summary.main.spreads[name].mean:.3f}" for name in fractions),
                f"{100 * summary.main.coverages['0.8']:.1f}",
                str(len(summary.seeds)),
                f"{summary.seconds / _trainings(summary):.1f}",
            )
            for summary in summaries
        ),
    )


def _how(
    summaries: Sequence[SystemSummary], command: str, made_with: Mapping[str, str]
) -> Iterator[str]:
    yield "## How this was made"
    yield f"    {command}"
    yield ONE_ROW
    total = sum(summary.seconds for summary in summaries)
    yield (
        f"{sum(map(_trainings, summaries))} trainings, {_duration(total)} in all on one thread "
        "each. Without names, protocols and seeds the command makes everything, what is `-` too: "
        "more than a day on two cores."
    )
    yield ", ".join(f"{name} {version}" for name, version in made_with.items()) + "."
    files = {file.name: file for summary in summaries for file in summary.files}
    if files:
        yield "Data (SHA-256, grasps used):"
        yield "\n".join(
            f"- `{file.name}.csv` {file.sha256}, {file.rows}" for file in files.values()
        )


def _table(header: Row, rows: Iterable[Row]) -> str:
    lines = [" | ".join(cells) for cells in (header, *rows)]
    rule = "|" + "---|" * len(header)
    return "\n".join((f"| {lines[0]} |", rule, *(f"| {line} |" for line in lines[1:])))


def _trainings(summary: SystemSummary) -> int:
    return len(summary.seeds) * summary.folds


def _percent(fraction: float | None) -> str:
    return NOT_RUN if fraction is None else f"{100 * fraction:.1f}"


def _value(spread: Spread | None) -> str:
    if spread is None:
        return NOT_RUN
    alone = spread.seeds * spread.folds == 1
    return f"{100 * spread.mean:.1f}" + ("" if alone else f" +- {100 * spread.std:.1f}")


def _with_error(summary: SystemSummary | None) -> str:
    if summary is None:
        return NOT_RUN
    spread = summary.main.spreads["f1"]
    error = "" if spread.error is None else f" (s.e. {100 * spread.error:.2f})"
    return _value(spread) + error


def _difference(ours: SystemSummary, theirs: SystemSummary | None) -> str:
    if theirs is None or ours is theirs:
        return NOT_RUN
    gap = difference(ours, theirs)
    if gap is None:
        return NOT_RUN
    mean, error = gap
    return f"{100 * mean:+.1f}" + ("" if error is None else f" +- {100 * error:.1f}")


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    if seconds < 7200.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"
