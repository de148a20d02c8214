"""`graspd report stability`: what it prints of the cases that it runs, and what it says without."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("onnx", reason="the report needs onnx, of the extra `train`")
pytest.importorskip("torch", reason="the report needs torch, of the extra `train`")

from graspd.daemon.commands.report import add_arguments
from graspd.daemon.measure import stability
from tests.stability.rows import NUMBERS, row_of, text

CASE = {
    **dict.fromkeys(NUMBERS, float("nan")),
    **{"model": "mlp", "case": "made up", "reasons": {"flat": 1}},
    **{"verdicts": {"unknown": 1, "slip": 1}, "problems": ["p_slip nan, bound 1e-04"]},
}


def run(*arguments: str) -> tuple[int, str]:
    """Exit code and standard output of the report."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    with contextlib.redirect_stdout(io.StringIO()) as output:
        code = stability.run(parser.parse_args(["stability", *arguments]))
    return code, output.getvalue()


@pytest.mark.timeout(240)
def test_the_cases_of_a_model_become_two_tables() -> None:
    code, said = run("small-session-mf", "--quick")
    assert code == 0
    assert "\n0 of 4" in said
    assert "break a bound, 3e+03 outcomes" in said
    for case in ("all 0", "demo table", "random 12-bit counts", "next to the threshold"):
        assert f"| small-session-mf | {case} |" in said
    assert "| learner, 3e+03 outcomes, all of these in turns |" in said


def test_a_broken_bound_and_a_case_that_ends_early_are_said() -> None:
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
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run("no-such-model")[0] == 2
    assert run("mlp", "--data", str(tmp_path))[0] == 2
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert run("mlp")[0] == 2
    monkeypatch.setattr(stability, "CHECKOUT", tmp_path)
    assert run("mlp")[0] == 2
    model, table, package, tests = capsys.readouterr().err.splitlines()
    assert "no-such-model" in model
    assert "palm_down.csv" in table
    assert "needs the package 'onnx'" in package
    assert "run it in a checkout" in tests
