# SPDX-License-Identifier: Apache-2.0
"""Nodes: hostile messages and parameters, steps that do not end, kills, starts and
stops.
"""

from __future__ import annotations

import math
import os
import random
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmark.campaign.ledger import Ledger
from benchmark.campaign.processor import OwnTime, wait_for_end
from benchmark.campaign.scenes import needle
from benchmark.nodes import Client, Process, own_domain
from sst_ros.errors import SstError
from sst_ros.recording import bag_writer
from sst_ros.recording.recording import read
from sst_ros.scene.scene import load
from sst_ros.state import IDLE_FRAME_ID

SAMPLE_NS = 2_000_000
FAULT_S, REPLY_S, CLOSE_S = 1.0, 0.5, 2.0
"""Within this time a step beyond its budget is a fault, a node answers a service, and
it ends, its waits for a processor not counted.
"""
FIRST_REPLY_S = REPLY_S + 3.0
"""The first reply to a client waits for its discovery by the node, too: a participant
of DDS announces itself every three seconds.
"""
LOST_S, HUNG_S = 60.0, 120.0
"""A reply that has not come by then is lost, and a node that has not ended is killed,
however busy the machine is.
"""

NODE = "/sst_simulator"


def start(command: str, **values: Any) -> Process:
    """Start a plain node, with parameters."""
    return Process(command, stderr=subprocess.STDOUT, **values)


@contextmanager
def running(**values: object) -> Iterator[tuple[Process, Client]]:
    """Give a running simulator and a client of it."""
    with own_domain() as number:
        process = start("simulator", **{"scene": "swing", "duration": 0.0, **values})
        client = Client(number)
        try:
            yield process, client
        finally:
            client.close()
            process.end(signal.SIGKILL, 20.0)


def is_alive(ledger: Ledger, process: Process, client: Client, after: str) -> bool:
    """Count a node that has died or does not answer."""
    from std_srvs.srv import SetBool

    if process.poll() is not None:
        output = process.end(0, 20.0)[1][-300:]
        ledger.add_finding("tracebacks", f"the node ended after {after}: {output}")
        return False
    ask(ledger, process, client, SetBool, "pause", after, data=False)
    return True


def ask(
    ledger: Ledger,
    process: Process,
    client: Client,
    service_type: Any,
    name: str,
    after: str,
    **fields: Any,
) -> Any:
    """Call a service of a node; count a reply that is lost or late; return the reply.

    Args:
        ledger: of the part.
        process: the node.
        client: who calls.
        service_type: of the service.
        name: of the service below that of the node.
        after: what the node has gone through.
        fields: of the request.

    """
    is_first = not client.knows(f"{NODE}/{name}")
    own_time = OwnTime(process.pid, os.getpid())
    reply, _ = client.call(service_type, f"{NODE}/{name}", LOST_S, **fields)
    if reply is None:
        ledger.add_finding("lost", f"no reply of {name} after {after}")
    else:
        bound_s = FIRST_REPLY_S if is_first else REPLY_S
        ledger.time(own_time.seconds(), bound_s, f"a reply of {name} after {after}")
    return reply


def stop(
    ledger: Ledger,
    process: Process,
    number: int = signal.SIGINT,
    statuses: tuple[int, ...] = (0, 1),
) -> None:
    """Send a signal; count an end that is late, in disorder or with a traceback."""
    if process.poll() is None:
        process.send_signal(number)
    ledger.time(wait_for_end(process, HUNG_S), CLOSE_S, "the end")
    status, text = process.end(signal.SIGKILL)
    if status not in statuses:
        ledger.add_finding("tracebacks", f"exit status {status}: {text[-300:]}")
    elif "Traceback" in text:
        ledger.add_finding("tracebacks", text[-300:])


