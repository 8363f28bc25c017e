# SPDX-License-Identifier: Apache-2.0
"""Remove the shared memory that processes of Fast DDS left when they were killed.

A process that ends removes its files; one that is killed by SIGKILL or by a lack of memory cannot.
Each segment and each port of a living process has a lock file (`_el`: one reader, `_sl`: several)
on which it holds a lock by flock(2); the kernel releases it when the process dies, however it dies.
So what has a lock file that can be locked is dead. Fast DDS decides by the same test whether it
takes over a port (RobustExclusiveLock.hpp), and its command `fastdds shm clean` uses it, too.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import time
from pathlib import Path

FOLDER = Path("/dev/shm")
"""Where glibc keeps POSIX shared memory."""

_LOCK = re.compile(r"(fast(?:dds|rtps)_(?:[0-9a-f]{16}|port\d{1,5}))_[es]l")
"""Lock files of Fast DDS 3 and 2: of a segment, and of a port, which has a mutex as well."""
AGE_S = 10.0
"""A process creates a lock file some microseconds before it locks it, longer on a loaded machine:
until then its file looks dead, and without it the process would not be heard."""


def remove_dead(folder: Path = FOLDER) -> list[str]:
    """Remove segments and ports of processes of this user that are dead.

    What has no lock file, one of the last ten seconds, or belongs to another user, stays: it cannot
    be proven to be dead, or is not ours. Other processes may start and end meanwhile.

    Returns:
        The names of the segments and ports that were removed.

    """
    removed = []
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            found = _LOCK.fullmatch(entry.name)
            if found and _remove(Path(entry.path), found[1]):
                removed.append(found[1])
    return removed


def _remove(lock: Path, name: str) -> bool:
    """Remove a segment or port, the lock file last, while its lock is held."""
    try:
        if time.time() - lock.lstat().st_mtime < AGE_S:
            return False
        descriptor = os.open(lock, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return False  # another process was faster
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        there, held = lock.stat(), os.fstat(descriptor)
        if there.st_ino != held.st_ino or held.st_uid != os.geteuid():
            return False
        for path in (lock.with_name(name), lock.with_name(f"sem.{name}_mutex"), lock):
            path.unlink(missing_ok=True)
    except OSError:  # it is locked: the process lives
        return False
    finally:
        os.close(descriptor)
    return True
