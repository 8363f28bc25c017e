# SPDX-License-Identifier: Apache-2.0
"""Processes and threads: nodes that this process starts, here only, and how a node is scheduled.

Nodes are processes of their own, in a ROS domain that nothing else on this machine has.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import itertools
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from queue import SimpleQueue
from subprocess import Popen
from typing import Any, BinaryIO

from sst_ros.errors import SstError

# variable with the number of the process without which a node is to end
PARENT = "SST_ROS_PARENT"
NO_LIMIT = "no limit"
_SWITCH_INTERVAL_S = 1e-4
_END_S = 10.0
_DOMAINS, _PARTICIPANTS = 100, 32
_next = itertools.count(os.getpid())  # what comes later leaves the last ones to end


@contextmanager
def run_beside(
    command: str, given: dict[str, object], **more: Any
) -> Iterator[Popen[str]]:
    """Have a node with parameters beside a block.

    It ends when this process does, however.

    Behind the block it gets SIGINT, and is killed if its end takes 10 s.
    """
    keep_domain()
    started = [sys.executable, "-m", "sst_ros", command, "--ros-args", *words(given)]
    with Popen(
        started, env={**os.environ, PARENT: str(os.getpid())}, text=True, **more
    ) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=_END_S)
            except subprocess.TimeoutExpired:
                process.kill()


def keep_domain() -> None:
    """Use the ROS domain that the environment names, or else one that this process then keeps."""
    if "ROS_DOMAIN_ID" not in os.environ:
        os.environ["ROS_DOMAIN_ID"] = str(lock_domain()[0])
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def lock_domain() -> tuple[int, int]:
    """Return the number of a domain, and the descriptor that keeps it until it is closed.

    No node is in it, neither one whose parent has just ended nor one that a user has
    started.
    """
    for _ in range(_DOMAINS):
        number = 1 + next(_next) % _DOMAINS
        path = Path(tempfile.gettempdir()) / f"sst_ros_domain_{number}"
        with contextlib.suppress(OSError):  # of another user
            lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _refuse_nodes(number)
            except OSError:
                os.close(lock)
                continue
            return number, lock
    raise SstError(
        f"all ROS domains from 1 to {_DOMAINS} are in use: set ROS_DOMAIN_ID"
    )


def _refuse_nodes(domain: int) -> None:
    """Raise OSError where a port of a participant of this domain is taken (RTPS 2.5, 9.6.2.3)."""
    for port in range(7410 + 250 * domain, 7410 + 250 * domain + 2 * _PARTICIPANTS, 2):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("", port))


def words(given: dict[str, object]) -> list[str]:
    """Give parameters as --ros-args takes them."""
    shown = {
        key: str(x).lower() if isinstance(x, bool) else x for key, x in given.items()
    }
    return [word for key, value in shown.items() for word in ("-p", f"{key}:={value}")]


class Assistant:
    """A process of low priority that calls one function, which pickle takes.

    It ends with this one.

    What takes longer than a control period is computed there: a thread would share the
    interpreter's lock with the control. A thread here waits for that process, which may
    take long to read and to write what the kernel does not hold at once.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self._closed = function, False
        self._calls, self._results = SimpleQueue[Any](), SimpleQueue[Any]()
        self._begin()
        threading.Thread(target=self._exchange, name="assistant", daemon=True).start()

    def _begin(self) -> None:
        self._connection, theirs = Pipe()
        number = theirs.fileno()
        code = f"from sst_ros.host.processes import assist; assist({number})"
        self._process = Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            pass_fds=[number],
            start_new_session=True,  # no Ctrl-C comes there
        )
        theirs.close()
        self._connection.send(self._function)

    def call(self, *given: Any) -> None:
        """Have the function called; not before the result of the last call is there."""
        self._calls.put(given)

    def result(self) -> Any:
        """Return the result of the call, or the SstError why there is none.

        None until it is there.

        Where the process has ended another one is begun.
        """
        return None if self._results.empty() else self._results.get()

    def _exchange(self) -> None:
        while not self._closed:
            given = self._calls.get()
            try:
                self._connection.send(given)
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
    """Be the process of an `Assistant` at the other end of the connection of this descriptor."""
    with contextlib.suppress(EOFError, OSError), Connection(number) as connection:
        # with all that it imports: nothing is checked before
        function = connection.recv()
        os.nice(10)
        while True:
            given = connection.recv()
            try:
                result = function(*given)
            except Exception as error:
                result = error if isinstance(error, SstError) else SstError(repr(error))
            connection.send(result)


def is_orphan() -> bool:
    """Return whether the process that started this one, and without which it ends, has ended."""
    parent = os.environ.get(PARENT)
    return parent is not None and os.getppid() != int(parent)


def schedule(priority: int, thread: int) -> str:
    """Ask for SCHED_FIFO for all threads (0: for the usual scheduling).

    Return what was granted.

    The thread of this native id gets the priority, 0 to 99. The others of this process
    get half of it: they hold locks that it waits for, the interpreter's and those of
    DDS, and must not be preempted meanwhile. What they begin later, threads or
    processes, is scheduled as usual until the next call. If the thread has ended, a
    ProcessLookupError is raised.
    """
    if not hasattr(os, "sched_setscheduler"):
        return "usual: this system has no SCHED_FIFO"
    if priority == 0:
        if os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK != os.SCHED_OTHER:
            _schedule_all(os.SCHED_OTHER, thread, 0, 0)
        return "usual"
    try:
        _schedule_all(os.SCHED_FIFO, thread, priority, (priority + 1) // 2)
    except ProcessLookupError:
        raise
    except (OSError, ValueError) as error:
        return f"usual: SCHED_FIFO {priority} is not permitted ({error})"
    return f"SCHED_FIFO {priority}"


def _schedule_all(policy: int, thread: int, priority: int, others: int) -> None:
    policy |= os.SCHED_RESET_ON_FORK
    os.sched_setscheduler(thread, policy, os.sched_param(priority))
    for task in Path("/proc/self/task").iterdir():
        if int(task.name) != thread:
            with contextlib.suppress(ProcessLookupError):  # it has ended
                os.sched_setscheduler(int(task.name), policy, os.sched_param(others))


class CpuDmaLatency:
    """Request that no core uses an idle state with a longer exit latency (Linux PM QoS).

    A core that leaves a deep idle state does so late and with cold caches. The kernel
    keeps the request as long as the file is open: it ends with the process, however
    that ends.
    """

    def __init__(self, device: Path = Path("/dev/cpu_dma_latency")) -> None:
        self._device, self._asked_us, self._granted = device, -1, NO_LIMIT
        self._file: BinaryIO | None = None

    def request(self, latency_us: int) -> str:
        """Ask for this largest exit latency [us], -1 for no limit.

        Return what was granted.
        """
        if latency_us == self._asked_us:
            return self._granted
        if self._file is not None:
            self._file.close()
        self._file, self._granted = None, NO_LIMIT
        if latency_us >= 0:
            try:
                self._file = self._device.open("r+b", buffering=0)
                self._file.write(latency_us.to_bytes(4, sys.byteorder))
                self._granted = f"{latency_us} us"
            except OSError as error:
                self._granted = (
                    f"{NO_LIMIT}: {latency_us} us is not permitted ({error})"
                )
        self._asked_us = latency_us
        return self._granted


def quiet() -> None:
    """Collect no garbage unasked, and switch threads often.

    To be called when all code is loaded: what exists now is not looked through again.
    A thread that wakes up waits up to the switch interval, 5 ms by default: five ticks.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    gc.disable()
