# SPDX-License-Identifier: Apache-2.0
"""Source of a scene's functions and the loops around them, as an interpreted or compiled module.

The text is the same for the interpreter and for numba, so both take the same operations in the
same order. Under numba it is written to a cache folder whose file names are digests of the text
and of all versions; a folder that cannot be written means compiling anew in this process.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import os
import platform
import sys
import tempfile
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from sst_ros.dynamics.expression import Program
from sst_ros.integration import step_loops
from sst_ros.integration.cache_folder import (
    cache_folder,
    drop_damaged,
    is_safe_file,
    warn_if_not_kept,
)
from sst_ros.integration.methods import Rosenbrock, Tableau
from sst_ros.integration.runge_kutta_source import explicit_step

_EXPLICIT = (
    step_loops.size_of,
    step_loops.normalise,
    step_loops.step_pair,
    step_loops.step_fixed,
    step_loops.all_far,
    step_loops.step_many,
    step_loops.step_sequence,
)
_IMPLICIT = (
    step_loops.factorise,
    step_loops.substitute,
    step_loops.attempt_linearly_implicit,
    *_EXPLICIT,
)

_PLAIN = """\
from math import atan2, cos, exp, inf as INFINITE, nan, sin, sqrt, tanh

def vector(n):
    return [0.0] * n

def square(n):
    return [[0.0] * n for _ in range(n)]

def rows(m, n):
    return [[0.0] * n for _ in range(m)]
"""

_NUMBA = """\
from math import atan2, cos, exp, inf as INFINITE, nan, sin, sqrt, tanh
import numba
import numpy as np

jit = numba.njit(cache={cache}, error_model="numpy", nogil={nogil}{more})

@jit
def vector(n):
    return np.zeros(n)

@jit
def square(n):
    return np.zeros((n, n))

@jit
def rows(m, n):
    return np.zeros((m, n))
