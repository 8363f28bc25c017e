# SPDX-License-Identifier: Apache-2.0
"""Real nodes in real processes, each test in a ROS domain of its own on localhost."""

import contextlib
import faulthandler
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
from programs import own_domain  # noqa: E402
from rcl_interfaces.srv import GetParameters, SetParameters  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from ros import message_types  # noqa: E402
from ros.forked import ForkedNode  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Float64MultiArray, String  # noqa: E402
from std_srvs.srv import SetBool  # noqa: E402

from sst_ros.__main__ import main  # noqa: E402
from sst_ros.nodes import signals  # noqa: E402
from sst_ros.nodes.process import configure_middleware  # noqa: E402
from sst_ros.runtime import child_process  # noqa: E402
from sst_ros.state import IDLE_FRAME_ID, nanoseconds  # noqa: E402

NODE = "/sst_simulator"
STDERR = os.dup(2)  # pytest captures the other one
COMMANDS, STAMPED = f"{NODE}/commands", f"{NODE}/commands_stamped"
NAMES = ["gamma_1", "gamma_2", "gamma_3"]
WAIT_S = 100.0
"""Longest wait for what a node does in a second: on a machine with thirty busy
processes its start alone has taken 40 s."""

# A shell has its background jobs ignore SIGINT, and the nodes would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The observer is in this process: it asks the same of the middleware as the nodes do.
configure_middleware()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """End this process, with a traceback, half a minute after the time-out of a test.

    Fast DDS deadlocks now and then when another node leaves (see
    `process._bound_time`), here in the observer; rclpy holds the interpreter's lock
    then, and the time-out itself never comes.
    """
    own = item.get_closest_marker("timeout")
    seconds = own.args[0] if own else float(item.config.getini("timeout"))
    faulthandler.dump_traceback_later(seconds + 30.0, exit=True, file=STDERR)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


def torques(*numbers):
    """A plain command [N m]."""
    return Float64MultiArray(data=list(map(float, numbers)))


def named(effort, stamp=None, names=NAMES):
    """A command by name and stamp [N m]."""
    message = JointState(name=list(names), effort=list(map(float, effort)))
    if stamp is not None:
        message.header.stamp = stamp
    return message


def children(process):
    """Numbers of the processes that a process has started."""
    return Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()


def is_running(number):
    return Path(f"/proc/{number}").exists()


