# SPDX-License-Identifier: Apache-2.0
"""Programs that tests run in an interpreter of its own, and ROS domains for nodes."""

import os
import subprocess
import sys
from contextlib import contextmanager
from unittest.mock import patch

from sst_ros.runtime import child_process

HIDDEN = """
import sys

class Hider:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Hider())
"""
"""Start of a program in which packages of these `names` cannot be found."""


def python(*words, env=None, status=0, **options):
    """Run Python with these words, a program by default.

    Return what it has printed and said.
    """
    if len(words) == 1:
        words = ("-c", *words)
    environment = {**os.environ, **(env or {})}
    given = {"capture_output": True, "text": True, "timeout": 100, **options}
    done = subprocess.run([sys.executable, *words], env=environment, **given)
    assert done.returncode == status, done.stderr
    return done


@contextmanager
def own_domain():
    """Have nodes use a ROS domain that nothing else on this machine has, without the
    network.
    """
    number, lock = child_process.lock_domain()
    ours = {"ROS_DOMAIN_ID": str(number), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    try:
        with patch.dict(os.environ, ours):
            yield number
    finally:
        os.close(lock)