def messages(ledger: Ledger) -> None:
    """Send commands of every wrong kind: no published state is ever not finite."""
    from geometry_msgs.msg import WrenchStamped
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64MultiArray

    rng = ledger.rng
    odd = (0.0, -0.0, 1e308, -1e308, 5e-324, math.nan, math.inf, -math.inf, 1.0, 1e9)
    names = ["gamma_1", "gamma_2", "gamma_3", "", "mu_1", "x" * 1000, "é"]
    with running(command_timeout=0.0) as (process, client):
        plain = client.node.create_publisher(Float64MultiArray, f"{NODE}/commands", 10)
        stamped = client.node.create_publisher(
            JointState, f"{NODE}/commands_stamped", 10
        )
        wrench = client.node.create_publisher(
            WrenchStamped, f"{NODE}/external_moment", 10
        )
        bad: list[str] = []

        def check(state: Any) -> None:
            if not all(
                map(math.isfinite, (*state.position, *state.velocity, *state.effort))
            ):
                bad.append(str(state))

        client.node.create_subscription(JointState, "/joint_states", check, 10)
        client.until(
            lambda: plain.get_subscription_count() and stamped.get_subscription_count()
        )
        for number in ledger.cases(1200, least=60):
            message_type = rng.randrange(3)
            data = [
                rng.choice(odd) for _ in range(rng.choice((0, 1, 3, 3, 3, 9, 2000)))
            ]
            if message_type == 0:
                plain.publish(Float64MultiArray(data=data))
            elif message_type == 1:
                chosen = [
                    rng.choice(names) for _ in range(rng.choice((len(data), 3, 0)))
                ]
                message = JointState(name=chosen, effort=data)
                message.header.stamp.sec = rng.choice((0, -(2**31), 2**31 - 1))
                stamped.publish(message)
            else:
                message = WrenchStamped()
                message.wrench.torque.x = rng.choice(odd)
                wrench.publish(message)
            client.executor.spin_once(timeout_sec=0.0)
            if number % 200 == 0 and not is_alive(
                ledger, process, client, f"message {number}"
            ):
                return
        is_alive(ledger, process, client, "all messages")
        if bad:
            ledger.add_finding("silent", f"a state is not finite: {bad[0]}", len(bad))
        stop(ledger, process)


def parameters(ledger: Ledger) -> None:
    """Set parameters of a running simulator to hostile values: refused, or taken.

    Never a fall.
    """
    from rcl_interfaces.srv import ListParameters, SetParameters
    from rclpy.parameter import Parameter

    rng = ledger.rng
    values: list[Any] = [
        True,
        0,
        -1,
        2**62,
        0.0,
        -0.0,
        5e-324,
        1e308,
        math.nan,
        math.inf,
    ]
    values += ["", "x", [1.0], ["a"], []]
    with running() as (process, client):
        reply = ask(
            ledger, process, client, ListParameters, "list_parameters", "the start"
        )
        if reply is None:
            return
        for number in ledger.cases(300, least=20):
            name, value = rng.choice(list(reply.result.names)), rng.choice(values)
            try:
                message = Parameter(name, value=value).to_parameter_msg()
            except (TypeError, AssertionError, OverflowError):
                continue
            after = f"{name} = {value}"
            values_set = {"parameters": [message]}
            ask(
                ledger,
                process,
                client,
                SetParameters,
                "set_parameters",
                after,
                **values_set,
            )
            if number % 50 == 0 and not is_alive(ledger, process, client, after):
                return
        is_alive(ledger, process, client, "all parameters")
        stop(ledger, process)


def node_kills(ledger: Ledger) -> None:
    """Kill the player and the controller beside a simulator: it goes on and ends when
    asked.
    """
    rng = ledger.rng
    for number in ledger.cases(66, least=1):
        with (
            running(wait_for_command=True) as (process, client),
            TemporaryDirectory() as folder,
        ):
            table = Path(folder) / "torques.csv"
            table.write_text("time,tau_1,tau_2,tau_3\n0,0.01,0,0\n60,0,0,0\n")
            command = ("torque_player", "inverse_dynamics")[number % 2]
            victim = start(
                command, **({"scene": "reach"} if number % 2 else {"csv": table})
            )
            client.until(lambda: client.node.count_subscribers("/joint_states"))
            # The wait is the experiment: the moment of the kill is random.
            time.sleep(rng.uniform(0.0, 1.5))
            victim.kill()
            victim.communicate()
            is_alive(ledger, process, client, f"the kill of {command}")
            stop(ledger, process, rng.choice((signal.SIGINT, signal.SIGTERM)))


BEGIN_S = 30.0
"""Within this time a recording has begun, see `OwnTime`."""


GIVE_UP_S = 300.0
"""The recorder ends by itself if it has not found all topics by then."""


