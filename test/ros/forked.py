# SPDX-License-Identifier: Apache-2.0
"""Nodes forked from a process that has imported them: each starts in a third of the
time.

The server has one thread, no node and no connection; what it forks differs from
`python -m sst_ros` in nothing but the time that its imports take.
"""

import atexit
import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor, TimeoutError
from multiprocessing import forkserver, resource_tracker

import pytest

from sst_ros.__main__ import main
from sst_ros.nodes import inverse_dynamics, simulator, torque_player  # noqa: F401
from sst_ros.runtime import child_process

with contextlib.suppress(ImportError):  # it needs rosbags
    from sst_ros.nodes import recorder  # noqa: F401

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["ros.forked"])


class ForkedNode:
    """As much of `subprocess.Popen` as the tests use."""

    def __init__(self, words, env):
        # for the server, which this starts if need be
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(
                "PYTHONPATH", os.pathsep.join(path for path in sys.path if path)
            )
            # a socket's path has at most 107 letters
            patch.setattr(tempfile, "tempdir", "/tmp")
            resource_tracker.ensure_running()
            forkserver.ensure_running()
        pipes = [os.pipe(), os.pipe()]
        self._process = CONTEXT.Process(
            target=_Call(words, env, [end for _, end in pipes])
        )
        self._process.start()
        for _, end in pipes:
            os.close(end)
        self.pid = self._process.pid
        self.stdout, self.stderr = (
            os.fdopen(begin, encoding="utf-8") for begin, _ in pipes
        )
        self._texts = []

    @property
    def returncode(self):
        return self.poll()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.wait()

    def poll(self):
        return self._process.exitcode

    def wait(self, timeout=None):
        self._process.join(timeout)
        if self.poll() is None:
            raise subprocess.TimeoutExpired("node", timeout)
        return self.poll()

    def communicate(self, timeout=None):
        """Read both pipes to their ends at once, so that none is full."""
        if not self._texts:
            pool = ThreadPoolExecutor(2)
            self._texts = [
                pool.submit(pipe.read) for pipe in (self.stdout, self.stderr)
            ]
        try:
            texts = tuple(text.result(timeout) for text in self._texts)
        except TimeoutError as error:
            raise subprocess.TimeoutExpired("node", timeout) from error
        self.wait(timeout)
        for pipe in (self.stdout, self.stderr):
            pipe.close()
        return texts

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        self._process.kill()


class _Call:
    """What the forked process does: a node with these words, environment, stdout and
    stderr.
    """

    def __init__(self, words, env, streams):
        self._words, self._env, self._streams = words, env, streams

    def __getstate__(self):
        duplicate = multiprocessing.reduction.DupFd
        return {
            **vars(self),
            "_streams": [duplicate(stream) for stream in self._streams],
        }

    def __call__(self):
        # as in a terminal, also under nohup
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        for number, stream in enumerate(self._streams, start=1):
            os.dup2(stream.detach(), number)
        # The server ends with the tests, however they end, and this node then ends
        # without it.
        os.close(forkserver._forkserver._forkserver_alive_fd)
        os.environ.clear()
        os.environ.update(self._env, **{child_process.PARENT: str(os.getppid())})
        status = main(self._words)
        atexit._run_exitfuncs()  # multiprocessing leaves without
        sys.exit(status)
