"""Mutants: copies of the code with one small mistake each, to see whether the tests notice.

`python -m tests.bench.mutants drivers --number 200` picks 200 at random, runs for each the tests in
`tests/drivers` that execute its line, and lists those that no test notices. `--only contact.py:88`
takes the mutants of a file or a line.

The mistakes: a comparison, an operator, a `not`, `and` or `or`, a number by one; a large number,
and a float downwards, by 20 %, as one nanosecond means nothing. No source is changed: a mutant is a
compiled file in a copy of the tree, which Python and all processes of a test run instead.

mutmut leaves numbers outside functions alone; cosmic-ray changes files in place, one command for
all; neither picks a sample by a seed. So this is a program of our own.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib.util
import json
import marshal
import os
import random
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import coverage
import pytest
from hypothesis import Phase, settings

from tests.bench.mistakes import Mutant, mutants
from tests.conftest import ROOT, data_dir

NUMBER = 200
KILLED_SHARE = 0.9
"""Share of the mutants that the tests must notice."""
LEFT_OUT = ("drivers/twins/",)
"""Beginnings of paths that get no mutants, as they are test equipment."""
TESTS_S = 60.0
"""Total time without a mutant, s, of the tests that are chosen for each mutant."""
SLACK, SLACK_S = 5.0, 10.0
"""A test hangs if it takes longer than `SLACK` times its usual time plus `SLACK_S`."""
RUN_S = 60.0
"""Longest start of pytest on a slow machine, s; a run that takes longer hangs outside of a test."""
WARM = ("can", "msgspec", "numpy", "onnxruntime", "pydantic", "serial", "zmq")
"""Modules imported once, before the processes for the mutants are forked."""
UNCHECKED: Final = (1).to_bytes(4, "little")
"""Flags of a compiled file that is never compared with its source (PEP 552)."""


@dataclass(eq=False)
class Baseline:
    """Results of the tests without a mutant; as a plugin of pytest it collects them."""

    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    """Time of each test, by its node id, s."""
    failed: list[str] = dataclasses.field(default_factory=list)
    tests: dict[str, dict[str, list[str]]] = dataclasses.field(default_factory=dict)
    """Tests that execute a line, by file and by line (as text)."""
    naming: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    """Tests whose file mentions a module by name, by the module's file."""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add up the time of a test's parts, and note its failure."""
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration
        if report.failed:
            self.failed.append(report.nodeid)

    def concerned(self, mutant: Mutant, seconds: float) -> dict[str, float]:
        """Return tests that run a mutant, with times, s: the fastest, until these exceed `seconds`.

        These execute its statement. If none does, as the statement runs on import: all that execute
        any line of its file, and those whose file names its module.
        """
        lines = self.tests.get(mutant.file, {})
        found = {
            test for at in range(mutant.begin, mutant.line + 1) for test in lines.get(str(at), ())
        }
        if not found:
            found.update(self.naming.get(mutant.file, ()), *lines.values())
        chosen: dict[str, float] = {}
        for test in sorted(found.difference(self.failed), key=lambda test: self.seconds[test]):
            chosen[test] = self.seconds[test]
            seconds -= chosen[test]
            if seconds < 0.0:
                break
        return chosen


class Contexts:
    """Plugin of pytest: tells coverage which test runs."""

    def __init__(self, measure: coverage.Coverage) -> None:
        self._measure = measure

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, bool, bool]:
        """Have coverage note the lines that a test and its fixtures execute under its id."""
        self._measure.switch_context(item.nodeid)
        return (yield)


class SameExamples:
    """Plugin of pytest: hypothesis tries the same examples every time, and never shrinks them."""

    def pytest_sessionstart(self) -> None:
        """Load the profile, after that of the conftest and before any test is imported."""
        phases = (Phase.explicit, Phase.generate)
        settings.register_profile("mutants", settings(), derandomize=True, phases=phases)
        settings.load_profile("mutants")


class Chosen:
    """Plugin of pytest: runs the chosen tests, the fastest files first."""

    def __init__(self, seconds: Mapping[str, float], known: Collection[str]) -> None:
        """`seconds`: chosen tests and their usual times. `known`: all tests without a mutant; those
        that a mutant has renamed run too."""
        self._seconds = seconds
        self._known = known

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Keep the chosen tests, limit the time of each, and sort them."""
        items[:] = [
            item for item in items if item.nodeid in self._seconds or item.nodeid not in self._known
        ]
        total: defaultdict[Path, float] = defaultdict(float)
        for item in items:
            usual_s = self._seconds.get(item.nodeid, 0.0)
            total[item.path] += usual_s
            item.add_marker(pytest.mark.timeout(SLACK * usual_s + SLACK_S), append=False)
        items.sort(key=lambda item: total[item.path])


