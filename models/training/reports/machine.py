"""Description of the computer on which a report was made."""

from __future__ import annotations

import platform
from importlib.metadata import version
from pathlib import Path

import numpy as np


def machine() -> dict[str, str]:
    """Return processor, BLAS and versions of this computer, by their names in a report."""
    return {
        "processor": _processor(),
        "BLAS": _blas(),
        "python": platform.python_version(),
        **{package: version(package) for package in ("numpy", "onnxruntime")},
    }


def described(of: dict[str, str]) -> str:
    """Return a machine as one line."""
    return ", ".join(f"{name} {value}" for name, value in of.items())


def _processor() -> str:
    """Return the name of the processor, or its architecture where the kernel does not tell."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def _blas() -> str:
    """Return numpy's linear algebra, and the processor that its kernels are for, if known."""
    built = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    try:
        from threadpoolctl import threadpool_info  # from the extra `train`
    except ModuleNotFoundError:
        kernels = []
    else:
        kernels = [each.get("architecture") for each in threadpool_info()]
    return " ".join([built["name"], built["version"], *filter(None, kernels[:1])])
