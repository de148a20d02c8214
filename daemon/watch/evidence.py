"""What a verdict rests on, in words, and whether that is enough to show `stable` as a promise."""

from __future__ import annotations

from daemon.judge.reasons import Decision
from daemon.judge.windows import LONG_NS
from daemon.publish.messages import Status, Verdict
from daemon.watch.snapshot import Line

SURE_MS = LONG_NS / 1e6
"""Of a hand that has been still for so long nothing slides slowly either."""
LIKELY = 0.25
"""A slip that is likelier is never shown as a promise, whatever `stable` has been worth so far."""
NO_OUTCOME = "no outcome told yet"
WATCHED = Line("supervised", "lift only while a person watches, and tell the outcome: it teaches")


def doubt(verdict: Verdict) -> str | None:
    """Why `stable` is not yet a promise; None where lifts have shown that it keeps the target."""
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
        return f"too few `stable` lifts are told yet to show the target, {_percent(risk.target)}"
    if risk.slips > risk.lifts * risk.target:
        return "more `stable` lifts slipped than the target so far"
    return None


def rests_on(verdict: Verdict) -> str:
    """What the probability and the verdict rest on, in one line."""
    network, risk = verdict.p_slip_model, verdict.risk
    said = "" if network is None else f"network {_percent(network)}, "
    if risk is None or (risk.lifts == 0 and verdict.outcomes == 0):
        return said + NO_OUTCOME
    said += f"rests on {_number(verdict.outcomes, 'lift')}; "
    slipped = f"of {risk.lifts} `stable` ones {risk.slips} slipped"
    said += slipped if risk.lifts else "no `stable` one told yet"
    return said + ("" if risk.target is None else f", target {_percent(risk.target)}")


def stillness(still_ms: float | None) -> str:
    """For how long a hand has been still; `-` where that is not told."""
    if still_ms is None:
        return "-"
    whole_ms = int(still_ms)
    if still_ms < SURE_MS:
        return f"{whole_ms} ms" + (", may slide" if whole_ms else "")
    return f"{whole_ms} ms" if still_ms < 10_000.0 else f"{whole_ms // 1000} s"


def lift(verdict: Verdict, ended: str | None) -> str:
    """How the lift of a judged grasp ended, in short; a grasp that is to slip has none."""
    if ended is not None:
        return "held" if ended == "stable" else "slipped"
    return "not told" if verdict.verdict is Decision.STABLE or verdict.supervised else "-"


def learning(verdict: Verdict | None, status: Status | None) -> list[Line]:
    """How learning goes, what matters most first."""
    risk = None if verdict is None else verdict.risk
    lifts, learner = (None, None) if status is None else (status.lifts, status.learner)
    found = []
    if lifts is not None:
        found.append(Line("never told", _number(lifts.unreported, "lift")))
    if risk is not None:
        found.append(Line("warm-up left", _number(risk.warm_up_left, "outcome")))
        found.append(Line("still out", _number(risk.outstanding, "lift")))
    if learner is not None:
        found.append(Line("learner", "on" if learner.enabled else "off"))
        found.append(Line("learned from", _number(learner.outcomes, "outcome")))
        found.append(Line("uncertainty", _percent(learner.uncertainty)))
    if risk is not None and risk.target is not None:
        most = "no bound" if risk.bound is None else f"at most {risk.bound:.1f}"
        told_lifts = _number(risk.lifts, "lift")
        found.append(Line("slips of `stable`", f"{risk.slips} of {told_lifts}, {most}"))
    told = {} if learner is None else learner.told
    return found + [Line(f"outcomes {kind.value}", str(count)) for kind, count in told.items()]


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"


def _number(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
