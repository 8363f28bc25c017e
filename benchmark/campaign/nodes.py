# SPDX-License-Identifier: Apache-2.0
"""Nodes: hostile messages and parameters, floods, services at once, kills, starts and stops."""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmark.campaign.ledger import Budget, Ledger
from sst_ros import child_process

REPLY_S = 0.5
"""A node answers every service within this time."""
CLOSE_S = 2.0
"""A node ends within this time of a signal."""
NODE = "/sst_simulator"


@contextmanager
def domain() -> Iterator[int]:
    """Give the processes that are started inside a ROS domain of their own, on localhost."""
    before = dict(os.environ)
    with contextlib.ExitStack() as stack:
        number = _lock(stack)
        os.environ.update(
            ROS_DOMAIN_ID=str(number), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST", SST_ROS_NUMBA="0"
        )
        try:
            yield number
        finally:
            os.environ.clear()
            os.environ.update(before)


def _lock(stack: contextlib.ExitStack) -> int:
    """Take a domain that no other part and no test on this machine has."""
    for number in range(1, 101):
        lock = (Path(tempfile.gettempdir()) / f"sst_ros_domain_{number}").open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
            continue
        stack.callback(lock.close)
        return number
    raise RuntimeError("no ROS domain is free")


def start(command: str, **given: object) -> subprocess.Popen[str]:
    """Start a node with parameters."""
    words = ["--ros-args", *child_process.words(given)] if given else []
    return subprocess.Popen(
        [sys.executable, "-m", "sst_ros", command, *words],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        pipesize=1 << 20,  # nobody reads before the end, and a full pipe stops the node
    )  # fmt: skip


def ended(process: subprocess.Popen[str], number: int, timeout: float = 20.0) -> tuple[int, str]:
    """Send a signal, wait for the end; return the exit status and all that was printed."""
    if process.poll() is None:
        process.send_signal(number)
    try:
        out, _ = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        process.kill()
        out, _ = process.communicate()
        return 255, out or ""
    except ValueError:  # its output has been read and closed already
        return process.wait(), ""
    return process.returncode, out or ""


