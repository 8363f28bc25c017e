# SPDX-License-Identifier: Apache-2.0
"""Real nodes in real processes, each test in a ROS domain of its own on localhost."""

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

rclpy = pytest.importorskip("rclpy", reason="needs rclpy: pip install .[ros]")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from ros.forked import ForkedNode  # noqa: E402

from sst_ros.__main__ import main  # noqa: E402
from sst_ros.host import child_process  # noqa: E402
from sst_ros.nodes.process import configure_middleware  # noqa: E402
from sst_ros.state import IDLE_FRAME_ID  # noqa: E402

# A shell has its background jobs ignore SIGINT, and the nodes would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The observer is in this process: it asks the same of the middleware as the nodes do.
configure_middleware()


@pytest.fixture
def domain():
    with child_process.own_domain() as number:
        yield number


@pytest.fixture(scope="module")
def domain_of_module():
    with child_process.own_domain() as number:
        yield number


def children(process):
    """Numbers of the processes that a process has started."""
    return Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()


def is_running(number):
    return Path(f"/proc/{number}").exists()


class Nodes:
    """Starts nodes and leaves none behind."""

    def __init__(self):
        self.running = []

    def start(self, command, *words, executable=None, env=None):
        """Start a command in an interpreter of its own."""
        argv = executable or [sys.executable, "-m", "sst_ros", command]
        # Ends with this process, also where that is killed: the next run has the same domains.
        ends_with = {} if executable else {child_process.PARENT: str(os.getpid())}
        process = subprocess.Popen(
            [*argv, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # To make machine code for every scene of a test would take longer than all tests.
            env={**os.environ, "SST_ROS_NUMBA": "0", **ends_with, **(env or {})},
        )
        self.running.append(process)
        return process

    def run(self, command, **given):
        if command == "simulator":  # by default it would end with the scene's duration
            given.setdefault("duration", 0.0)
        words = [command, "--ros-args", *child_process.words(given)]
        self.running.append(ForkedNode(words, {**os.environ, "SST_ROS_NUMBA": "0"}))
        return self.running[-1]

    def line(self, process, timeout=40):
        assert select.select([process.stdout], [], [], timeout)[0], f"no output in {timeout} s"
        return process.stdout.readline()

    def stop(self, process, number=signal.SIGINT, timeout=40):
        process.send_signal(number)
        out, err = process.communicate(timeout=timeout)
        return process.returncode, out, err

    def close(self):
        """End all that run; what they have printed is shown where the test failed."""
        for process in self.running:
            if process.poll() is None:
                process.kill()
            sys.stderr.write("".join(text for text in process.communicate() if text))


@pytest.fixture
def nodes(domain):
    started = Nodes()
    yield started
    started.close()


@pytest.fixture
def run_here(domain, capfd):
    """Run a node that ends by itself in this process: a new one takes a second to start."""

    def run(command, *words, **given):
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            options = ["--ros-args", *child_process.words(given)] if given else []
            status = main([command, *words, *options])
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        out, err = capfd.readouterr()
        assert "Traceback" not in err
        return status, out, err

    return run


class Observer:
    """A node in the test's own process that keeps all it hears."""

    def __init__(self, domain):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("observer", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.heard = {}

    def listen(self, kind, topic, *, latched=False):
        heard = self.heard.setdefault(topic, [])
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=1000, durability=durability)
        self.node.create_subscription(kind, topic, heard.append, qos)
        return heard

    def publisher(self, kind, topic, readers=1):
        publisher = self.node.create_publisher(kind, topic, 10)
        self.until(lambda: publisher.get_subscription_count() >= readers, f"readers of {topic}")
        return publisher

    def until(self, condition, what, timeout=40.0):
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, f"no {what} within {timeout} s"
            self.executor.spin_once(timeout_sec=0.05)

    def publish_until(self, publisher, message, condition, what):
        """Publish every 50 ms: a node answers no state before its commands have a subscriber."""

        def published():
            publisher.publish(message)
            self.executor.spin_once(timeout_sec=0.05)
            return condition()

        self.until(published, what)

    def call(self, kind, name, /, **fields):
        client = self.node.create_client(kind, name)
        self.until(client.service_is_ready, f"service {name}")
        future = client.call_async(kind.Request(**fields))
        self.until(future.done, f"reply of {name}")
        self.node.destroy_client(client)
        return future.result()

    def set_parameter(self, node, name, value):
        parameter = Parameter(name, value=value).to_parameter_msg()
        reply = self.call(SetParameters, f"{node}/set_parameters", parameters=[parameter])
        return reply.results[0]

    def told(self, key, value, timeout=40.0):
        """Wait until the diagnostics say so; return all that they say then."""
        heard = self.heard.get("/diagnostics")
        if heard is None:
            heard = self.listen(DiagnosticArray, "/diagnostics")

        def last():
            return {pair.key: pair.value for pair in heard[-1].status[0].values}

        meets = value if callable(value) else lambda said: said == str(value)
        self.until(lambda: heard and meets(last()[key]), f"{key} in the diagnostics", timeout)
        return {**last(), "level": heard[-1].status[0].level, "said": heard[-1].status[0].message}

    @staticmethod
    def stamp(message):
        """Of a sample [ns]; 0 for a state before the run, in a pause or in a fault."""
        if message.header.frame_id == IDLE_FRAME_ID:
            return 0
        return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def observer(domain):
    watching = Observer(domain)
    yield watching
    watching.close()
