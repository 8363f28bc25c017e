# SPDX-License-Identifier: Apache-2.0
"""Remove the shared memory segments that processes of Fast DDS left when they were killed.

A process that ends removes its segments; one that is killed by SIGKILL or by a lack of memory
cannot. Each segment of a living process has a lock file (`_el`: one reader, `_sl`: several) on
which that process holds a lock by flock(2); the kernel releases it when the process dies, however
it dies. So a segment whose lock file can be locked is dead. The command `fastdds shm clean` uses
the same test.

Ports stay: their numbers are used again, so that a new process may be about to take over the port
of a dead one (SharedMemGlobal.hpp), and would not be heard if we removed it meanwhile.
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

_LOCK = re.compile(r"(fast(?:dds|rtps)_[0-9a-f]{16})_[es]l")
"""Lock files of segments, of Fast DDS 3 and 2. Each process gives its own a random name."""
AGE_S = 10.0
"""A process creates a lock file some microseconds before it locks it, longer on a loaded machine:
until then its file looks dead, and without it the process would not be heard."""


def remove_dead(folder: Path = FOLDER) -> list[str]:
    """Remove segments of processes of this user that are dead.

    What has no lock file, one of the last ten seconds, or belongs to another user, stays: it cannot
    be proven to be dead, or is not ours. Other processes may start and end meanwhile.

    Returns:
        The names of the segments that were removed.

    """
    removed = []
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            found = _LOCK.fullmatch(entry.name)
            if found and _remove(Path(entry.path), found[1]):
                removed.append(found[1])
    return removed


def _remove(lock: Path, name: str) -> bool:
    """Remove a segment, the lock file last, while its lock is held."""
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
        for path in (lock.with_name(name), lock):
            path.unlink(missing_ok=True)
    except OSError:  # it is locked: the process lives
        return False
    finally:
        os.close(descriptor)
    return True
