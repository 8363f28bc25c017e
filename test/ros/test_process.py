# SPDX-License-Identifier: Apache-2.0
"""The end of a process: by a signal, by its work, by a callback that fails."""

import subprocess
import sys
import threading
import time

import pytest
import rclpy
from rclpy.node import Node

from sst_ros.errors import SstError
from sst_ros.nodes import process, signals


class Worker:
    """Runs `callback` once, 10 ms after its start."""

    def __init__(self, context, callback):
        self.node = Node("worker", context=context)
        self.done, self.entered, self.closed = (threading.Event() for _ in range(3))
        self.node.create_timer(0.01, lambda: (self.entered.set(), callback(self)))

    def close(self):
        self.closed.set()


@pytest.fixture
def context(domain):
    own = rclpy.Context()
    rclpy.init(context=own, domain_id=domain)
    yield own
    rclpy.try_shutdown(context=own)


@pytest.fixture
def stop(monkeypatch):
    request = signals.StopRequest()
    monkeypatch.setattr(signals, "stop", request)
    return request


def test_a_signal_ends_a_node_while_a_callback_waits_for_it(context, stop):
    worker = Worker(context, lambda own: own.closed.wait(60.0))

    def signal():
        worker.entered.wait(60.0)
        stop.set()

    threading.Thread(target=signal).start()
    began = time.monotonic()
    process.spin(worker)
    assert worker.closed.is_set() and time.monotonic() - began < 30.0  # it would wait for 60 s


def test_the_end_of_the_work_ends_a_node(context, stop):
    worker = Worker(context, lambda own: own.done.set())
    process.spin(worker)
    assert worker.entered.is_set() and worker.closed.is_set()


def test_the_failure_of_a_callback_is_that_of_the_process(context, stop):
    def fail(own):
        raise SstError("the disk is full")

    worker = Worker(context, fail)
    with pytest.raises(SstError, match="the disk is full"):
        process.spin(worker)
    assert worker.closed.is_set()


HANGS = """
import ctypes, threading
import rclpy
from rclpy.node import Node
from sst_ros.nodes import process

class Hangs(Node):
    def destroy_node(self):
        # As in a deadlock of Fast DDS rclpy holds the interpreter's lock: PyDLL does, too.
        ctypes.PyDLL(None).sleep(60)

class Worker:
    def __init__(self):
        self.node, self.done = Hangs("worker"), threading.Event()
        self.done.set()

    def close(self):
        print("closed", flush=True)

process._CLEAN_UP_S = 1.0
rclpy.init()
process.spin(Worker())
"""


def test_a_node_ends_though_its_middleware_hangs(domain):
    began = time.monotonic()
    argv = [sys.executable, "-c", HANGS]
    ended = subprocess.run(argv, capture_output=True, text=True, timeout=100, check=False)
    assert time.monotonic() - began < 50.0  # it would wait for 60 s
    assert (ended.returncode, ended.stdout) == (1, "closed\n")
    assert "in destroy_node" in ended.stderr