"""

_FREE_ROUNDING = ', fastmath={"arcp", "contract"}'


def numba_version() -> str | None:
    """Version of numba, None where it cannot be imported or SST_ROS_NUMBA=0 switches it off."""
    if os.environ.get("SST_ROS_NUMBA") == "0":
        return None
    try:
        import numba
    except ImportError:
        return None
    return str(numba.__version__)


def source(
    program: Program,
    jacobian: Program | None,
    joints: Program,
    method: Tableau | Rosenbrock,
    size: int,
    drive: int,
) -> list[str]:
    """Functions of the module, one text each, in the order in which they need each other.

    Args:
        program: derivative of the state; inputs t, state, drive.
        jacobian: derivative, and its derivatives by t and by each state; for implicit methods.
        joints: nine angles and nine rates; inputs are the first seven numbers of the state.
        method: the integrator.
        size: numbers in the state.
        drive: numbers in the drive.

    """
    y, d = [f"y[{i}]" for i in range(size)], [f"d[{i}]" for i in range(drive)]
    texts = [program.source("rhs"), joints.source("angles_and_rates"), _joints_of()]
    if isinstance(method, Tableau):
        new = [f"new_y[{i}]" for i in range(size)] + [f"error[{i}]" for i in range(size)]
        texts += [explicit_step(method, size, drive), _attempt(y, d, new)]
        return texts + [inspect.getsource(function) for function in _EXPLICIT]
    assert jacobian is not None
    slope = [f"slope[{i}]" for i in range(size)]
    outputs = [*slope, *(f"by_time[{i}]" for i in range(size))]
    outputs += [f"matrix[{i}][{j}]" for j in range(size) for i in range(size)]
    inputs = ", ".join(["t", *y, *d])
    texts += [
        jacobian.source("jacobian"),
        f"def linearise(t, y, d, slope, by_time, matrix):\n"
        f"    ({', '.join(outputs)},) = jacobian({inputs})\n",
        f"def evaluate(t, y, d, slope):\n    ({', '.join(slope)},) = rhs({inputs})\n",
    ]
    functions = [inspect.getsource(function) for function in _IMPLICIT]
    return texts + [text.replace("attempt_linearly_implicit", "attempt") for text in functions]


def load(
    texts: list[str],
    constants: dict[str, Any],
    *,
    numba: bool,
    nogil: bool = False,
    rounding: bool = True,
) -> ModuleType:
    """Turn function texts into a module, for the interpreter or compiled by numba.

    Without `rounding` as written, the compiler may multiply and add in one, and multiply by one
    reciprocal instead of dividing by the same number several times.
    """
    if not numba:
        named = "".join(f"{name} = {value!r}\n" for name, value in constants.items())
        return _executed("\n".join([_PLAIN, named, *texts]), "sst_ros_plain")
    more = "" if rounding else _FREE_ROUNDING
    path = _cached_file(_for_numba(texts, constants, nogil=nogil, more=more))
    if path is None:
        head = _NUMBA.format(cache=False, nogil=nogil, more=more)
        return _executed(head + _body(texts, constants), "sst_ros_compiled")
    return _imported(path)


def _joints_of() -> str:
    outputs = ", ".join(f"joints[{i}]" for i in range(18))
    inputs = ", ".join(f"y[{i}]" for i in range(7))
    return f"def joints_of(y, joints):\n    ({outputs},) = angles_and_rates({inputs})\n"


def _attempt(y: list[str], d: list[str], new: list[str]) -> str:
    call = f"step({', '.join(['t', 'h', *y, *d])})"
    return f"def attempt(t, h, y, near, d, new_y, error):\n    ({', '.join(new)},) = {call}\n"


def _imported(path: Path) -> ModuleType:
    known = sys.modules.get(path.stem)
    if known is not None and known.__file__ == str(path):
        return known
    drop_damaged(path)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # numba finds the module again when it loads from its cache.
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    for function in vars(module).values():
        warn_if_not_kept(function)
    return module


def _executed(text: str, name: str) -> ModuleType:
    module = ModuleType(name)
    exec(_code(text, name), module.__dict__)
    return module


@lru_cache(maxsize=64)
def _code(text: str, name: str) -> CodeType:
    return compile(text, f"<{name}>", "exec")


def has_code(
    texts: list[str],
    constants: dict[str, Any],
    functions: Sequence[str],
    *,
    rounding: bool = True,
) -> bool:
    """Return whether machine code of these functions of the module is there to be loaded."""
    more = "" if rounding else _FREE_ROUNDING
    try:
        path = _path_of(_for_numba(texts, constants, more=more))
    except OSError:
        return False
    cached = path.parent / "__pycache__"
    return all(any(cached.glob(f"{path.stem}.{name}-*.nbi")) for name in functions)


def store(files: Mapping[str, bytes]) -> None:
    """Write files of compiled code, by their names in the cache folder, where they are missing."""
    folder = cache_folder()
    (folder / "__pycache__").mkdir(exist_ok=True, mode=0o700)
    for name, data in files.items():
        path = folder / name
        if path.exists():
            continue
        with tempfile.NamedTemporaryFile("wb", dir=path.parent, delete=False) as file:
            file.write(data)
        os.utime(file.name, (0, 0))  # the stamp of `_cached_file`
        Path(file.name).replace(path)


def _for_numba(
    texts: list[str], constants: dict[str, Any], *, nogil: bool = False, more: str = ""
) -> str:
    return _NUMBA.format(cache=True, nogil=nogil, more=more) + _body(texts, constants)


def _body(texts: list[str], constants: dict[str, Any]) -> str:
    named = "".join(f"{name} = {value!r}\n" for name, value in constants.items())
    return "\n".join([named, *(f"@jit\n{text}" for text in texts)])


def _path_of(text: str) -> Path:
    import numpy

    versions = (sys.version, numba_version(), numpy.__version__, platform.machine())
    digest = hashlib.sha256("\n".join([text, *map(str, versions)]).encode()).hexdigest()[:24]
    return cache_folder() / f"sst_{digest}.py"


def _cached_file(text: str) -> Path | None:
    """File that holds `text`; None where no folder for it can be written."""
    try:
        path = _path_of(text)
        if not path.exists() or not is_safe_file(path) or path.read_text(encoding="utf-8") != text:
            # Two processes may write at once: each its own file, then one atomic rename.
            with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False) as file:
                file.write(text)
            # numba's stamp is this time: the same for all, as the text is.
            os.utime(file.name, (0, 0))
            Path(file.name).replace(path)
        with tempfile.TemporaryFile(dir=path.parent):
            return path
    except OSError:
        return None