def recorder_kills(ledger: Ledger) -> None:
    """Kill the recorder at random moments: all but the last chunk comes back.

    Before it says that it is ready it has not discovered all topics: what it records
    until then is not a run.
    """
    for number in ledger.cases(34):
        with TemporaryDirectory() as name, own_domain():
            bag = Path(name) / "bag"
            recorder = start("recorder", output=bag, timeout=GIVE_UP_S)
            simulator = start("simulator", scene="swing", duration=0.0)
            try:
                own_time = OwnTime(recorder.pid, simulator.pid)
                bound_s = BEGIN_S * ledger.patience
                while _size(bag) < 50_000 and own_time.seconds() < bound_s:
                    time.sleep(0.01)
                if (size := _size(bag)) < 50_000:
                    states = f"simulator {simulator.poll()}, recorder {recorder.poll()}"
                    ledger.add_finding(
                        "hangs", f"kill {number}: {size} bytes in time, ends: {states}"
                    )
                    continue
                if not _says_ready(recorder):
                    ledger.add_finding("hangs", f"kill {number}: never ready")
                    continue
                # The wait is the experiment: the moment of the kill is random.
                time.sleep(ledger.rng.uniform(1.5, 4.0))
                size = _size(bag)
                recorder.kill()
                recorder.wait()
                steps = np.diff(read(bag_writer.recover(bag).bag).time_ns)
                if not np.all(steps == SAMPLE_NS):
                    note = (
                        f"kill {number}: gaps inside what was recovered, {size} bytes"
                    )
                    ledger.add_finding("lost", note)
            except SstError as error:
                ledger.add_finding("lost", f"kill {number}: {error}")
            finally:
                for process in (simulator, recorder):
                    process.end(signal.SIGKILL, 20.0)


def _says_ready(recorder: Process) -> bool:
    """Wait until a recorder says that it records all topics, or has ended."""
    while line := recorder.line():
        if line.startswith("ready"):
            return True
    return False


def _size(bag: Path) -> int:
    return sum(path.stat().st_size for path in bag.glob("*.mcap"))


def stuck(ledger: Ledger) -> None:
    """Run a step that ends only by its budget: a fault, and the node still answers."""
    rng = ledger.rng
    for _ in ledger.cases(20, least=2):
        with TemporaryDirectory() as folder:
            path = Path(folder) / "needle.yaml"
            path.write_text(needle())
            with running(scene=path, wait_for_command=True) as (process, client):
                _time_fault(ledger, process, client)
                stop(ledger, process, rng.choice((signal.SIGINT, signal.SIGTERM)))


def _time_fault(ledger: Ledger, process: Process, client: Client) -> None:
    """Start the run; measure the time to the fault and to the replies after it."""
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import Float64MultiArray, String
    from std_srvs.srv import SetBool, Trigger

    phases: list[str] = []
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    client.node.create_subscription(
        String, f"{NODE}/phase", lambda message: phases.append(message.data), latched
    )
    commands = client.node.create_publisher(Float64MultiArray, f"{NODE}/commands", 10)
    ready = lambda: phases and commands.get_subscription_count()  # noqa: E731
    if not client.until(ready, LOST_S):
        ledger.add_finding("lost", "no phase, or no subscription of commands")
        return
    commands.publish(Float64MultiArray(data=[0.01, 0.0, 0.0]))
    # The command waits until the code of the scene is loaded.
    if not client.until(lambda: "running" in phases, LOST_S):
        ledger.add_finding("lost", f"no run, the phases are {phases}")
        return
    own_time = OwnTime(process.pid, os.getpid())
    if not client.until(lambda: phases[-1].startswith("fault"), LOST_S):
        ledger.add_finding("lost", f"no fault, the phases are {phases}")
        return
    ledger.time(own_time.seconds(), FAULT_S, "the fault")
    ask(ledger, process, client, SetBool, "pause", "the fault", data=True)
    ask(ledger, process, client, Trigger, "reset", "the fault")


