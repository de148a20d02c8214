"""`graspd report stability`: numerical errors of the whole chain, against references, and bounds.

Three tables: each model, each model on each case, and the steps that are no model's. A bound that
is broken makes the exit code 1.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daemon.measure.stability.cases import StabilityCase, cases, recorded
from daemon.measure.stability.model import Bounds, CaseRow, ModelStability, seasoned_session
from daemon.measure.stability.motion import calibration_rows, gate_rows, joint_rows
from daemon.measure.stability.repair import repair_row
from daemon.measure.stability.session import session_rows
from daemon.measure.stability.steps import StepRow
from daemon.measure.stability.time import clock_rows, wrap_rows
from daemon.measure.stability.trust import trust_rows
from daemon.process.extras import needs
from daemon.process.text import complain, markdown_table, printable, progress
from drivers.base import RecordingError
from models import zoo
from models.contract import ModelError
from models.runtime import TactileModel

if TYPE_CHECKING:
    from daemon.measure.reference.reference import Reference

BROKEN, WRONG = 1, 2
BOUNDS = Bounds()
SEASONED = ", session of 1e9 grasps"
LIKELY, RANDOM = "counts like the training's", "random 12-bit counts"
"""Cases that a seasoned session is measured on as well."""

SUMMARY_TITLES = (
    "model",
    "readings",
    "compared",
    "input error",
    "p_slip error",
    "whole chain",
    "flips",
    "bounds",
)
CASE_TITLES = (
    "model",
    "case",
    "readings",
    "compared",
    "input error",
    "p_slip error",
    "whole chain",
    "mean",
    "flips",
    "verdicts and reasons",
    "bounds",
)
NUMBERS = frozenset(CASE_TITLES[2:9])
"""Columns whose cells stand to the right."""
STEP_TITLES = ("step", "expected", "found", "bounds")
LEGEND = (
    "compared: readings that the network is asked of; the others are flat.",
    "input error: of any element of an input, over the largest magnitude in it; against extended "
    "precision.",
    "p_slip error: against the network in float64, fed with the daemon's own float32 input, and of "
    "what is published.",
    "whole chain: the same from the counts on, with nothing rounded. Not bounded for trees and "
    "quantised networks, whose answer jumps.",
)


@dataclass(frozen=True, slots=True)
class StabilityReport:
    """All that was measured."""

    bounds: Bounds
    cases: list[CaseRow] = field(default_factory=list)
    steps: list[StepRow] = field(default_factory=list)

    @property
    def broken(self) -> int:
        """Rows with a broken bound."""
        return sum(bool(row.problems) for row in self.cases) + sum(
            not row.held for row in self.steps
        )


def run(args: argparse.Namespace) -> int:
    """Measure and print; 1 if a bound is broken, 2 if something is not there or not known."""
    try:
        report = measured(args.model or zoo.names(), args.data, BOUNDS, quick=args.quick)
        if args.markdown is not None:
            args.markdown.write_text("\n".join(_markdown(report)) + "\n", "utf-8")
    except ModuleNotFoundError as error:
        complain(needs("report stability", "train", error))
        return WRONG
    except (ModelError, RecordingError, OSError) as error:
        complain(error)
        return WRONG
    if args.json:
        sys.stdout.write(json.dumps(_as_json(report)) + "\n")
    else:
        sys.stdout.write("\n".join(map(printable, _text(report))) + "\n")
    return BROKEN if report.broken else 0


def measured(
    names: Sequence[str], folder: Path | None, bounds: Bounds, *, quick: bool = False
) -> StabilityReport:
    """Measure the models of these names, and all steps; `quick` is as in `trust_rows`.

    Raises `ModelError`, `RecordingError` for a missing table in `folder`, and
    `ModuleNotFoundError` without the extra `train`.
    """
    models = [TactileModel(zoo.find(name)) for name in names]
    # Imported here, for it takes onnx and PyTorch, and a wrong name should not wait for those.
    from daemon.measure.reference.reference import Reference
    from daemon.measure.stability.network import network_rows, quantised_row

    report = StabilityReport(bounds)
    quantised = []
    for done, model in enumerate(models, 1):
        progress(f"{model.path.stem}, model {done} of {len(models)}")
        reference = Reference(model.path)
        rows = list(_measure(model, reference, folder, bounds))
        report.cases.extend(rows)
        if reference.is_quantised:
            quantised += rows
    progress("steps that are no model's")
    report.steps.extend(repair_row(model.path.stem, model.contract.seen) for model in models)
    for several in (session_rows, joint_rows, calibration_rows, gate_rows, clock_rows, wrap_rows):
        report.steps.extend(several())
    report.steps.extend(trust_rows(quick=quick))
    report.steps.extend(network_rows(models[0].contract, bounds.p_slip))
    worst = max((row.network_error for row in quantised), default=0.0)
    of_these = list(dict.fromkeys(row.model for row in quantised))
    report.steps.append(quantised_row(of_these, worst, bounds.p_slip))
    progress("")
    return report


def _measure(
    model: TactileModel, reference: Reference, folder: Path | None, bounds: Bounds
) -> Iterator[CaseRow]:
    """All cases of one model."""
    contract = model.contract
    every = list(cases(len(contract.fingers), contract.seen))
    every += recorded(contract.fingers, folder)
    named = {case.name: case for case in every}
    young = ModelStability(model, reference, bounds)
    yield from young.measure([*every, young.near_threshold(named[LIKELY].counts.astype(np.uint16))])
    state = seasoned_session(contract)
    if state is None:
        return
    seasoned = ModelStability(model, reference, bounds, state)
    again = [
        StabilityCase(case.name + SEASONED, case.counts, one_hand=case.one_hand)
        for case in (named[LIKELY], named[RANDOM])
    ]
    yield from seasoned.measure(again)


def _text(report: StabilityReport) -> Iterator[str]:
    """Aligned columns; numbers to the right."""
    for titles, rows in _tables(report):
        widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
        for row in (titles, *rows):
            cells = [
                cell.rjust(width) if title in NUMBERS else cell.ljust(width)
                for title, cell, width in zip(titles, row, widths, strict=True)
            ]
            yield "  ".join(cells).rstrip()
        yield ""
    yield from LEGEND
    yield _verdict(report)


def _markdown(report: StabilityReport) -> Iterator[str]:
    for titles, rows in _tables(report):
        yield from markdown_table(titles, rows, right=NUMBERS)
        yield ""
    for line in (*LEGEND, _verdict(report), f"Machine: {_machine()}."):
        yield line
        yield ""


def _tables(report: StabilityReport) -> Iterator[tuple[Sequence[str], list[Sequence[str]]]]:
    names = list(dict.fromkeys(row.model for row in report.cases))
    yield SUMMARY_TITLES, [_summary_cells(name, report) for name in names]
    yield CASE_TITLES, [_case_cells(row) for row in report.cases]
    yield (
        STEP_TITLES,
        [
            (row.step, row.expected, row.found, "kept" if row.held else "BROKEN")
            for row in report.steps
        ],
    )


def _summary_cells(name: str, report: StabilityReport) -> Sequence[str]:
    """The worst of all cases of one model."""
    rows = [row for row in report.cases if row.model == name]
    broken = sum(bool(row.problems) for row in rows)
    return (
        name,
        str(sum(row.readings for row in rows)),
        str(sum(row.compared for row in rows)),
        f"{max(row.input_error for row in rows):.1e}",
        f"{max(row.network_error for row in rows):.1e}",
        f"{max(row.chain_error for row in rows):.1e}",
        str(sum(row.flips for row in rows)),
        f"BROKEN, {broken} of {len(rows)} cases" if broken else "kept",
    )


def _case_cells(row: CaseRow) -> Sequence[str]:
    errors = (row.input_error, row.network_error, row.chain_error, row.mean_error)
    return (
        row.model,
        row.case,
        str(row.readings),
        str(row.compared),
        *(f"{error:.1e}" if row.compared else "-" for error in errors),
        str(row.flips),
        _said(row),
        "BROKEN: " + "; ".join(row.problems) if row.problems else "kept",
    )


def _said(row: CaseRow) -> str:
    """Such as `unknown 24 (never-seen 20, flat 4), slip 3`."""
    reasons = ", ".join(f"{name} {number}" for name, number in row.reasons.items())
    return ", ".join(
        f"{name} {number} ({reasons})" if name == "unknown" else f"{name} {number}"
        for name, number in sorted(row.verdicts.items(), reverse=True)
    )


def _verdict(report: StabilityReport) -> str:
    bounds = (
        f"input {report.bounds.input_relative:.0e} relative, p_slip {report.bounds.p_slip:.0e}, "
        "no verdict flipped further from its threshold than that"
    )
    number = len(report.cases) + len(report.steps)
    return f"{report.broken} of {number} rows break a bound ({bounds})."


def _machine() -> str:
    return f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}"


def _as_json(report: StabilityReport) -> dict[str, object]:
    """Without NaN, which JSON does not have."""
    whole = asdict(report)
    for row in whole["cases"]:
        row |= {
            name: None
            for name, value in row.items()
            if isinstance(value, float) and not math.isfinite(value)
        }
    return {**whole, "broken": report.broken, "machine": _machine()}
