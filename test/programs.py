# SPDX-License-Identifier: Apache-2.0
"""Programs that tests run in an interpreter of its own."""

import os
import subprocess
import sys


def python(*words, env=None, status=0, **options):
    """Run Python with these words, a program by default; return what it has printed and said."""
    if len(words) == 1:
        words = ("-c", *words)
    environment = {**os.environ, **(env or {})}
    given = {"capture_output": True, "text": True, "timeout": 100, **options}
    done = subprocess.run([sys.executable, *words], env=environment, **given)
    assert done.returncode == status, done.stderr
    return done
