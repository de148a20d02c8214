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

BROKEN_TESTS = """
import json
import pytest

CASE = dict.fromkeys(("readings", "compared", "flips"), 2)
CASE |= dict.fromkeys(("input_error", "network_error", "chain_error", "mean_error"), float("nan"))
CASE |= {"model": "mlp", "case": "made up", "reasons": {"flat": 1}}
CASE |= {"verdicts": {"unknown": 1, "slip": 1}, "problems": ["p_slip nan, bound 1e-04"]}

def test_a_case(record_property):
    record_property("row", json.dumps(CASE))
    assert not CASE["problems"]

def test_a_step(record_property):
    record_property("row", json.dumps({"step": "one", "expected": "1", "found": "1"}))

def test_that_takes_its_time(pytestconfig, record_property):
    record_property("row", json.dumps({"step": "two", "expected": "2", "found": "2"}))
    assert pytestconfig.getoption("timeout") == 0

def test_that_ends_early():
    raise OSError("nothing noted")
"""


def run(*arguments: str) -> tuple[int, str]:
    """Exit code and standard output of the report."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    with contextlib.redirect_stdout(io.StringIO()) as output:
        code = stability.run(parser.parse_args(["stability", *arguments]))
    return code, output.getvalue()


@pytest.mark.timeout(240)
def test_the_cases_of_a_model_become_two_tables() -> None:
    code, text = run("small-session-mf", "--quick")
    assert code == 0
    assert text.startswith("**made with --quick")
    assert "\n0 of 4" in text
    for case in ("all 0", "demo table", "random 12-bit counts", "next to the threshold"):
        assert f"| small-session-mf | {case} |" in text
    assert "| learner, 1e+04 outcomes, all of these in turns |" in text


def test_a_broken_bound_makes_the_exit_code_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cases = tmp_path / stability.CASES
    cases.mkdir(parents=True)
    (cases / "test_made_up.py").write_text(BROKEN_TESTS)
    options = ("--model", "--data", "--outcomes")
    added = "".join(f"    parser.addoption('{name}')\n" for name in options)
    (tmp_path / "conftest.py").write_text(f"def pytest_addoption(parser):\n{added}")
    monkeypatch.setattr(stability, "CHECKOUT", tmp_path)
    code, text = run()
    assert code == 1
    assert "| unknown 1, slip 1 | flat 1 | BROKEN p_slip nan, bound 1e-04 |" in text
    assert "2 of 4 rows break a bound" in text
    assert "OSError: nothing noted | BROKEN |" in text
    code, text = run("--json")
    assert code == 1
    assert json.loads(text)["rows"][0]["input_error"] is None  # JSON has no NaN


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


def test_cases_that_cannot_be_run_are_no_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / stability.CASES).mkdir(parents=True)
    monkeypatch.setattr(stability, "CHECKOUT", tmp_path)
    code, text = run()
    assert (code, text) == (2, "")
    assert "unrecognized arguments" in capsys.readouterr().err