def starts(ledger: Ledger) -> None:
    """Start and stop nodes at random moments: one line or none, nothing left in
    /dev/shm.
    """
    rng = ledger.rng
    before = _shared_memory()
    for number in ledger.cases(200, least=4):
        with own_domain():
            command = ("simulator", "torque_player", "recorder", "inverse_dynamics")[
                number % 4
            ]
            bag = {"output": f"/tmp/sst_campaign_{os.getpid()}_{number}"}
            process = start(command, **(bag if command == "recorder" else {}))
            # The wait is the experiment: the moment of the signal is random.
            time.sleep(rng.uniform(0.0, 2.0))
            number_sent = rng.choice((signal.SIGINT, signal.SIGTERM))
            # Before the first line of the package a SIGTERM is the kernel's.
            stop(ledger, process, number_sent, (0, 1, -signal.SIGTERM))
    left = _shared_memory() - before
    if len(left) > 4:
        ledger.add_finding(
            "lost", f"{len(left)} files left in /dev/shm: {sorted(left)[:3]}", len(left)
        )


def _shared_memory() -> set[str]:
    folder = Path("/dev/shm")
    return (
        {path.name for path in folder.glob("*fastrtps*")} if folder.is_dir() else set()
    )


def message_orders(ledger: Ledger) -> None:
    """Give workers states and phases in random orders: a fault or the end is heard.

    A worker that has commanded and sees a fault ends with it, whichever topic is first.
    """
    import rclpy
    from std_msgs.msg import String

    from sst_ros.nodes.inverse_dynamics import InverseDynamicsController
    from sst_ros.nodes.torque_player import TorquePlayer

    rng = ledger.rng
    with own_domain():
        rclpy.init(args=["--ros-args", "--log-level", "fatal"])
        try:
            for number in ledger.cases(600, least=20):
                worker_type = (TorquePlayer, InverseDynamicsController)[number % 2]
                last = rng.choice((FAULT, "finished"))
                phases = [String(data=name) for name in ("waiting", "running", last)]
                states = _states(rng, count=4 if last == FAULT else 3)
                merged = _merge(rng, phases[rng.randrange(3) :], states)
                worker: Any = worker_type()
                worker._commands = Commands()
                _hear(ledger, worker, merged, last)
                if isinstance(worker, InverseDynamicsController):
                    worker.follower.close()
                worker.node.destroy_node()
        finally:
            rclpy.try_shutdown()


FAULT = "fault: stopped at t = 0.1 s"


class Commands:
    """Stands for a publisher of commands with one subscriber."""

    topic_name = "commands"

    def publish(self, _: object) -> None:
        """Send nothing."""

    def get_subscription_count(self) -> int:
        """Return one."""
        return 1


def _states(rng: random.Random, count: int) -> list[Any]:
    """Return joint states of a run, with foreign ones between them."""
    from sensor_msgs.msg import JointState

    states = []
    for number, stamp_ms in enumerate((1, 2, 4, 5)[:count]):
        state = JointState(name=[f"gamma_{leg}" for leg in (1, 2, 3)])
        state.position, state.velocity = list(load("reach").initial.gamma), [0.0] * 3
        state.header.stamp.nanosec = stamp_ms * 1_000_000
        if number in (0, 3):
            state.header.frame_id = IDLE_FRAME_ID
        states.append(state)
        if rng.random() < 0.3:
            finger = JointState(name=["finger"], position=[0.0], velocity=[0.0])
            finger.header.stamp.sec = 7
            states.append(finger)
    return states[rng.randrange(2) :]


def _merge(rng: random.Random, first: list[Any], second: list[Any]) -> list[Any]:
    """Return the messages of two topics in a random order that keeps each one's."""
    places = set(rng.sample(range(len(first) + len(second)), len(first)))
    first_messages, second_messages = iter(first), iter(second)
    count = len(first) + len(second)
    return [
        next(first_messages) if place in places else next(second_messages)
        for place in range(count)
    ]


def _hear(ledger: Ledger, worker: Any, messages: list[Any], last: str) -> None:
    """Call a worker as its executor does; count a fault or an end that it ignores."""
    from std_msgs.msg import String

    name = type(worker).__name__
    order = ["phase" if isinstance(one, String) else "state" for one in messages]
    heard = False
    try:
        for message in messages:
            (worker.hear if isinstance(message, String) else worker.receive)(message)
        worker.watch()
        heard = worker.done.is_set()
    except SstError as error:
        heard = last == FAULT
        if not heard:
            ledger.add_finding("tracebacks", f"{name} after {order}: {error}")
    except Exception as error:
        text = f"{name} after {order}: {type(error).__name__}: {error}"
        ledger.add_finding("tracebacks", text)
    if not heard and worker.commanded:
        ledger.add_finding("lost", f"{name} does not hear {last!r} after {order}")
