"""Verdicts, their evidence and the figures of a daemon, in words."""

from __future__ import annotations

from graspd.daemon.judge.reasons import Decision
from graspd.daemon.judge.windows import LONG_NS
from graspd.daemon.publish.messages import Status, Verdict
from graspd.daemon.watch.snapshot import Line

SURE_MS = LONG_NS / 1e6
"""Time without motion, ms, after which a slow slide is excluded."""
LIKELY = 0.25
"""Largest `p_slip` with which `stable` is shown as a promise."""
UNCOVERED = Line("risk", "covers only announced lifts, and none was announced")
NO_OUTCOME = "no outcome reported yet"
SUPERVISED = Line(
    "supervised", "lift only while a person watches, and tell the outcome: it teaches"
)


def doubt(verdict: Verdict) -> str | None:
    """Return why outcomes do not support this `stable` verdict yet; None: they do."""
    risk, p_slip = verdict.risk, verdict.p_slip
    if verdict.early:
        return "judged early: it may still slide slowly, and is judged once more"
    if p_slip is None or p_slip > LIKELY:
        return "a slip is too likely for a promise: grasp again, or watch the lift"
    if risk is None or (risk.lifts == 0 and verdict.outcomes == 0):
        return f"{NO_OUTCOME}, so what `stable` is worth here is not known"
    if risk.target is None:
        return "no target is set that would keep slips among `stable` few: [risk]"
    if risk.lifts * risk.target < 1.0:
        return f"too few `stable` lifts are reported yet to show the target, {percent(risk.target)}"
    if risk.slips > risk.lifts * risk.target:
        return "more `stable` lifts slipped than the target so far"
    return None


def rests_on(verdict: Verdict) -> str:
    """Return one line on the outcomes and the risk behind the verdict."""
    network, risk = verdict.p_slip_model, verdict.risk
    said = "" if network is None else f"slip probability by the network alone {percent(network)}, "
    if risk is None or (risk.lifts == 0 and verdict.outcomes == 0):
        return said + NO_OUTCOME
    said += f"rests on {counted(verdict.outcomes, 'lift')}; "
    slipped = f"of {risk.lifts} `stable` ones {risk.slips} slipped"
    said += slipped if risk.lifts else "no `stable` one reported yet"
    return said + ("" if risk.target is None else f", target {percent(risk.target)}")


def stillness(still_ms: float | None) -> str:
    """Return how long a hand has been still; `-` if that is not known."""
    if still_ms is None:
        return "-"
    whole_ms = int(still_ms)
    if still_ms < SURE_MS:
        return f"{whole_ms} ms" + (", may slide" if whole_ms else "")
    return f"{whole_ms} ms" if still_ms < 10_000.0 else f"{whole_ms // 1000} s"


def lift(verdict: Verdict, ended: str | None) -> str:
    """Return `held`, `slipped` or `not reported`; `-`: the verdict did not permit a lift.

    `ended`: outcome, `stable` or `slip`; None: not reported.
    """
    if ended is not None:
        return "held" if ended == "stable" else "slipped"
    return "not reported" if verdict.verdict is Decision.STABLE or verdict.supervised else "-"


def percent(share: float) -> str:
    """Return a share, 0..1, as a text in percent: "9.2 %", "0.31 %", "42 %"."""
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"


def counted(count: int, what: str) -> str:
    """Return a count with its noun."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def learning(verdict: Verdict | None, status: Status | None) -> list[Line]:
    """Return how learning goes, what matters most first."""
    risk = None if verdict is None else verdict.risk
    lines = []
    if status is not None and status.lifts is not None:
        lines.append(Line("never reported", counted(status.lifts.unreported, "lift")))
        if status.lifts.covered is False:
            lines.append(UNCOVERED)
    if risk is not None:
        lines.append(Line("warm-up left", counted(risk.warm_up_left, "outcome")))
        lines.append(Line("outstanding", counted(risk.outstanding, "lift")))
        lines.append(Line("announced", f"{counted(risk.announced, 'lift')}, {risk.awaited} out"))
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
