"""Run a command of graspd inside the process of the test, which is faster than a new one."""

from __future__ import annotations

import contextlib
import io
import logging
import resource
from collections.abc import Iterator
from subprocess import CompletedProcess

from graspd.daemon import cli
from graspd.daemon.process.logs import LOGGER


def graspd(*arguments: object) -> CompletedProcess[str]:
    """Run `graspd` with `arguments` in this process; return exit code, output and errors."""
    words = [str(argument) for argument in arguments]
    output, errors = io.StringIO(), io.StringIO()
    with (
        _as_it_was(),
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(errors),
    ):
        try:
            code = cli.main(words)
        except SystemExit as left:
            code = left.code if isinstance(left.code, int) else 1
    return CompletedProcess(words, code, output.getvalue(), errors.getvalue())


def output(*arguments: object) -> str:
    """Run a command that succeeds; return what it writes to stdout."""
    done = graspd(*arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def refused(*arguments: object) -> str:
    """Run a command that is refused with exit code 2; return what it writes to stderr."""
    done = graspd(*arguments)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr


@contextlib.contextmanager
def _as_it_was() -> Iterator[None]:
    """Let the block set up its log and limits as in a new process; restore both after it."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    root = logging.getLogger()
    handlers, level = root.handlers, logging.getLogger(LOGGER).level
    root.handlers = []
    try:
        yield
    finally:
        root.handlers = handlers
        logging.getLogger(LOGGER).setLevel(level)
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