class Workshop:
    """A copy of the tree in which mutants are run."""

    def __init__(self, root: Path, folder: Path, package: str, tests: Sequence[str]) -> None:
        """Copy the tree at `root` into `folder`, empty. `package`, `tests`: paths from `root`."""
        self._folder, self._package, self._tests = folder, package, tests
        self._log = folder / "last-run.log"
        ignored = shutil.ignore_patterns(".*", "__pycache__")
        shutil.copytree(root, folder, symlinks=True, ignore=ignored, dirs_exist_ok=True)
        for module in WARM:
            if importlib.util.find_spec(module) is not None:
                importlib.import_module(module)

    def baseline(self) -> Baseline:
        """Run all tests once without a mutant. Raises `RuntimeError` if pytest cannot."""
        report = self._folder / "baseline.json"
        status = _forked(lambda: self._measure(report), None, self._log)
        if status not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            raise RuntimeError(f"the tests do not run without a mutant:\n{self._log.read_text()}")
        found = Baseline(**json.loads(report.read_text()))
        report.unlink()
        return found

    def notices(self, mutant: Mutant, seconds: Mapping[str, float], known: Collection[str]) -> bool:
        """Return True if with the mutant one of the tests in `seconds` fails or hangs.

        A run that is cut off outside of a test counts as unnoticed, and is reported.
        """
        module = self._folder / mutant.file
        compiled = Path(importlib.util.cache_from_source(str(module)))
        compiled.parent.mkdir(exist_ok=True)
        content = importlib.util.MAGIC_NUMBER + UNCHECKED + bytes(8) + marshal.dumps(mutant.code())
        compiled.write_bytes(content)
        files = sorted({test.partition("::")[0] for test in seconds})
        limit_s = SLACK * sum(seconds.values()) + SLACK_S + RUN_S
        try:
            plugins = [Chosen(seconds, known), SameExamples()]
            status = _forked(lambda: self._pytest([*files, "-x"], plugins), limit_s, self._log)
        finally:
            compiled.unlink()
        if status is None:
            _say(f"cut off after {limit_s:.0f} s, outside of a test: {mutant}")
        return status not in (0, None)

    def _measure(self, report: Path) -> int:
        measure = coverage.Coverage(
            data_file=None, config_file=False, source=[str(self._folder / self._package)]
        )
        found = Baseline()
        with measure.collect():
            status = self._pytest(self._tests, [found, Contexts(measure), SameExamples()])
        data = measure.get_data()
        files = {test.partition("::")[0] for test in found.seconds}
        texts = {file: (self._folder / file).read_text() for file in files}
        for file in data.measured_files():
            lines = data.contexts_by_lineno(file)
            name = str(Path(file).relative_to(self._folder))
            found.tests[name] = {
                str(line): sorted(filter(None, tests)) for line, tests in lines.items()
            }
            module = name.removesuffix(".py").replace("/", ".")
            found.naming[name] = [
                test for test in found.seconds if module in texts[test.partition("::")[0]]
            ]
        report.write_text(json.dumps(dataclasses.asdict(found)))
        return status

    def _pytest(self, arguments: Sequence[str], plugins: Sequence[object]) -> int:
        """Run pytest on the copy, with no module of the original loaded; return its exit code."""
        os.chdir(self._folder)
        sys.path[:1] = places = [str(self._folder / "deploy" / "package"), str(self._folder)]
        os.environ["PYTHONPATH"] = os.pathsep.join(places)
        packages = {"graspd", *(path.name for path in self._folder.iterdir())}
        for name in [name for name in sys.modules if name.partition(".")[0] in packages]:
            del sys.modules[name]
        # hypothesis, its plugin, is imported already.
        ignored = ("-W", "ignore::pytest.PytestAssertRewriteWarning")
        options = ("-q", "-n0", "--tb=no", "-p", "no:cacheprovider", *ignored)
        return int(pytest.main([*arguments, *options], list(plugins)))