class Client:
    """A node of this process that publishes, calls and listens."""

    def __init__(self, number: int) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile

        # Replies to all clients of a service arrive at each: ten, the default, displace its own.
        self.qos = QoSProfile(depth=1000)
        self.rclpy, self.context = rclpy, rclpy.Context()
        rclpy.init(context=self.context, domain_id=number)
        self.node = rclpy.create_node("campaign", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def until(self, condition: Callable[[], Any], timeout: float = 20.0) -> bool:
        """Spin until a condition holds; False after the time-out."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                return False
            self.executor.spin_once(timeout_sec=0.02)
        return True

    def call(self, kind: Any, name: str, timeout: float = 10.0, **fields: Any) -> tuple[Any, float]:
        """Call a service; return the reply, or None, and how long it took [s]."""
        client = self.node.create_client(kind, name, qos_profile=self.qos)
        try:
            if not self.until(client.service_is_ready):
                return None, math.inf
            future, began = client.call_async(kind.Request(**fields)), time.monotonic()
            done = self.until(future.done, timeout)
            return (future.result() if done else None), time.monotonic() - began
        finally:
            self.node.destroy_client(client)

    def close(self) -> None:
        """Leave the graph."""
        self.executor.shutdown()
        self.node.destroy_node()
        self.rclpy.try_shutdown(context=self.context)


@contextmanager
def running(**given: object) -> Iterator[tuple[subprocess.Popen[str], Client]]:
    """Give a running simulator and a client of it."""
    with domain() as number:
        process = start("simulator", scene="swing", duration=0.0, **given)
        client = Client(number)
        try:
            yield process, client
        finally:
            client.close()
            ended(process, signal.SIGKILL)


def _alive(ledger: Ledger, process: subprocess.Popen[str], client: Client, after: str) -> bool:
    """Count a node that has died or does not answer."""
    from std_srvs.srv import SetBool

    if process.poll() is not None:
        ledger.found("tracebacks", f"the node ended after {after}: {ended(process, 0)[1][-300:]}")
        return False
    reply, took = client.call(SetBool, f"{NODE}/pause", data=False)
    if reply is None:
        ledger.found("lost", f"no reply after {after}")
    elif (
        took > (REPLY_S + 0.5) * ledger.patience
    ):  # two processes and discovery share two cores with the campaign
        ledger.found("hangs", f"a reply took {took:.2f} s after {after}")
    ledger.longest_s = max(ledger.longest_s, took if math.isfinite(took) else 0.0)
    return True


def _stopped(ledger: Ledger, process: subprocess.Popen[str], number: int = signal.SIGINT) -> None:
    began = time.monotonic()
    status, text = ended(process, number)
    took = time.monotonic() - began
    if status not in (0, 1):
        ledger.found("tracebacks", f"exit status {status}")
    if "Traceback" in text:
        ledger.found("tracebacks", text[-300:])
    if took > 2 * CLOSE_S * ledger.patience:
        ledger.found("hangs", f"it took {took:.1f} s to close")


def messages(budget: Budget, seed: int) -> Ledger:
    """Send commands of every wrong kind: no state that is published is ever not finite."""
    from geometry_msgs.msg import WrenchStamped
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64MultiArray

    ledger, rng = budget.ledger("hostile messages"), random.Random(seed)
    odd = (0.0, -0.0, 1e308, -1e308, 5e-324, math.nan, math.inf, -math.inf, 1.0, 1e9)
    names = ["gamma_1", "gamma_2", "gamma_3", "", "mu_1", "x" * 1000, "é"]
    with running(command_timeout=0.0) as (process, client):
        plain = client.node.create_publisher(Float64MultiArray, f"{NODE}/commands", 10)
        stamped = client.node.create_publisher(JointState, f"{NODE}/commands_stamped", 10)
        wrench = client.node.create_publisher(WrenchStamped, f"{NODE}/external_moment", 10)
        bad: list[str] = []

        def check(state: Any) -> None:
            if not all(map(math.isfinite, (*state.position, *state.velocity, *state.effort))):
                bad.append(str(state))

        client.node.create_subscription(JointState, "/joint_states", check, 10)
        client.until(lambda: plain.get_subscription_count() and stamped.get_subscription_count())
        for number in budget.cases(1200, least=60):
            ledger.tried += 1
            kind = rng.randrange(3)
            data = [rng.choice(odd) for _ in range(rng.choice((0, 1, 3, 3, 3, 9, 2000)))]
            if kind == 0:
                plain.publish(Float64MultiArray(data=data))
            elif kind == 1:
                chosen = [rng.choice(names) for _ in range(rng.choice((len(data), 3, 0)))]
                message = JointState(name=chosen, effort=data)
                message.header.stamp.sec = rng.choice((0, -(2**31), 2**31 - 1))
                stamped.publish(message)
            else:
                message = WrenchStamped()
                message.wrench.torque.x = rng.choice(odd)
                wrench.publish(message)
            client.executor.spin_once(timeout_sec=0.0)
            if number % 200 == 0 and not _alive(ledger, process, client, f"message {number}"):
                return ledger
        _alive(ledger, process, client, "all messages")
        if bad:
            ledger.found("silent", f"a state is not finite: {bad[0]}", len(bad))
        _stopped(ledger, process)
    return ledger


def floods(budget: Budget, seed: int) -> Ledger:
    """Publish as fast as three threads can, for seconds: the node keeps answering."""
    from std_msgs.msg import Float64MultiArray

    ledger, sent = budget.ledger("messages of three floods"), [0, 0, 0]
    with running() as (process, client):
        stop = threading.Event()
        publishers = [
            client.node.create_publisher(Float64MultiArray, f"{NODE}/commands", 10)
            for _ in range(3)
        ]
        client.until(lambda: publishers[0].get_subscription_count())

        def flood(index: int) -> None:
            message = Float64MultiArray(data=[0.1, 0.0, -0.1])
            while not stop.is_set():
                publishers[index].publish(message)
                sent[index] += 1

        threads = [threading.Thread(target=flood, args=(index,)) for index in range(3)]
        for thread in threads:
            thread.start()
        end = time.monotonic() + max(1.0, 20.0 * budget.share)
        while time.monotonic() < end:
            if not _alive(ledger, process, client, f"{sum(sent)} messages"):
                break
        stop.set()
        for thread in threads:
            thread.join()
        ledger.tried = sum(sent)
        _stopped(ledger, process, signal.SIGTERM)
    del seed
    return ledger


def services(budget: Budget, seed: int) -> Ledger:
    """Call services from four clients at once, in any order: every call is answered."""
    from std_srvs.srv import SetBool, Trigger

    ledger = budget.ledger("service calls of four clients")
    lock = threading.Lock()
    with running() as (process, client):
        _alive(ledger, process, client, "the start")
        number = int(os.environ["ROS_DOMAIN_ID"])

        def work(index: int) -> None:
            rng, caller = random.Random(seed + index), Client(number)
            kinds = [(SetBool, "pause", {"data": True}), (SetBool, "pause", {"data": False}),
                     (Trigger, "step", {}), (Trigger, "reset", {})]  # fmt: skip
            clients = {name: caller.node.create_client(kind, f"{NODE}/{name}",
                                                             qos_profile=caller.qos)
                       for kind, name, _ in kinds}  # fmt: skip
            for one in clients.values():
                caller.until(one.service_is_ready)
            for _ in budget.cases(1000, least=15):
                kind, name, fields = rng.choice(kinds)
                began = time.monotonic()
                future = clients[name].call_async(kind.Request(**fields))
                done = caller.until(future.done, 10.0)
                took = time.monotonic() - began
                with lock:
                    ledger.tried += 1
                    ledger.longest_s = max(ledger.longest_s, took)
                    if not done:
                        ledger.found("lost", f"no reply of {name} within 10 s")
                    elif took > (REPLY_S + 0.5) * ledger.patience:
                        ledger.found("hangs", f"{name} took {took:.2f} s")
            caller.close()

        threads = [threading.Thread(target=work, args=(index,)) for index in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        _stopped(ledger, process)
    return ledger


def parameters(budget: Budget, seed: int) -> Ledger:
    """Set parameters of a running simulator to hostile values: refused, or taken; never a fall."""
    from rcl_interfaces.srv import ListParameters, SetParameters
    from rclpy.parameter import Parameter

    ledger, rng = budget.ledger("parameters set at run time"), random.Random(seed)
    values = (True, 0, -1, 2**62, 0.0, -0.0, 5e-324, 1e308, math.nan, math.inf, "", "x", [1.0],
              ["a"], [])  # fmt: skip
    with running() as (process, client):
        reply, _ = client.call(ListParameters, f"{NODE}/list_parameters")
        if reply is None:
            ledger.found("lost", "no list of parameters")
            return ledger
        for number in budget.cases(300, least=20):
            ledger.tried += 1
            name, value = rng.choice(list(reply.result.names)), rng.choice(values)
            try:
                message = Parameter(name, value=value).to_parameter_msg()
            except (TypeError, AssertionError, OverflowError):
                continue
            done, took = client.call(SetParameters, f"{NODE}/set_parameters", parameters=[message])
            if done is None:
                ledger.found("lost", f"no reply to {name} = {value}")
            ledger.longest_s = max(ledger.longest_s, took if math.isfinite(took) else 0.0)
            if number % 50 == 0 and not _alive(ledger, process, client, f"{name} = {value}"):
                return ledger
        _alive(ledger, process, client, "all parameters")
        _stopped(ledger, process)
    return ledger


def kills(budget: Budget, seed: int) -> Ledger:
    """Kill the player and the controller beside a simulator: it goes on and ends when asked."""
    ledger, rng = budget.ledger("players and controllers killed with -9"), random.Random(seed)
    for number in budget.cases(66, least=1):
        ledger.tried += 1
        with running(wait_for_command=True) as (process, client):
            kind = ("torque_player", "inverse_dynamics")[number % 2]
            other = start(kind, scene="swing" if number % 2 == 0 else "reach")
            client.until(lambda: client.node.count_subscribers("/joint_states"))
            # The wait is the experiment: the moment of the kill is random.
            time.sleep(rng.uniform(0.0, 1.5))
            other.kill()
            other.communicate()
            _alive(ledger, process, client, f"the kill of {kind}")
            _stopped(ledger, process, rng.choice((signal.SIGINT, signal.SIGTERM)))
    return ledger


def clock(budget: Budget, seed: int) -> Ledger:
    """Give a clock that jumps, stops and runs back: the node goes on or waits, and ends."""
    from rosgraph_msgs.msg import Clock

    ledger, rng = budget.ledger("jumps of /clock under use_sim_time"), random.Random(seed)
    with running(use_sim_time=True) as (process, client):
        publisher = client.node.create_publisher(Clock, "/clock", 1)
        now = 1.0
        for _ in budget.cases(300, least=30):
            ledger.tried += 1
            now = max(0.0, now + rng.choice((0.001, 0.01, 0.01, 0.1, 5.0, -2.0, 0.0, 1e6, -1e6)))
            message = Clock()
            message.clock.sec, message.clock.nanosec = int(min(now, 2**31 - 1)), int(now % 1 * 1e9)
            publisher.publish(message)
            client.executor.spin_once(timeout_sec=0.005)
        _alive(ledger, process, client, "the jumps")
        _stopped(ledger, process)
    return ledger


def starts(budget: Budget, seed: int) -> Ledger:
    """Start and stop nodes at random moments: one line or none, nothing left in /dev/shm."""
    ledger, rng = budget.ledger("starts and stops"), random.Random(seed)
    before = _shared_memory()
    for number in budget.cases(200, least=4):
        ledger.tried += 1
        with domain():
            kind = ("simulator", "torque_player", "recorder", "inverse_dynamics")[number % 4]
            process = start(kind, **({"output": f"/tmp/sst_campaign_{os.getpid()}_{number}"}
                                     if kind == "recorder" else {}))  # fmt: skip
            # The wait is the experiment: the moment of the signal is random.
            time.sleep(rng.uniform(0.0, 2.0))
            status, text = ended(
                process, rng.choice((signal.SIGINT, signal.SIGTERM)), 10.0 * ledger.patience
            )
            if status == 255:
                ledger.found("hangs", f"{kind} did not end within 10 s")
            if "Traceback" in text:
                ledger.found("tracebacks", f"{kind}: {text[-300:]}")
    left = _shared_memory() - before
    if len(left) > 4:
        ledger.found("lost", f"{len(left)} files left in /dev/shm: {sorted(left)[:3]}", len(left))
    return ledger


def _shared_memory() -> set[str]:
    folder = Path("/dev/shm")
    return {path.name for path in folder.glob("*fastrtps*")} if folder.is_dir() else set()
