"""The final verdict: every combination against the rule as the documentation states it."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest

from graspd.daemon.judge.decision import HELD, HoldDown, Limits, decide
from graspd.daemon.judge.reasons import Decision, Moment, Reason, parts_to_act_on, to_act_on

LIMIT_NS = 100
THRESHOLD = 0.4
CONFIDENCE = 0.75
LIMITS = Limits(max_age_ns=LIMIT_NS, slip_threshold=THRESHOLD, min_confidence=CONFIDENCE)
ANY_CONFIDENCE = Limits(max_age_ns=LIMIT_NS, slip_threshold=THRESHOLD, min_confidence=0.0)

# Probability, and what it is worth by the rule: slip from 0.4 on; as sure as 0.75.
PROBABILITIES: list[tuple[float | None, str]] = [
    (0.0, "stable"),
    (0.2, "stable"),
    (0.25, "stable"),
    (0.250001, "unsure stable"),
    (0.399999, "unsure stable"),
    (0.4, "unsure slip"),
    (0.6, "unsure slip"),
    (0.749999, "unsure slip"),
    (0.75, "slip"),
    (1.0, "slip"),
    (None, "nothing"),
    (math.nan, "nothing"),
    (math.inf, "nothing"),
    (-math.inf, "nothing"),
    (-1e-9, "nothing"),
    (1.0000001, "nothing"),
]
AGES = [(0, True), (1, True), (LIMIT_NS, True), (LIMIT_NS + 1, False), (-1, False), (10**12, False)]
HEALTH: list[tuple[Reason, ...]] = [(), (Reason.PARITY,), (Reason.FLAT, Reason.SATURATED)]
GATE: list[tuple[Reason, ...]] = [(), (Reason.NO_CONTACT,), (Reason.NOT_TARED, Reason.NO_CONTACT)]
AGAINST_STABLE = (None, Reason.UNPROVEN)
DOUBTS = tuple(Decision)
CASES = list(
    itertools.product(
        PROBABILITIES, AGES, HEALTH, GATE, (False, True), (False, True), AGAINST_STABLE, DOUBTS
    )
)


def expected(
    worth: str,
    fresh: bool,
    health: tuple[Reason, ...],
    gate: tuple[Reason, ...],
    well: bool,
    against_stable: Reason | None,
    doubt: Decision,
) -> tuple[str, set[Reason]]:
    """Return decision and reasons by the rule: unless everything is well, it is `unknown`.

    `worth`: what the probability says, as in `PROBABILITIES`. `fresh`: the reading is not too old.
    `health`, `gate`: reasons of each. `well`: the grasp has settled. `against_stable`: reason of
    the risk that forbids `stable`; None: none. `doubt`: decision of a `HoldDown` on the grasp.
    """
    against = set(health)
    if worth.endswith("stable") and doubt is Decision.UNKNOWN and against_stable is None:
        against |= {Reason.LOW_CONFIDENCE}
    if worth.endswith("stable") and against_stable is not None:
        against |= {against_stable}
    if not well:
        against |= set(gate) or {Reason.MOVING}
    if not fresh:
        against |= {Reason.STALE}
    if worth.startswith("unsure"):
        against |= {Reason.LOW_CONFIDENCE}
    if worth == "nothing" and not against:
        against = {Reason.MODEL_FAILED}
    return ("unknown" if against else worth), against


@pytest.mark.parametrize("limits", [LIMITS, ANY_CONFIDENCE])
def test_every_combination_of_inputs_gets_the_verdict_of_the_rule(limits: Limits) -> None:
    assert len(CASES) == 16 * 6 * 3 * 3 * 2 * 2 * 2 * 3
    for case_of in CASES:
        (p_slip, worth), (age_ns, fresh), health, gate, contact, settled, withheld, doubt = case_of
        if doubt is Decision.SLIP and worth.endswith("stable"):
            worth = "unsure slip"  # the more, the likelier it is to hold
        worth = worth.removeprefix("unsure ") if limits is ANY_CONFIDENCE else worth
        moment = Moment(1, in_contact=contact, settled=settled, reasons=gate)
        given: dict[str, Any] = {"withheld": withheld, "held": HoldDown(1, 1, doubt)}
        if doubt is Decision.STABLE and withheld is None:
            given = {}  # the defaults
        well = contact and settled
        wanted = expected(worth, fresh, health, gate, well, withheld, doubt)
        found, reasons = decide(p_slip, health, moment, age_ns, limits, **given)
        assert (found, set(reasons)) == wanted, case_of
        assert len(reasons) == len(set(reasons))


@pytest.mark.parametrize("where", ["health", "gate"])
def test_any_reason_makes_the_verdict_unknown(where: str) -> None:
    for reason in Reason:
        health, gate = ((reason,), ()) if where == "health" else ((), (reason,))
        moment = Moment(1, in_contact=where == "health", reasons=gate)
        assert decide(0.0, health, moment, 0, LIMITS) == (Decision.UNKNOWN, (reason,))


def test_defaults_are_slip_from_half_and_stale_after_100_ms() -> None:
    for p_slip, age_ns, wanted in (
        (0.499999, 100_000_000, (Decision.STABLE, ())),
        (0.5, 100_000_000, (Decision.SLIP, ())),
        (0.1, 100_000_001, (Decision.UNKNOWN, (Reason.STALE,))),
    ):
        assert decide(p_slip, (), HELD, age_ns, Limits()) == wanted


@pytest.mark.parametrize(
    ("reasons", "shown"),
    [
        ("low-confidence settling not-kept joints-late", "joints-late not-kept settling low-conf"),
        ("moving parity no-contact", "parity"),
    ],
)
def test_reasons_to_act_on_come_first(reasons: str, shown: str) -> None:
    found = to_act_on(Reason(each) for each in reasons.split())
    assert " ".join(found).startswith(shown)
    assert len(found) == len(shown.split())


FF = {f"ff_biotac_{number}": "saturated" for number in range(1, 25)}


@pytest.mark.parametrize(
    ("health", "shown"),
    [
        ({"hand": "settling", "ff_3": "parity"}, {"parity": ["ff_3"], "settling": ["hand"]}),
        ({"link": "stale", "hand": "settling", "joints": "joints-late"}, {"stale": ["link"]}),
        ({**FF, "ff": "moving", "mf": "moving"}, {"saturated": ["ff"], "moving": ["mf"]}),
        ({**FF, "ff_biotac_2": "parity"}, {"parity": ["ff"], "saturated": ["ff"]}),
    ],
)  # fmt: skip
def test_parts_to_act_on_are_grouped_by_reason_without_consequences(
    health: dict[str, str], shown: dict[str, list[str]]
) -> None:
    found = parts_to_act_on({part: Reason(reason) for part, reason in health.items()})
    assert list(found.items()) == list(shown.items())
