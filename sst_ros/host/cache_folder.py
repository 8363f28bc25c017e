# SPDX-License-Identifier: Apache-2.0
"""The folder of compiled code, for the user alone (mode 700): numba unpickles what is in it."""

from __future__ import annotations

import atexit
import contextlib
import importlib.util
import os
import shutil
import stat
import sys
import tempfile
import warnings
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

from sst_ros.host.output import replace_file


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
            _write(path, data)
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


def _write(path: Path, data: bytes) -> None:
    with replace_file(path) as own:
        own.write_bytes(data)
        os.utime(own, (0, 0))  # numba's stamp is this time: the same for all, as the text is


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
