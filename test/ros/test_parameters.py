# SPDX-License-Identifier: Apache-2.0
"""Parameters at start and at run time."""

import contextlib
import math
import os
import sys
from array import array
from functools import reduce
from pathlib import Path

import pytest
import rclpy
import yaml
from missing_packages import needs
from rcl_interfaces.msg import ParameterType
from slow_cases import slow_after, slow_except

from sst_ros.nodes.process import Worker
from sst_ros.runtime.settings import NODE_COMMANDS, SimulatorParameters

pytestmark = pytest.mark.ros
ROOT = Path(__file__).parents[2]


def test_what_cannot_change_is_refused_with_the_reason(nodes, observer):
    # with time to spare on a slow machine
    nodes.run("simulator", rate=100, publish_rate=100)
    observer.phase("running")

    def put(name, value):
        result = observer.set_parameter(name, value)
        return result.successful, result.reason

    assert put("real_time_factor", 4.0) == (True, "")
    observer.told("real_time_factor_now", lambda factor: float(factor) > 2.0)
    assert put("command_timeout", 0.0)[0]
    refused = [
        ("real_time_factor", value) for value in (-1.0, math.nan, math.inf, "fast")
    ]
    refused += [("command_timeout", -0.1), ("rate", 500), ("scene", "example1")]
    for name, value in (*refused, ("sync", "lockstep"), ("use_sim_time", True)):
        successful, reason = put(name, value)
        assert not successful and reason, (name, value)
    assert "read" in put("use_sim_time", True)[1]
    observer.told("phase", "running")


def scheduling(process):
    """Return policy and priority of the threads of a process."""
    found = []
    for thread in Path(f"/proc/{process.pid}/task").iterdir():
        number = int(thread.name)
        with contextlib.suppress(ProcessLookupError):  # it has ended
            policy = os.sched_getscheduler(number) & ~os.SCHED_RESET_ON_FORK
            found.append((policy, os.sched_getparam(number).sched_priority))
    return sorted(found)


def test_threads_that_the_run_may_wait_for_are_real_time_too(nodes, observer):
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))
    except (AttributeError, OSError):
        pytest.skip("SCHED_FIFO is not permitted here")
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    process = nodes.run("simulator", realtime_priority=20)
    observer.phase("running")
    fifo = os.SCHED_FIFO

    def all_are(others, run):
        return lambda: (
            {*scheduling(process)[:-1]} == {others} and scheduling(process)[-1] == run
        )

    observer.until(all_are((fifo, 10), (fifo, 20)), "SCHED_FIFO of all threads")
    assert observer.set_parameter("real_time_factor", 0.0).successful
    usual = (os.SCHED_OTHER, 0)
    observer.until(all_are(usual, usual), "usual scheduling as fast as possible")


def machine_latency_us():
    """Return what all requests together allow [us].

    None where they may not be read or made.
    """
    try:
        with Path("/dev/cpu_dma_latency").open("r+b", buffering=0) as device:
            return int.from_bytes(device.read(4), sys.byteorder, signed=True)
    except OSError:
        return None


@pytest.mark.breadth
def test_exit_latency_is_limited_while_a_run_has_deadlines(nodes, observer):
    before = machine_latency_us()
    if not before:
        pytest.skip(
            "/dev/cpu_dma_latency may not be written here, or another process asks"
            " for 0"
        )
    process = nodes.run("simulator", cpu_dma_latency=0)
    observer.told("cpu_dma_latency", "0 us")
    assert machine_latency_us() == 0
    assert observer.set_parameter("real_time_factor", 0.0).successful
    observer.told("cpu_dma_latency", "no limit")
    assert machine_latency_us() == before
    assert observer.set_parameter("real_time_factor", 1.0).successful
    observer.until(lambda: machine_latency_us() == 0, "limit of a run with deadlines")
    assert observer.pause(True).success
    observer.until(lambda: machine_latency_us() == before, "no limit in a pause")
    assert observer.pause(False).success
    observer.until(lambda: machine_latency_us() == 0, "limit of a run that was resumed")
    process.kill()
    process.wait(100)
    assert machine_latency_us() == before


