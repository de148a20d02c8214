"""`graspd report stability`: what it prints of the cases that it runs, and what it says without."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("onnx", reason="needs the extra `train`")
pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.models.training.reports import stability
from tests.kit.inside import graspd
from tests.stability.rows import NUMBERS, row_of, text

CASE = {
    **dict.fromkeys(NUMBERS, float("nan")),
    **{"model": "mlp", "case": "made up", "reasons": {"flat": 1}},
    **{"verdicts": {"unknown": 1, "slip": 1}, "problems": ["p_slip nan, bound 1e-04"]},
}


@pytest.mark.timeout(240)
def test_the_cases_of_a_model_become_two_tables() -> None:
    made = graspd("report", "stability", "small-session-mf", "--quick")
    assert made.returncode == 0
    said = made.stdout
    assert "\n0 of 4" in said
    assert "break a bound, 3e+03 outcomes" in said
    for case in ("all 0", "demo table", "random 12-bit counts", "next to the threshold"):
        assert f"| small-session-mf | {case} |" in said
    assert "| learner, 3e+03 outcomes, all of these in turns |" in said


def test_broken_bounds_and_cases_that_end_early_are_reported() -> None:
    step = json.dumps({"step": "one", "expected": "1", "found": "1"})
    rows = [
        row_of(json.dumps(CASE), "test_a_case", "assert not problems"),
        row_of(step, "test_a_step", None),
        row_of(None, "test_that_ends_early", "OSError: nothing noted\nand more"),
    ]
    assert row_of(None, "test_that_notes_nothing", None) is None
    told = [row for row in rows if row is not None]
    lines = text(told, 10_000, as_json=False)
    assert "| unknown 1, slip 1 | flat 1 | BROKEN p_slip nan, bound 1e-04 |" in lines
    assert "2 of 3 rows break a bound" in lines
    assert "OSError: nothing noted | BROKEN |" in lines
    assert json.loads(text(told, 10_000, as_json=True))["rows"][0]["input_error"] is None


def test_what_is_missing_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*arguments: object) -> str:
        result = graspd("report", "stability", *arguments)
        assert (result.returncode, result.stdout) == (2, "")
        (line,) = result.stderr.splitlines()
        return line

    assert "no-such-model" in refused("no-such-model")
    assert "palm_down.csv" in refused("mlp", "--data", tmp_path)
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert "needs the package 'onnx'" in refused("mlp")
    monkeypatch.setattr(stability, "CHECKOUT", tmp_path)
    assert "run it in a checkout" in refused("mlp")
