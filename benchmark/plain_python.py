# SPDX-License-Identifier: Apache-2.0
"""Programs as plain Python, as where llvmlite is not installed."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import Any

from sst_ros.dynamics import traced_dynamics
from sst_ros.integration.batch import programs_of
from sst_ros.integration.function_steps import (
    compile_by_stage,
    compile_rows_by_stage,
    compile_stages,
)
from sst_ros.integration.method_steps import steps_of

_CACHED: tuple[Any, ...] = (
    traced_dynamics.recent,
    traced_dynamics.recent_ode,
    steps_of,
    compile_by_stage,
    compile_rows_by_stage,
    compile_stages,
    programs_of,
)
"""What keeps functions that are machine code or not."""


@contextlib.contextmanager
def without_llvmlite() -> Iterator[None]:
    """Run what is made inside of it as plain Python.

    Not for several threads at once.
    """
    modules: dict[str, Any] = sys.modules
    before = {
        name: modules[name] for name in modules if name.split(".")[0] == "llvmlite"
    }
    for name in before:
        del modules[name]
    modules["llvmlite"] = None
    _forget()
    try:
        yield
    finally:
        del modules["llvmlite"]
        modules.update(before)
        _forget()


def _forget() -> None:
    for cached in _CACHED:
        cached.cache_clear()
