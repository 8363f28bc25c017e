# SPDX-License-Identifier: Apache-2.0
"""Functions, given as text, as an interpreted or compiled module.

The text is the same for the interpreter and for numba, so both take the same operations in the
same order. Under numba it is written to a cache folder whose file names are digests of the text
and of all versions; a folder that cannot be written means compiling anew in this process. It is for
the user alone (mode 700): numba unpickles what is in it.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import importlib.util
import os
import platform
import shutil
import stat
import sys
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, TypeAlias

from sst_ros.host.output import replace_file

Known: TypeAlias = dict[str, Any]  # constants by their names

_PLAIN = """\
from math import atan2, cos, exp, inf as INFINITE, nan, sin, sqrt, tanh

def vector(n):
    return [0.0] * n

def rows(m, n):
    return [[0.0] * n for _ in range(m)]

def copy(values, place):
    place[:] = values
"""

_NUMBA = """\
from math import atan2, cos, exp, inf as INFINITE, nan, sin, sqrt, tanh
import numba
import numpy as np
from sst_ros.host.straight_line import straight_line

options = dict(cache={cache}, error_model="numpy", nogil={more}, no_cfunc_wrapper=True)
jit = numba.njit(**options)
jit_inner = numba.njit(**options, no_cpython_wrapper=True)
jit_inline = numba.njit(**options, no_cpython_wrapper=True, inline="always")

@jit_inner
def vector(n):
    return np.zeros(n)

@jit_inner
def rows(m, n):
    return np.zeros((m, n))

@jit_inner
def copy(values, place):  # a slice would take seconds to compile
    for i in range(len(values)):
        place[i] = values[i]
