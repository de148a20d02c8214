"""Figures of a daemon in words."""

from __future__ import annotations

from daemon.publish.messages import Status, Verdict
from daemon.watch.evidence import counted, percent
from daemon.watch.snapshot import Line


def learning(verdict: Verdict | None, status: Status | None) -> list[Line]:
    """Return how learning goes, what matters most first."""
    risk = None if verdict is None else verdict.risk
    lines = []
    if status is not None and status.lifts is not None:
        lines.append(Line("never told", counted(status.lifts.unreported, "lift")))
    if risk is not None:
        lines.append(Line("warm-up left", counted(risk.warm_up_left, "outcome")))
        lines.append(Line("still out", counted(risk.outstanding, "lift")))
    learner = None if status is None else status.learner
    if learner is not None:
        lines.append(Line("learner", "on" if learner.enabled else "off"))
        lines.append(Line("learned from", counted(learner.outcomes, "outcome")))
        lines.append(Line("uncertainty", percent(learner.uncertainty)))
    if risk is not None and risk.target is not None:
        bound = "no bound" if risk.bound is None else f"at most {risk.bound:.1f}"
        lifts = counted(risk.lifts, "lift")
        lines.append(Line("slips of `stable`", f"{risk.slips} of {lifts}, {bound}"))
    if learner is not None:
        lines += [Line(f"outcomes {kind.value}", str(n)) for kind, n in learner.told.items()]
    return lines


def timing(
    verdict: Verdict | None, status: Status | None, verdicts_hz: float, lost: int, unreadable: int
) -> list[Line]:
    """Return rates, delays and losses; `lost` counts gaps of `seq`."""
    lines = [
        Line("readings", "-" if status is None else f"{status.readings_hz:.0f} /s"),
        Line("verdicts", f"{verdicts_hz:.0f} /s"),
        Line("age", "-" if verdict is None else f"{verdict.age_ms:.1f} ms"),
    ]
    if status is not None:
        delays, jitter = status.latency_us, status.jitter_us
        lines += [
            Line("latency p50, p99", f"{_us(delays.get('p50'))}, {_us(delays.get('p99'))}"),
            Line("longest latency", _us(delays.get("max"))),
            Line("jitter p99", _us(jitter.get("p99"))),
            Line("late", f"{status.late_readings} readings"),
            Line("worst age", f"{status.worst_age_ms:.0f} ms"),
        ]
    return [
        *lines,
        Line("lost here", f"{lost} messages"),
        Line("not understood", f"{unreadable} messages"),
    ]


def session(verdict: Verdict | None, status: Status | None) -> list[Line]:
    """Return whether the session is calibrated, and which electrodes are repaired."""
    said = "this model needs none"
    if status is None:
        said = "-"
    elif status.session_grasps is not None:
        missing = "" if status.session_calibrated else "not yet "
        said = f"{status.session_grasps} grasps, {missing}calibrated"
    repaired = [] if verdict is None else verdict.repaired
    return [Line("session", said), Line("repaired now", ", ".join(repaired) or "nothing")]


def drivers(status: Status | None) -> list[Line]:
    """Return the counters of the drivers that are not 0, and versions."""
    if status is None:
        return []
    lines = [
        Line(f"{driver} {name}", str(count))
        for driver, counters in status.drivers.items()
        for name, count in counters.items()
        if count
    ]
    return lines + [Line(name, version) for name, version in status.versions.items()]


def _us(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f} us"