class Nodes:
    """Starts nodes and leaves none behind."""

    def __init__(self):
        self.running = []

    def start(self, command, *words, executable=None, env=None, **given):
        """Start a command in an interpreter of its own."""
        argv = executable or [sys.executable, "-m", "sst_ros", command]
        words = [
            *words,
            *(["--ros-args", *child_process.words(given)] if given else []),
        ]
        # Ends with this process, also where that is killed: the next run has the same
        # domains.
        ends_with = {} if executable else {child_process.PARENT: str(os.getpid())}
        process = subprocess.Popen(
            [*argv, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # To make machine code for every scene of a test would take longer than all
            # tests.
            env={**os.environ, **ends_with, **(env or {})},
        )
        self.running.append(process)
        return process

    def run(self, command, *words, **given):
        """Fork a node, which starts in a third of the time."""
        # in lockstep by default it would end with the scene's
        if command == "simulator":
            given.setdefault("duration", 0.0)
        words = [command, *words, "--ros-args", *child_process.words(given)]
        self.running.append(ForkedNode(words, dict(os.environ)))
        return self.running[-1]

    def line(self, process, timeout=WAIT_S):
        assert select.select([process.stdout], [], [], timeout)[0], (
            f"no output in {timeout} s"
        )
        return process.stdout.readline()

    def ended(self, process, timeout=WAIT_S):
        """Status, stdout and stderr of a process that ends by itself."""
        out, err = process.communicate(timeout=timeout)
        assert "Traceback" not in err
        return process.returncode, out, err

    def stop(self, process, number=signal.SIGINT, timeout=WAIT_S):
        process.send_signal(number)
        return self.ended(process, timeout)

    def close(self):
        """End all that run; what they have printed is shown where the test failed."""
        for process in self.running:
            if process.poll() is None:
                process.kill()
            sys.stderr.write("".join(text for text in process.communicate() if text))


@pytest.fixture
def run_here(domain, capfd):
    """Run a node that ends by itself in this process: a new one takes a second to
    start.
    """

    def run(command, *words, **given):
        handlers = {
            number: signal.getsignal(number) for number in signals._SIGNAL_NUMBERS
        }
        try:
            options = ["--ros-args", *child_process.words(given)] if given else []
            status = main([command, *words, *options])
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            # A signal that the node took was for the tests; it would end every later
            # node at once.
            came = sorted(signals.came)
            signals.came.clear()
            for number in came:
                signal.raise_signal(number)
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
        self.heard, self._publishers, self._clients = {}, {}, {}
        self.diagnostics()  # a short run has ended before a late reader is known to it

    def listen(self, kind, topic, *, latched=False):
        """Messages of a topic since the first call of this, which grow."""
        if topic not in self.heard:
            heard = self.heard[topic] = []
            durability = (
                DurabilityPolicy.TRANSIENT_LOCAL
                if latched
                else DurabilityPolicy.VOLATILE
            )
            qos = QoSProfile(depth=1000, durability=durability)
            self.node.create_subscription(kind, topic, heard.append, qos)
        return self.heard[topic]

    @property
    def states(self):
        return self.listen(JointState, "/joint_states")

    @property
    def phases(self):
        return [
            phase.data for phase in self.listen(String, f"{NODE}/phase", latched=True)
        ]

    def samples(self):
        """Those of the states that belong to a run."""
        return [state for state in self.states if self.stamp(state)]

    def stamps(self, messages=None):
        """Of the messages of a run [ns]."""
        found = map(self.stamp, self.states if messages is None else messages)
        return [stamp for stamp in found if stamp]

    def torques(self):
        return [tuple(state.effort[:3]) for state in self.states]

    def publisher(self, kind, topic, readers=1):
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(kind, topic, 1000)
        publisher = self._publishers[topic]
        self.until(
            lambda: publisher.get_subscription_count() >= readers, f"readers of {topic}"
        )
        return publisher

    def command(self, *numbers, readers=1):
        self.publisher(Float64MultiArray, COMMANDS, readers).publish(torques(*numbers))

    def until(self, condition, what, timeout=WAIT_S):
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, f"no {what} within {timeout} s"
            self.executor.spin_once(timeout_sec=0.05)

    def publish_until(self, publisher, message, condition, what):
        """Publish every 50 ms: a node answers no state before its commands have a
        subscriber.
        """

        def published():
            publisher.publish(message)
            self.executor.spin_once(timeout_sec=0.05)
            return condition()

        self.until(published, what)

    def preview(self):
        """Wait for a state; return the last one."""
        self.until(lambda: self.states, "state")
        return self.states[-1]

    def phase(self, wanted):
        """Wait for a phase, of which this is the beginning; return the whole."""
        self.until(
            lambda: self.phases and self.phases[-1].startswith(wanted),
            f"phase {wanted}",
        )
        return self.phases[-1]

    def result(self, future, what, timeout=WAIT_S):
        self.until(future.done, what, timeout)
        return future.result()

    def call(self, kind, name, /, **fields):
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        client = self._clients[name]
        self.until(client.service_is_ready, f"service {name}")
        return self.result(
            client.call_async(kind.Request(**fields)), f"reply of {name}"
        )

    def pause(self, paused, node=NODE):
        return self.call(SetBool, f"{node}/pause", data=paused)

    def set_parameter(self, name, value, node=NODE):
        parameter = Parameter(name, value=value).to_parameter_msg()
        reply = self.call(
            SetParameters, f"{node}/set_parameters", parameters=[parameter]
        )
        return reply.results[0]

    def parameter(self, node, name):
        """Value of a flag of a node."""
        reply = self.call(GetParameters, f"{node}/get_parameters", names=[name])
        return reply.values[0].bool_value

    def diagnostics(self, name=""):
        """All that was said in the statuses whose name ends so."""
        heard = self.listen(DiagnosticArray, "/diagnostics")
        statuses = [message.status[0] for message in heard]
        return [
            {
                **{pair.key: pair.value for pair in status.values},
                **{"level": status.level, "said": status.message},
            }
            for status in statuses
            if status.name.endswith(name)
        ]

    def said(self, key):
        """All values of a key.

        Nodes have keys of their own, and one may say more often.
        """
        return [status[key] for status in self.diagnostics() if key in status]

    def told(self, key, value, timeout=WAIT_S):
        """Wait until the last status with this key says so.

        Return all that it says then.
        """
        meets = value if callable(value) else lambda said: said == str(value)
        said = []

        def is_told():
            # Other nodes have keys of their own, and their last word may be the newer
            # one.
            said[:] = [status for status in self.diagnostics() if key in status][-1:]
            return said and meets(said[0][key])

        self.until(is_told, f"{key} in the diagnostics", timeout)
        return said[0]

    @staticmethod
    def stamp(message):
        """Of a sample [ns]; 0 for a state before the run, in a pause or in a fault."""
        return (
            0
            if message.header.frame_id == IDLE_FRAME_ID
            else nanoseconds(message.header.stamp)
        )

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


# Of the generator in the context manager.
domain = pytest.fixture(own_domain.__wrapped__)
domain_of_module = pytest.fixture(own_domain.__wrapped__, scope="module")


@pytest.fixture
def nodes(domain):
    with contextlib.closing(Nodes()) as started:
        yield started


@pytest.fixture
def observer(domain):
    with contextlib.closing(Observer(domain)) as started:
        yield started


@pytest.fixture(scope="module")
def nodes_of_module(domain_of_module):
    with contextlib.closing(Nodes()) as started:
        yield started


@pytest.fixture(scope="module")
def observer_of_module(domain_of_module):
    with contextlib.closing(Observer(domain_of_module)) as started:
        yield started


@pytest.fixture(scope="module")
def forked_demos(domain_of_module):
    """Have demos fork their nodes, too; test_demo.py starts them as a user does."""

    def start(words, env, **_):
        return ForkedNode(words[words.index("sst_ros") + 1 :], env)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(child_process, "Popen", start)
        yield


@pytest.fixture
def profile(tmp_path):
    """Write a torque profile of rows of time and torques as a file; return its path."""

    def write(*rows):
        path = tmp_path / "torque.csv"
        path.write_text("\n".join(["time,tau_1,tau_2,tau_3", *rows, ""]))
        return path

    return write


def foreign_types(package):
    """Make the types of a package importable, here and in nodes.

    Yield their environment.
    """
    with pytest.MonkeyPatch.context() as patch:
        folder = str(message_types.folder(package))
        patch.syspath_prepend(folder)
        yield {
            "PYTHONPATH": os.pathsep.join([folder, os.environ.get("PYTHONPATH", "")])
        }
