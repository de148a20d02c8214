"""Texts for a person on verdicts, their evidence, and the figures of a daemon."""

from __future__ import annotations

from graspd.daemon.judge.reasons import Decision
from graspd.daemon.judge.windows import LONG_NS
from graspd.daemon.publish.messages import Status, Verdict
from graspd.daemon.trust.lift_book import OutcomeStatus
from graspd.daemon.watch.snapshot import Line

SURE_MS = LONG_NS / 1e6
"""Time without motion, ms, after which a slow slide is excluded."""
LIKELY = 0.25
"""Largest `p_slip` with which `stable` is shown without a doubt."""
SHARE_MIN = 0.01
"""Smallest share that is shown as a number."""
REFUSED = OutcomeStatus.CONTRADICTS, OutcomeStatus.UNKNOWN
UNCOVERED = Line("risk", "covers only announced lifts, and none was announced")
NO_OUTCOME = "no outcome reported yet"
SUPERVISED = Line(
    "supervised", "lift only while a person watches, and tell the outcome: it teaches"
)


def doubt(verdict: Verdict) -> Line | None:
    """Return why this `stable` is doubtful, as a word and a text; None: outcomes support it."""
    risk, p_slip = verdict.risk, verdict.p_slip
    if verdict.early:
        return Line("early", "it may still slide slowly, and is judged once more")
    if p_slip is None or p_slip > LIKELY:
        return Line("risky", "a slip is too likely for a promise: grasp again, or watch the lift")
    if risk is None or (risk.lifts == 0 and verdict.outcomes == 0):
        return Line("unproven", f"{NO_OUTCOME}, so what `stable` is worth here is not known")
    if risk.target is None:
        return Line(
            "unlimited", "no target is set that would keep slips among `stable` few: [risk]"
        )
    if risk.lifts * risk.target < 1.0:
        few = "too few `stable` lifts are reported yet to show the target"
        return Line("unproven", f"{few}, {percent(risk.target)}")
    if risk.slips > risk.lifts * risk.target:
        return Line("disproven", "more `stable` lifts slipped than the target so far")
    return None


def rests_on(verdict: Verdict) -> str:
    """Return a line on the outcomes and the risk behind the verdict, or `NO_OUTCOME` without any;
    before it, if known, the slip probability by the network alone."""
    network, risk = verdict.p_slip_model, verdict.risk
    said = "" if network is None else f"slip probability by the network alone {likely(network)}, "
    if risk is None or (risk.lifts == 0 and verdict.outcomes == 0):
        return said + NO_OUTCOME
    said += f"rests on {counted(verdict.outcomes, 'lift')}; "
    slipped = f"of {risk.lifts} `stable` ones {risk.slips} slipped"
    said += slipped if risk.lifts else "no `stable` one reported yet"
    return said + ("" if risk.target is None else f", target {percent(risk.target)}")


def stillness(still_ms: float | None) -> str:
    """Return as text how long a hand has been still, and whether it may slide; `-`: not known."""
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
    """Return a share that a user set, 0..1, in percent."""
    return f"{100 * share:g} %"


def likely(p_slip: float) -> str:
    """Return a probability in percent, with `< 1 %` and `> 99 %` at the ends."""
    if p_slip < SHARE_MIN:
        return "< 1 %"
    return "> 99 %" if p_slip > 1.0 - SHARE_MIN else f"{100 * p_slip:.0f} %"


def counted(count: int, what: str) -> str:
    """Return a count with its noun, `what`, given in the singular."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def learning(verdict: Verdict | None, status: Status | None) -> list[Line]:
    """Return lines on learning and session, the most important first; most counts of 0 have no
    line. Empty without a status."""
    if status is None:
        return []
    lines = []
    risk, learner = None if verdict is None else verdict.risk, status.learner
    if status.lifts is not None:
        lines += _count("never reported", status.lifts.unreported, "lift")
        if status.lifts.covered is False:
            lines.append(UNCOVERED)
    if risk is not None:
        lines += _count("awaited", risk.outstanding, "outcome")
        lines += _count("announced", risk.announced, "lift", f", {risk.awaited} awaited")
        lines += _count("warm-up left", risk.warm_up_left, "outcome")
        if risk.bound is not None:
            slips = f"{risk.slips} of {counted(risk.lifts, 'lift')}, {int(risk.bound)} allowed"
            lines.append(Line("slips", slips))
    if learner is not None:
        learned = counted(learner.outcomes, "outcome") if learner.enabled else "nothing: it is off"
        lines.append(Line("learned from", learned))
        refused = sum(learner.told.get(kind, 0) for kind in REFUSED)
        lines += _count("refused", refused, "outcome")
    if status.session_grasps is not None:
        missing = "" if status.session_calibrated else "not yet "
        grasps = counted(status.session_grasps, "grasp")
        lines.append(Line("session", f"{grasps}, {missing}calibrated"))
    return lines


def _count(what: str, count: int, noun: str, more: str = "") -> list[Line]:
    return [Line(what, counted(count, noun) + more)] if count else []


def timing(verdict: Verdict | None, status: Status | None, lost: int) -> list[Line]:
    """Return lines on rates, delays and losses; `lost`: number of missing or malformed messages."""
    lines = [] if verdict is None else [Line("age", f"{verdict.age_ms:.1f} ms")]
    if status is not None:
        delays = status.latency_us
        lines += [
            Line("readings", f"{status.readings_hz:.0f} /s"),
            Line("latency", f"{_us(delays.get('p50'))}, 99 % below {_us(delays.get('p99'))}"),
            Line("late", f"{status.late_readings} readings"),
        ]
    return [*lines, Line("lost here", counted(lost, "message"))]


def _us(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f} us"
