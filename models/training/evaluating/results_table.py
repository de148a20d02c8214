"""RESULTS.md: the paper's figures beside ours, and all systems, as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress

from graspd.models.training.data.datasets import Grasps
from graspd.models.training.data.protocols import ABOUT, PROTOCOLS, EvalProtocol
from graspd.models.training.evaluating.figures import GROUPS, Figures, by_age, by_day, right
from graspd.models.training.evaluating.files import markdown_table
from graspd.models.training.evaluating.findings import FINDINGS, HOW_SURE, SEALED
from graspd.models.training.evaluating.metrics import Spread, paired_difference
from graspd.models.training.fitting.standards import SESSION_VARIANTS, Variant
from graspd.models.training.systems.explained import TITLES, explained
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
ByGroup = dict[tuple[str, EvalProtocol], Figures]


def results_table(
    several: Sequence[Figures],
    grasps: Grasps,
    command: str,
    made_with: Mapping[str, str],
    *,
    quick: bool = False,
) -> str:
    """Return the whole document as Markdown; what was not run is `-`.

    `several`: one for each system and protocol. `grasps`: judged grasps. `command`, `made_with`:
    command line, and versions by library. `quick`: the page says that the run was a quick one.
    """
    by_group: ByGroup = {(one.system, one.protocol): one for one in several}
    sections = (
        _head(quick=quick),
        _findings(by_group),
        _paper(by_group),
        _systems(by_group),
        _sessions(by_group),
        _days(by_group),
        _differences(by_group),
        _everything(several),
        _explained(),
        _sealed(),
        _how(several, grasps, command, made_with),
    )
    return "\n\n".join(paragraph for section in sections for paragraph in section) + "\n"


def _head(*, quick: bool) -> Iterator[str]:
    yield "# Results"
    yield (
        "For those who compare models. Figures are F1 in %, slip positive, unless a "
        "column says otherwise. `+-` is the standard deviation over the folds (`unknown`: over the "
        "trainings), s.e. the standard error over the split seeds. A model's card (`graspd models "
        "NAME`) has the first seed alone."
    )
    if quick:
        yield "**Made with `--quick`: hardly trained, on few grasps. The figures mean nothing.**"
    yield "\n".join(f"- `{name}`: {text}" for name, text in ABOUT.items())


def _findings(by_group: ByGroup) -> Iterator[str]:
    figures = _figures(by_group)
    lines = []
    for finding in FINDINGS:
        with suppress(KeyError):  # a figure that was not computed
            lines.append(f"- {finding.format_map(figures)}")
    if lines:
        yield "## Findings"
        yield "\n".join(lines)
        yield HOW_SURE


def _figures(by_group: ByGroup) -> dict[str, str]:
    """Return the texts of all figures by their key in a finding, such as `svm/cv/difference`."""
    figures = {}
    for (system, protocol), one in by_group.items():
        key = f"{system}/{protocol}"
        figures[key] = _value(one.spread())
        figures[f"{key}/auc"] = f"{one.spread('auc').mean:.2f}"
        reference = by_group.get((REFERENCE, protocol))
        if reference is not None:
            figures[f"{key}/difference"] = _difference(one, reference)
        for published in SYSTEMS[system].published:
            if published.protocol == protocol:
                figures[f"{key}/paper"] = _of_paper(published.f1)
    return figures


def _paper(by_group: ByGroup) -> Iterator[str]:
    yield "## 1. The paper's systems"
    yield _table(
        ("system", "protocol", "figure", "paper", "ours", "difference"),
        [
            row
            for system in SYSTEMS.values()
            for published in system.published
            for row in _published(system, published, by_group)
        ],
    )


def _published(system: System, published: PaperFigure, by_group: ByGroup) -> Iterator[Row]:
    """Yield a row for each figure that the paper gives."""
    one = by_group.get((system.name, published.protocol))
    for figure in FIGURES:
        paper = getattr(published, figure)
        if paper is None:
            continue
        ours = one.spread(figure) if one else None
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
        "In `session`, systems with session calibration have seen 50 unlabelled grasps of other "
        "objects of that session, the others none. `parameters` are the most of any protocol."
    )
    rows = []
    for name in SYSTEMS:
        row = [by_group.get((name, protocol)) for protocol in PROTOCOLS]
        if any(row):
            size = max(one.parameters for one in row if one)
            rows.append((f"`{name}`", f"{size:,}", *map(_with_error, row)))
    yield _table(("system", "parameters", *(f"`{protocol}`" for protocol in PROTOCOLS)), rows)


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
    here = [by_group[name, "session"] for name in SYSTEMS if (name, "session") in by_group]
    shown = []
    for one in here:
        f1 = {variant: _value(one.spread(variant=variant)) for variant in one.variants}
        cells = (f1.get(variant, NOT_RUN) for variant in SESSION_VARIANTS)
        shown.append((f"`{one.system}`", *cells))
    yield _table(("system", *columns), shown)
    young = {
        one.system: {
            age: right(part).mean() for age, part in by_age(one.of_variant(Variant.RUNNING)).items()
        }
        for one in here
        if Variant.RUNNING in one.variants
    }
    if young:
        yield "Accuracy, %, in a running session (objects mixed), by grasps before:"
        bounds = sorted({bound for ages in young.values() for bound in ages})
        rows = [
            (
                f"`{name}`",
                *(_percent(ages.get(bound)) for bound in bounds),
            )
            for name, ages in young.items()
        ]
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
    order: dict[str, str] = {Variant.RUNNING: "random", Variant.RUNNING_SORTED: "object by object"}
    rows, more = [], []
    for one in here:
        cells = (
            f"{_percent(day['every']['f1'])} / {_percent(day['every']['slips_among_stable'])}"
            for day in by_day(one.of_variant()).values()
        )
        rows.append((f"`{one.system}`", *cells))
        for variant in one.variants:
            every_day = by_day(one.of_variant(variant))["all"]
            every, judged = every_day["every"], every_day["judged"]
            fractions = (
                *(every["f1"], every["slips_among_stable"]),
                *(every["slips_called_stable"], every["stable_called_slip"]),
                *(every_day["coverage"], judged["f1"], judged["slips_among_stable"]),
                every_day["refused_slipped"],
            )
            names = f"`{one.system}`", order.get(variant, "any")
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
        best = max(here, key=lambda one: one.spread().mean)
        reference = by_group.get((REFERENCE, protocol))
        for one in here:
            to_others = [_difference(one, other) for other in (reference, best)]
            if to_others != [NOT_RUN, NOT_RUN]:
                rows.append((f"`{one.system}`", f"`{protocol}`", *to_others))
    yield _table(("system", "protocol", f"to `{REFERENCE}`", "to the best"), rows)


def difference(ours: Figures, theirs: Figures) -> tuple[float, float | None] | None:
    """Return our mean F1 less theirs on the splits that both have judged, and its standard error.

    None: they share no split, for example because of another number of folds."""
    if ours.folds != theirs.folds:
        return None
    gaps = (ours.folds_of("f1") - theirs.folds_of("f1")).stack().dropna()
    if gaps.empty:
        return None
    train_grasps = float(ours.trainings["train_grasps"].mean())
    overlap = ours.test_grasps / train_grasps if ours.folds > 1 else 0.0
    return paired_difference(gaps.to_numpy(), overlap)


def _everything(several: Sequence[Figures]) -> Iterator[str]:
    yield "## 6. Every figure"
    yield (
        "Means. Accuracy, precision and recall are in %. The expected calibration error (ECE) is "
        "of probabilities calibrated by a temperature of the other folds. `at 80 %` is the "
        "accuracy, %, of the 80 % most confident verdicts, `s` the seconds of one training."
    )
    rows = [
        (
            f"`{one.system}`",
            f"`{one.protocol}`",
            *(_percent(one.spread(name).mean) for name in ("accuracy", "precision", "recall")),
            *(f"{one.spread(name).mean:.3f}" for name in ("auc", "ece")),
            _percent(one.accuracy_at(0.8)),
            str(len(one.seeds)),
            f"{one.trainings['seconds'].mean():.1f}",
        )
        for one in several
    ]
    titles = ("system", "protocol", "accuracy", "precision", "recall", "AUC", "ECE", "at 80 %")
    yield _table((*titles, "seeds", "s"), rows)


def _explained() -> Iterator[str]:
    yield "## 7. Systems in words"
    yield (
        "The place is that of the row in the paper (arXiv:1809.05551), which has its results in "
        "table III, figure 4 and sections III-B, III-C and III-E. Each command makes the row of "
        "one seed; minutes are of two cores. `graspd evaluate --list` prints this table."
    )
    rows = [
        (f"`{name}`", *words, f"`{command}`", time) for name, *words, command, time in explained()
    ]
    yield _table(TITLES, rows)


def _sealed() -> Iterator[str]:
    text, titles, rows, commands = SEALED
    yield "## 8. The sealed day"
    yield text
    yield _table(titles, rows)
    yield commands


def _how(
    several: Sequence[Figures], grasps: Grasps, command: str, made_with: Mapping[str, str]
) -> Iterator[str]:
    yield "## How this was made"
    yield f"    {command}"
    yield ONE_ROW
    seconds = [one.trainings["seconds"] for one in several]
    yield (
        f"{sum(map(len, seconds))} trainings, {_duration(sum(map(sum, seconds)))} in all on one "
        "thread each. Without names, protocols and seeds the command makes everything, what is `-` "
        "too: more than a day on two cores."
    )
    yield ", ".join(f"{name} {version}" for name, version in made_with.items()) + "."
    yield "Data (SHA-256, grasps used):"
    yield "\n".join(f"- `{file.name}.csv` {file.sha256}, {file.rows}" for file in grasps.files)


def _table(titles: Row, rows: Sequence[Row]) -> str:
    return "\n".join(markdown_table(titles, rows))


def _percent(fraction: float | None) -> str:
    return NOT_RUN if fraction is None else f"{100 * fraction:.1f}"


def _value(spread: Spread | None) -> str:
    if spread is None:
        return NOT_RUN
    alone = spread.seeds * spread.folds == 1
    return f"{100 * spread.mean:.1f}" + ("" if alone else f" +- {100 * spread.std:.1f}")


def _with_error(one: Figures | None) -> str:
    if one is None:
        return NOT_RUN
    spread = one.spread()
    error = "" if spread.error is None else f" (s.e. {100 * spread.error:.2f})"
    return _value(spread) + error


def _difference(ours: Figures, theirs: Figures | None) -> str:
    gap = None if theirs is None or ours is theirs else difference(ours, theirs)
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
