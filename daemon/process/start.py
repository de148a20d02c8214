"""What is settled before any library is imported."""

from __future__ import annotations

import gc
import os
import sys
from types import ModuleType


def prepare() -> None:
    """Let libraries take no more than a daemon needs; before the first of them is imported.

    Whoever calls it turns the garbage collector on again.
    """
    # Modules leave next to no garbage: to look for it takes a tenth of a start, and to look through
    # what is loaded, ever again, 30 ms in which no reading is judged.
    gc.disable()
    # Matrices are small here. numpy's threads for large ones, one for each further processor, would
    # spin through the start; and with memory locked each of them takes its whole stack.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # pydantic looks through all that is installed for plugins, which takes a tenth of a start and
    # 3 MiB; and what others have installed has no business in a daemon.
    plugins = ModuleType("pydantic.plugin._loader")
    vars(plugins)["get_plugins"] = tuple
    sys.modules.setdefault(plugins.__name__, plugins)
