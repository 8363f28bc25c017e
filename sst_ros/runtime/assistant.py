# SPDX-License-Identifier: Apache-2.0
"""A process beside this one that computes what takes longer than a control period."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from queue import SimpleQueue
from subprocess import Popen
from typing import Any

from sst_ros.errors import SstError


class Assistant:
    """A process of low priority that calls one function, which pickle takes.

    It ends with this one. What takes longer than a control period is computed there: a
    thread would share the interpreter's lock with the control. A thread here waits for
    that process, which may take long to read and to write what the kernel does not hold
    at once.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._closed = False
        self._calls: SimpleQueue[Any] = SimpleQueue()
        self._results: SimpleQueue[Any] = SimpleQueue()
        self._begin()
        threading.Thread(target=self._exchange, name="assistant", daemon=True).start()

    def _begin(self) -> None:
        self._connection, theirs = Pipe()
        number = theirs.fileno()
        code = f"from sst_ros.runtime.assistant import assist; assist({number})"
        self._process = Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            pass_fds=[number],
            start_new_session=True,  # no Ctrl-C comes there
        )
        theirs.close()
        self._connection.send(self._function)

    def call(self, *arguments: Any) -> None:
        """Have the function called; not before the result of the last call is there."""
        self._calls.put(arguments)

    def result(self) -> Any:
        """Return the result of the call, None until it is there.

        It is an SstError where the call has failed. Where the process has ended, it
        says so, and another one is begun.
        """
        if self._results.empty():
            return None
        return self._results.get()

    def _exchange(self) -> None:
        while not self._closed:
            arguments = self._calls.get()
            try:
                self._connection.send(arguments)
                self._results.put(self._connection.recv())
            except (EOFError, OSError):
                if self._closed:
                    return
                text = (
                    "the process beside this one has ended with status"
                    f" {self._process.wait()}"
                )
                self._begin()
                self._results.put(SstError(text))

    def close(self) -> None:
        """End the process."""
        self._closed = True
        self._calls.put(())  # to the thread, where that waits for a call
        self._process.kill()  # where it waits for the process
        self._process.wait()


def assist(number: int) -> None:
    """Run the process of an `Assistant` on the connection of this descriptor."""
    with contextlib.suppress(EOFError, OSError), Connection(number) as connection:
        # with all that it imports: nothing is checked before
        function = connection.recv()
        os.nice(10)
        while True:
            arguments = connection.recv()
            try:
                result = function(*arguments)
            except SstError as error:
                result = error
            except Exception as error:
                result = SstError(repr(error))
            connection.send(result)