def _forked(task: Callable[[], int], limit_s: float | None, log: Path) -> int | None:
    """Run a task in a forked process; return its exit status, None if it took over `limit_s`.

    `log` is overwritten with its output. `limit_s` None: no limit.
    """
    pid = os.fork()
    if pid == 0:
        status = os.EX_SOFTWARE
        try:
            os.setsid()
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(output, 1)
            os.dup2(output, 2)
            status = task()
        except Exception:  # noqa: BLE001 (nothing may continue as if it were the parent)
            traceback.print_exc()
        finally:
            os._exit(status)
    descriptor = os.pidfd_open(pid)
    try:
        ended, _, _ = select.select([descriptor], [], [], limit_s)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)  # and whatever a test has started
        _, status = os.waitpid(pid, 0)
        os.close(descriptor)
    return os.waitstatus_to_exitcode(status) if ended else None


def modules(root: Path, package: str, only: Sequence[str]) -> Iterator[Mutant]:
    """Yield all mutants of a package; with `only`, of files whose path ends so, or `FILE:LINE`."""
    for path in sorted((root / package).rglob("*.py")):
        file = path.relative_to(root).as_posix()
        if file.startswith(LEFT_OUT):
            continue
        for mutant in mutants(path.read_text(), file):
            places = (f"/{file}", f"/{file}:{mutant.line}")
            wanted = not only or any(at.endswith(f"/{end}") for at in places for end in only)
            if wanted:
                yield mutant


def run(root: Path, options: argparse.Namespace) -> tuple[list[Mutant], list[Mutant]]:
    """Run tests on a random sample of mutants; return all of it, and those that no test noticed."""
    found = list(modules(root, options.package, options.only))
    picked = random.Random(options.seed).sample(found, min(options.number, len(found)))
    picked.sort(key=lambda mutant: (mutant.file, mutant.line, mutant.place))
    survivors = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        workshop = Workshop(root, Path(folder), options.package, options.tests)
        began_s = time.monotonic()
        baseline = workshop.baseline()
        _say(
            f"{len(found)} mutants, {len(picked)} of them picked; {len(baseline.seconds)} tests in "
            f"{time.monotonic() - began_s:.0f} s, left out as they fail: {baseline.failed}"
        )
        for number, mutant in enumerate(picked, 1):
            tests = baseline.concerned(mutant, options.timeout)
            if not tests or not workshop.notices(mutant, tests, baseline.seconds):
                survivors.append(mutant)
                _say(f"{number}: {mutant} ({len(tests)} tests)")
    return picked, survivors


def main(arguments: Sequence[str] | None = None) -> int:
    """Pick and run mutants, and print a table; return 1 if too few are noticed."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.mutants",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("package", help="folder of modules, such as daemon/judge or drivers")
    parser.add_argument("--number", type=int, default=NUMBER, help=f"default {NUMBER}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=[], metavar="FILE[:LINE]")
    parser.add_argument("--tests", nargs="+", metavar="PATH", help="default: tests/PACKAGE")
    parser.add_argument(
        "--timeout", type=float, default=TESTS_S, help=f"s of tests per mutant, default {TESTS_S}"
    )
    options = parser.parse_args(arguments)
    options.tests = options.tests or [f"tests/{options.package}"]
    if (folder := data_dir()) is not None:
        os.environ["GRASPD_DATA"] = str(folder)
    began_s = time.monotonic()
    picked, survivors = run(ROOT, options)
    if not picked:
        parser.error("no such file or line")
    total, left = (Counter(mutant.file for mutant in some) for some in (picked, survivors))
    for file, number in sorted(total.items()):
        _say(f"{file}: {number - left[file]} of {number} noticed")
    noticed = len(picked) - len(survivors)
    _say(
        f"{noticed} of {len(picked)} noticed, {noticed / len(picked):.1%}; seed {options.seed}, "
        f"{(time.monotonic() - began_s) / 60.0:.1f} min"
    )
    return 0 if noticed >= KILLED_SHARE * len(picked) else 1


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