TYPES = {
    "number": ParameterType.PARAMETER_DOUBLE,
    "integer": ParameterType.PARAMETER_INTEGER,
    "flag": ParameterType.PARAMETER_BOOL,
    "text": ParameterType.PARAMETER_STRING,
    "choice": ParameterType.PARAMETER_STRING,
    "texts": ParameterType.PARAMETER_STRING_ARRAY,
}


LISTS = [
    (command, texts)
    for command in NODE_COMMANDS
    for texts in ("", "[]", "[joint_states]")
    if (command, texts) != ("recorder", "[]")  # which ends at once: no topic
]


@pytest.mark.parametrize(("command", "texts"), LISTS)
def test_descriptors_carry_type_words_bounds_and_read_only(domain, command, texts):
    """As `ros2 param describe` and `ros2 param get` read them; an empty list, too."""
    settings = NODE_COMMANDS[command][1]
    lists = [name for name, spec in settings.SPECS.items() if spec.kind == "texts"]
    given = [f"{name}:={texts}" for name in lists if texts]
    rclpy.init(
        args=[command, "--ros-args", *(word for one in given for word in ("-p", one))]
    )
    try:
        node = Worker(f"sst_{command}", settings).node
        for name, spec in settings.SPECS.items():
            descriptor, value = node.describe_parameter(name), node.get_parameter(name)
            kind = ParameterType.PARAMETER_DOUBLE_ARRAY
            assert descriptor.type == (kind if spec.shape else TYPES[spec.kind]), name
            assert value.type_.value == descriptor.type, name
            assert value.get_parameter_value().type == descriptor.type, name
            assert descriptor.description.startswith(spec.doc)
            assert descriptor.read_only == (name not in settings.CHANGEABLE)
            assert descriptor.additional_constraints == spec.describe()
            ranges = len(descriptor.floating_point_range), len(descriptor.integer_range)
            bounded = spec.kind == "number" and not spec.shape, spec.kind == "integer"
            assert ranges == bounded
            if descriptor.read_only:
                assert not node.set_parameters([value])[0].successful
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


@pytest.mark.parametrize(
    ("command", "given", "said"),
    [
        ("simulator", {"rate": 300}, "rate = 300: must divide 1e9"),
        (
            "simulator",
            {"publish_rate": 300},
            "publish_rate = 300: must divide rate = 1000",
        ),
        ("simulator", {"rate": "fast"}, "rate = 'fast': must be a whole number"),
        (
            "simulator",
            {"duration": ".nan"},
            "duration = nan: must be a finite number >= 0",
        ),
        ("simulator", {"scene": "nowhere"}, "must be a readable .yaml file or one of"),
        ("simulator", {"scene": 3}, "scene = 3: must be text"),
        (
            "simulator",
            {"wait_for_command": 2},
            "wait_for_command = 2: must be true or false",
        ),
        (
            "simulator",
            {"sync": "loose"},
            "sync = 'loose': must be one of free, lockstep",
        ),
        (
            "simulator",
            {"publish_clock": True, "use_sim_time": True},
            "cannot be its source",
        ),
        ("simulator", {"reaction": "wrist"}, "reaction = 'wrist': must be one of none"),
        ("simulator", {"imu_position": "[0.0, 1.0]"}, "must be 3 finite numbers"),
        ("torque_player", {"rate": 300}, "rate = 300: must divide 1e9"),
        ("torque_player", {"timeout": 0.5}, "no joint_states for"),
        ("inverse_dynamics", {"timeout": 0.5}, "no joint_states for"),
        ("inverse_dynamics", {"torque_limit": 0.5}, "exceeds the limit 0.5 N m"),
        ("inverse_dynamics", {"stamped": "[]"}, "stamped = []: must be true or false"),
        (
            "inverse_dynamics",
            {"stiffness": "[]"},
            "stiffness = []: must be 3 finite numbers",
        ),
        pytest.param(
            *("recorder", {"topics": "[]"}, "topics = []: must name a topic"),
            marks=needs("rosbags", "mcap"),
        ),
        pytest.param(
            *("recorder", {"output": "/"}, "must be a new folder"),
            marks=needs("rosbags", "mcap"),
        ),
    ],
)
def test_a_node_ends_that_cannot_do_its_work(run_here, command, given, said):
    """See test_trajectory_following.py for more reasons of the controller."""
    status, _, err = run_here(command, **given)
    assert status == 1
    assert said in err


