"""On what a value was computed: cores, processor and versions, which decide its last bits."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from functools import cache

_PACKAGES = ("voxscene", "jax", "jaxlib", "numpy", "scipy")
"""Whose versions change the bits of a result."""


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def versions() -> dict[str, str]:
    """Of Python and of the packages that compute."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def machine() -> dict[str, str | int | dict[str, str]]:
    """Cores, processor and versions, as plain values."""
    return {"cores": usable_cores(), "processor": _processor(), "versions": versions()}


@cache
def _processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.processor() or platform.machine()