"""

# Compiled functions alone call these. What Python would need to call them - which without it is a
# segmentation fault - takes a fifth of the time to compile.
_INNER = "normalise all_far step_factor next_length linearise factorise substitute"

# A call hands on each array as seven words on the stack and counts its readers by two atomic
# operations: a step by calls takes 5 to 20 % longer. numba puts these where they are called, which
# is one place in what a run calls, before it compiles.
_INLINE = ("attempt_linearly_implicit", "step_pair")

_STRAIGHT = ("rhs", "angles_and_rates", "joints_of", "evaluate", "attempt", "differentiate")
"""Sequences of assignments of floats, which need no numba to find types."""

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


@dataclass(frozen=True)
class SharedFunctions:
    """Functions that several modules call, one text each, and their constants."""

    texts: tuple[str, ...]
    constants: Known

    @cached_property
    def text(self) -> str:
        """Text of their module for numba."""
        return _for_numba([*self.texts], self.constants, ALONE)

    @cached_property
    def name(self) -> str:
        """Name of that module."""
        return _name_of(self.text)


ALONE = SharedFunctions((), {})  # what a module has that calls no others


def load(
    texts: list[str],
    constants: Known,
    *,
    numba: bool,
    nogil: bool = False,
    rounding: bool = True,
    base: SharedFunctions = ALONE,
) -> ModuleType:
    """Turn function texts into a module, for the interpreter or compiled by numba.

    They may call the functions of `base`, which are compiled once for all modules that have them.

    Without `rounding` as written, the compiler may multiply and add in one, and multiply by one
    reciprocal instead of dividing by the same number several times.
    """
    if not numba:
        everything = [_PLAIN, _named(base.constants | constants), *base.texts, *texts]
        return _executed("\n".join(everything), "sst_ros_plain")
    more = str(nogil) + _FREE_ROUNDING * (not rounding)
    text = _for_numba(texts, constants, base, more)
    if not base.texts or import_text(base.name, base.text) is not None:
        module = import_text(_name_of(text), text)
        if module is not None:
            return module
    everything, known = [*base.texts, *texts], base.constants | constants
    return _executed(_for_numba(everything, known, ALONE, more, False), "sst_ros_compiled")


def _executed(text: str, name: str) -> ModuleType:
    module = ModuleType(name)
    exec(_code(text, name), module.__dict__)
    return module


@lru_cache(maxsize=64)
def _code(text: str, name: str) -> CodeType:
    return compile(text, f"<{name}>", "exec")


def has_code(
    texts: list[str], constants: Known, functions: Sequence[str], base: SharedFunctions = ALONE
) -> bool:
    """Return whether machine code of these functions of the module is there to be loaded."""
    module = _name_of(_for_numba(texts, constants, base))
    try:
        cached = cache_folder() / "__pycache__"
    except OSError:
        return False
    return all(any(cached.glob(f"{module}.{name}-*.nbi")) for name in functions)


def _for_numba(
    texts: list[str], known: Known, base: SharedFunctions, more: str = "False", cache: bool = True
) -> str:
    # A tuple would be read by a jump to one of its numbers.
    tables = {name: value for name, value in known.items() if isinstance(value, tuple)}
    head = _NUMBA.format(cache=cache, more=more) + _named(known)
    head += "".join(f"{name} = np.array({name})\n" for name in tables)
    if base.texts:
        head += f"from {base.name} import {', '.join(map(_function_name, base.texts))}\n"
    return "\n".join([head, *map(_definition, texts)])


def _definition(text: str) -> str:
    name = _function_name(text)
    if name in _STRAIGHT:
        return f'{name} = straight_line("""\n{text}""", globals())\n'
    if name in _INLINE:
        return f"@jit_inline\n{text}"
    return f"@{'jit_inner' if name in _INNER.split() else 'jit'}\n{text}"


def _function_name(text: str) -> str:
    return text.removeprefix("def ").split("(")[0]


def _named(constants: Known) -> str:
    return "".join(f"{name} = {value!r}\n" for name, value in constants.items())


def _name_of(text: str) -> str:
    """Name of the module with a text: a digest of it and of what its machine code depends on."""
    import numpy

    versions = (sys.version, numba_version(), numpy.__version__, platform.machine())
    maker = Path(__file__).with_name("straight_line.py").read_text()
    digest = hashlib.sha256("\n".join([text, maker, *map(str, versions)]).encode()).hexdigest()[:24]
    return f"sst_{digest}"


def cache_folder() -> Path:
    """Return the folder of compiled code, made if it was not there; an OSError if it cannot be.

    It is SST_ROS_CACHE, or sst_ros in the user's cache folder. Where that is another user's, or
    open to others, it is a private temporary folder, and a warning is given.
    """
    folder = configured_folder()
    if folder is None:
        return _private_folder("there is no home folder")
    for one in (*reversed(folder.parents), folder):  # `parents=True` leaves their mode to the umask
        one.mkdir(mode=0o700, exist_ok=True)
    folder = folder.resolve()  # a link that is turned later leads nowhere else
    status = folder.stat()
    if status.st_uid != os.geteuid():
        return _private_folder(f"{folder} belongs to another user (uid {status.st_uid})")
    if (mode := stat.S_IMODE(status.st_mode)) & 0o077:
        return _private_folder(f"{folder} has mode {mode:o} and must have 700")
    return folder


def configured_folder() -> Path | None:
    """Return the folder that the environment names, None where there is no home folder."""
    if named := os.environ.get("SST_ROS_CACHE"):
        return Path(named).absolute()
    if named := os.environ.get("XDG_CACHE_HOME"):
        return Path(named).absolute() / "sst_ros"
    try:
        return Path.home() / ".cache" / "sst_ros"
    except RuntimeError:
        return None


def import_text(name: str, text: str) -> ModuleType | None:
    """Import a module of the cache folder, written if it is not there; None if it cannot be."""
    try:
        path, data = cache_folder() / f"{name}.py", text.encode()
        # A folder that was open to others once may have files of theirs.
        for file in (path, *(path.parent / "__pycache__").glob(f"{name}.*.nb[ic]")):
            with contextlib.suppress(FileNotFoundError):
                if file.lstat().st_uid != os.geteuid():
                    file.unlink()
        if not path.exists() or path.read_bytes() != data:
            with replace_file(path) as own:
                own.write_bytes(data)
                # numba's stamp is this time: the same for all, as the text is.
                os.utime(own, (0, 0))
        with tempfile.TemporaryFile(dir=path.parent):
            pass  # numba can write there, too
    except OSError:
        return None
    known = sys.modules.get(name)
    if known is not None and known.__file__ == str(path):
        return known
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # numba finds the module again when it loads from its cache.
    sys.modules[name] = module
    spec.loader.exec_module(module)
    for function in vars(module).values():
        _bear_a_bad_cache(function)
    return module


def _bear_a_bad_cache(function: Any) -> None:
    """Have a function compile anew where its file is damaged, and warn where none can be written.

    numba raises an error in both cases.
    """
    cache = getattr(function, "_cache", None)  # numba has no public name for it
    load, save = (getattr(cache, f"{verb}_overload", None) for verb in ("load", "save"))
    if cache is None or load is None or save is None:
        return

    def load_or_none(signature: Any, target: Any) -> Any:
        try:
            return load(signature, target)
        except Exception:  # what is damaged, by a crash of the machine, may raise anything
            with contextlib.suppress(OSError):
                cache.flush()
            return None

    def save_or_warn(signature: Any, result: Any) -> None:
        try:
            save(signature, result)
        except OSError as error:
            warnings.warn(f"compiled code is not kept: {error}", RuntimeWarning, stacklevel=2)
            cache.disable()

    cache.load_overload, cache.save_overload = load_or_none, save_or_warn


@lru_cache(maxsize=1)
def _private_folder(reason: str) -> Path:
    warnings.warn(
        f"compiled code is not kept: {reason}; set SST_ROS_CACHE to a folder of your own",
        RuntimeWarning,
        stacklevel=3,
    )
    folder = Path(tempfile.mkdtemp(prefix="sst_ros_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