def test_the_file_of_parameters_holds_the_defaults(nodes, observer):
    path = ROOT / "config" / "simulator.yaml"
    document = yaml.safe_load(path.read_text())
    given = document["/**"]["ros__parameters"]
    defaults = SimulatorParameters()
    of_scene = {"duration", "state_gamma", "state_gamma_dot"}
    names = SimulatorParameters.SPECS.keys() - of_scene - {"wait_for_subscribers"}
    values = {name: getattr(defaults, name) for name in names}
    values["imu_position"] = [*defaults.imu_position]
    assert given == values
    told = [
        "--ros-args",
        "--params-file",
        str(path),
        "-r",
        "__ns:=/left",
        "-r",
        "__node:=other",
    ]
    process = nodes.run("simulator", *told)
    observer.told("phase", "running")
    assert nodes.stop(process)[0] == 0


@pytest.mark.parametrize("command", NODE_COMMANDS)
def test_a_dump_of_the_parameters_loads_again(domain, tmp_path, command):
    """As `ros2 param dump` writes it: parameters with dots in trees, an empty list as
    [].
    """
    path, loaded = tmp_path / "dump.yaml", []
    for options in ([], ["--params-file", str(path)]):
        rclpy.init(args=[command, "--ros-args", *options])
        try:
            worker = Worker(f"sst_{command}", NODE_COMMANDS[command][1])
            loaded.append(worker.parameters)
            tree = {}
            for name, one in worker.node._parameters.items():
                *above, last = name.split(".")
                at = reduce(lambda inner, key: inner.setdefault(key, {}), above, tree)
                at[last] = (
                    [*one.value] if isinstance(one.value, (array, tuple)) else one.value
                )
            named = {worker.node.get_fully_qualified_name(): {"ros__parameters": tree}}
            path.write_text(yaml.dump(named))
            worker.node.destroy_node()
        finally:
            rclpy.try_shutdown()
    assert loaded[0] == loaded[1]


BROKEN = {
    "an empty folder": {},
    "types without support": {"srv.py": "class GetEntities: _TYPE_SUPPORT = None"},
    "an extension that fails": {"srv.py": "raise OSError('undefined symbol')"},
}


@pytest.mark.parametrize(
    "broken", slow_except(["types without support"], BROKEN, mark=pytest.mark.breadth)
)
@pytest.mark.parametrize(
    ("package", "node"),
    slow_after(
        1,
        [("simulation_interfaces", "simulator"), ("control_msgs", "inverse_dynamics")],
        mark=pytest.mark.breadth,
    ),
)
def test_an_incomplete_package_of_messages_is_left_out(
    nodes, tmp_path, package, node, broken
):
    (folder := tmp_path / package).mkdir()
    for name, text in BROKEN[broken].items():
        (folder / name).write_text(text)
    process = nodes.start(node, env={"PYTHONPATH": str(tmp_path)}, scene="reach")
    words = f"{package} is installed but incomplete, not used ("
    while words not in (line := process.stderr.readline()):
        assert line, "no warning"
    assert "Error" in line or "Exception" in line
    assert nodes.stop(process)[0] == 0
