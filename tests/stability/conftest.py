"""What the cases of stability share: the models that are asked for, and a row of the report."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

from graspd.models import zoo
from tests.stability.rows import Rows

DEFAULT = "small-session"


@pytest.fixture
def note(record_property: Callable[[str, object], None]) -> Callable[..., None]:
    """Record a row of `graspd report stability`."""

    def record(**cells: object) -> None:
        record_property("row", json.dumps(cells))

    return record


def pytest_configure(config: pytest.Config) -> None:
    """Print the rows if that is asked for."""
    if (form := config.getoption("rows")) is not None:
        outcomes = config.getoption("outcomes")
        config.pluginmanager.register(Rows(outcomes, as_json=form == "json"))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run the cases of a model on each that is asked for, or on all of the zoo."""
    names = metafunc.config.getoption("model") or zoo.names()
    if "model" in metafunc.fixturenames:
        metafunc.parametrize("model", names, scope="module")
    if "session_model" in metafunc.fixturenames:
        metafunc.parametrize("session_model", [name for name in names if "session" in name])
    if "recorded_model" in metafunc.fixturenames:
        # Five thousand grasps of each model take minutes.
        if not metafunc.config.getoption("data"):
            names = [name for name in names if name == DEFAULT]
        metafunc.parametrize("recorded_model", names)
