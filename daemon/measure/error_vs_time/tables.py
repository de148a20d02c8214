"""The report as figures, Markdown tables and a picture."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from daemon.measure.error_vs_time.picture import (
    DEFAULT,
    PANELS,
    Found,
    Row,
    draw,
    error_of,
    front,
    points,
)
from daemon.process.text import markdown_table

PROTOCOL = "cv"
SUMMARY_MAX = 7
"""Rows of the short table beside the picture."""
SUMMARY_ALWAYS = (DEFAULT, "cnn1", "cnn1-session", "published: loops, Keras predict")


def write(found: Found, folder: Path) -> None:
    """Write `error-vs-time.json`, `.md` and `.svg`. Raises `OSError`."""
    base = folder / "error-vs-time"
    base.with_suffix(".json").write_text(json.dumps(found, indent=1) + "\n")
    base.with_suffix(".md").write_text(table(found) + "\n")
    base.with_suffix(".svg").write_text(draw(found))


def _by_fingers(rows: Sequence[Row]) -> list[list[Row]]:
    """The rows of models, those of the same fingers together: only between them is a choice.

    The whole hand's are first, and in each list the most exact.
    """
    models = [row for row in _sorted(rows) if row["kind"] == "model"]
    kinds = sorted({tuple(row["fingers"]) for row in models}, key=lambda kind: (-len(kind), kind))
    return [[row for row in models if tuple(row["fingers"]) == kind] for kind in kinds] or [[]]


def table(found: Found) -> str:
    """As Markdown: the short table, advice, stages, and all rows, the most exact first."""
    lines = list(markdown_table(SUMMARY_COLUMNS, _summary(found["rows"])))
    lines += ["", *(f"- {text}" for text in advice(found["rows"])), "", *_stages(found), ""]
    lines += markdown_table(COLUMNS, [_cells(row) for row in _sorted(found["rows"])])
    lines += ["", _made(found)]
    return "\n".join(lines)


ASKED = tuple(asked for _, asked in PANELS)
SUMMARY_COLUMNS = ("model, F1 in %", *ASKED, "paced p50 / p99, us", "CPU at 100 Hz")
COLUMNS = (
    "model",
    "fingers",
    "F1, known objects (95 %)",
    "other objects",
    "Brier",
    "ECE",
    "off float64, flips",
    "hot p50 / p99 / p99.9, us",
    "paced p50 / p99, us",
    "CPU at 100 Hz",
    "file, MB",
    "floor, us",
    "start, ms",
    "memory, MiB",
)


def _summary(rows: Sequence[Row]) -> list[list[str]]:
    """Default, published network and way, and the fronts; seven rows at most, the fastest first."""
    chosen = list(SUMMARY_ALWAYS)
    for protocols, _ in PANELS:
        chosen += [point.name for point in front(list(points(rows, protocols)))]
    names = list(dict.fromkeys(chosen))[:SUMMARY_MAX]
    shown = [row for row in rows if row["name"] in names]
    shown.sort(key=lambda row: float(row["time"]["paced_p50_us"]))
    return [[_named(row), *_percents(row), *_paced(row)] for row in shown]


def _named(row: Row) -> str:
    name = f"`{row['name']}`" if row["kind"] == "model" else row["name"]
    return f"{name}, the default" if row["name"] == DEFAULT else name


def _percents(row: Row) -> Iterator[str]:
    return (_percent(error_of(row, protocols)) for protocols, _ in PANELS)


def _percent(error: Row) -> str:
    return f"{100 * error['f1']:.1f}" if error else "-"


def _paced(row: Row) -> tuple[str, str]:
    took = row["time"]
    return (
        f"{took['paced_p50_us']:.0f} / {took['paced_p99_us']:.0f}",
        f"{took['cpu_percent_at_100_hz']:.1f} %",
    )


def _cells(row: Row) -> list[str]:
    error = row["error"].get(PROTOCOL, {})
    other = error_of(row, PANELS[1][0])
    exact, took = row["numerical"], row["time"]
    return [
        _named(row),
        " ".join(row["fingers"]) or "-",
        _interval(error),
        _percent(other),
        "-" if not error else f"{error['brier']:.3f}",
        "-" if not error else f"{error['ece']:.3f}",
        f"{exact['largest']:.0e}, {exact['flipped']}" if "largest" in exact else "-",
        f"{took['hot_p50_us']:.0f} / {took['hot_p99_us']:.0f} / {took['hot_p99.9_us']:.0f}",
        *_paced(row),
        "-" if row["bytes"] is None else f"{row['bytes'] / 1e6:.2f}",
        "-" if row["floor_us"] is None else f"{row['floor_us']:.1f}",
        "-" if row["start_ms"] is None else f"{row['start_ms']:.0f}",
        "-" if row["memory_mib"] is None else f"{row['memory_mib']:.0f}",
    ]


def _interval(error: dict[str, float]) -> str:
    if not error:
        return "-"
    return f"{100 * error['f1']:.1f} ({100 * error['low']:.1f}..{100 * error['high']:.1f})"


def _sorted(rows: Sequence[Row]) -> list[Row]:
    order = {"model": 0, "peer": 1, "floor": 2}
    return sorted(
        rows, key=lambda row: (order[row["kind"]], -row["error"].get(PROTOCOL, {}).get("f1", 0.0))
    )


def _stages(found: Found) -> Iterator[str]:
    yield f"Stages of a reading with `{found['stages']['model']}`, hot:"
    yield ""
    cells = [
        (name, f"{took['p50']:.0f}", f"{took['p99']:.0f}")
        for name, took in found["stages"]["us"].items()
    ]
    yield from markdown_table(("stage", "p50, us", "p99, us"), cells)


def advice(rows: Sequence[Row]) -> Iterator[str]:
    """Which model for which need, by these figures."""
    models, *fewer = _by_fingers(rows)
    for protocol, need in (
        ("cv", "objects that are known, no other day"),
        ("objects", "new objects"),
        ("session", "another day"),
    ):
        judged = [
            (row["error"][protocol]["f1"], row["name"])
            for row in models
            if protocol in row["error"]
        ]
        if judged:
            f1, name = max(judged)
            yield f"For {need}: `{name}`, F1 {100 * f1:.1f} %."
    for best, *_ in fewer:
        if PROTOCOL in best["error"]:
            f1, alone = best["error"][PROTOCOL]["f1"], " and ".join(best["fingers"])
            yield f"For {alone} alone, known objects: `{best['name']}`, F1 {100 * f1:.1f} %."
    base = next((row for row in models if row["name"] == "cnn1" and row["error"]), None)
    if base is None:
        return
    low = base["error"][PROTOCOL]["low"]
    as_good = [row for row in models if row["error"].get(PROTOCOL, {}).get("f1", 0.0) >= low]
    fastest = min(as_good, key=lambda row: float(row["time"]["paced_p50_us"]))
    ratio = base["time"]["paced_p50_us"] / fastest["time"]["paced_p50_us"]
    yield (
        f"For the least time at an F1 within the interval of `cnn1`: `{fastest['name']}`, "
        f"{ratio:.1f} times as fast as `cnn1` when paced."
    )


def _made(found: Found) -> str:
    machine = ", ".join(
        value if name == "processor" else f"{name} {value}"
        for name, value in found["machine"].items()
    )
    return (
        f"{machine}; {found['readings']['hot']} readings hot, {found['readings']['paced']} paced"
        f"{' (--quick: rough)' if found['quick'] else ''}, "
        f"memory {found['bandwidth_bytes_per_s'] / 1e9:.1f} GB/s; `graspd report error-vs-time`"
    )
