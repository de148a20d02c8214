"""Ask to lift the grasps of deploy/clients/loop.toml, and report the outcome that you type.

`graspd run deploy/clients/loop.toml`, then `python try_outcomes.py` with any Python that has pyzmq.
"""

from __future__ import annotations

import sys
import time

from graspd_client import Client, Outcome

VERDICTS, QUESTIONS = "ipc:///tmp/graspd-loop.ipc", "ipc:///tmp/graspd-loop.ask.ipc"


def asked() -> Outcome:
    """Return the outcome that a person types: y or h for held, n or s for slipped.

    `NOT_LIFTED` at the end of the input.
    """
    while True:
        sys.stdout.write("Did it hold? y/n ")
        sys.stdout.flush()
        line = sys.stdin.readline()
        word = line.strip().lower()[:1]
        if not line:
            return Outcome.NOT_LIFTED
        if word in ("y", "h"):
            return Outcome.HELD
        if word in ("n", "s"):
            return Outcome.SLIPPED


def main() -> None:
    """Ask and report until the input ends."""
    with Client(VERDICTS, ask_endpoint=QUESTIONS) as client:
        while True:
            answer = client.may_i_lift(10.0, supervised=True)
            verdict = answer.verdict
            if not answer:
                why = " ".join([verdict.decision, *verdict.reasons])
                sys.stdout.write(f"do not lift: {why}\n")
                sys.stdout.flush()
                time.sleep(1.0)  # the same grasp would be refused again
                continue
            p_slip = "not known" if verdict.p_slip is None else f"{verdict.p_slip:.2f}"
            said = f"{verdict.decision}, p_slip {p_slip} {verdict.risk}"
            sys.stdout.write(f"grasp {verdict.grasp}: {said}\n")
            sys.stdout.write(f"{verdict.outcomes} outcomes told. ")
            outcome = asked()
            told = client.tell(verdict, outcome, "mug")
            if outcome is Outcome.NOT_LIFTED:
                return
            sys.stdout.write("told\n" if told else f"{told.why}\n")


if __name__ == "__main__":
    main()
