# SPDX-License-Identifier: Apache-2.0
"""Type the commands of docs/commands_tried.md in a ROS 2 installation, and tabulate.

    source /opt/ros/kilted/setup.bash; source install/setup.bash
    python tools/commands_tried.py [NAME ...] > table.md

A session has nodes that run beside its commands, a domain and an empty folder of its
own. The table has for each command the words that its output must have, the line that
has them or the last one that came, and the exit status. The status is 1 where a command
did not end as expected.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

LONGEST_S = 240.0
"""A command needs 2 s to start where nothing runs beside it, here up to a minute."""
_INTERRUPTED = (2, 130, -signal.SIGINT)
"""Exit statuses after Ctrl-C, beside 0."""
FIRST_DOMAIN = 60
WIDEST = 100
"""Characters of the output that the table shows."""

SIMULATOR = "ros2 run sst_ros simulator --ros-args"
CONTROLLER = "ros2 run sst_ros inverse_dynamics --ros-args"
CLI = "ros2 run sst_ros sst-ros"
LAUNCH = "ros2 launch sst_ros"
TRIGGER = "std_srvs/srv/Trigger"
FLOATS = "std_msgs/msg/Float64MultiArray"
GOAL = "control_msgs/action/FollowJointTrajectory"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
NODE = "/sst_simulator"
CONTROL = "/sst_inverse_dynamics"


def _points(numbers: str, seconds: int, joints: str) -> str:
    """Write a trajectory of one point as YAML."""
    time_from_start = f"time_from_start: {{sec: {seconds}}}"
    point = f"{{positions: [{numbers}], {time_from_start}}}"
    return f"{{joint_names: [{joints}], points: [{point}]}}"


JOINTS = "gamma_1, gamma_2, gamma_3"
NEAR = _points("0.8354, 0.8354, 0.8354", 2, JOINTS)
FAR = _points("1.6, 0.8, 0.8", 2, JOINTS)
PART = _points("0.80", 2, "gamma_2")


@dataclass(frozen=True)
class Row:
    """A command, what its output must have, and its exit status."""

    command: str
    expected: str
    status: int = 0
    ends_after: float | None = None
    """Seconds until Ctrl-C; None for a command that ends by itself."""


@dataclass(frozen=True)
class Session:
    """Commands that are typed one after the other."""

    rows: tuple[Row, ...]
    beside: tuple[str, ...] = ()
    """Nodes that run meanwhile."""
    ready: str = ""
    """A command that succeeds once the nodes are there."""
    files: dict[str, str] = field(default_factory=dict)


def _echo(topic: str, expected: str, options: str = "") -> Row:
    return Row(f"ros2 topic echo --once {options}{topic}", expected)


def _call(service: str, kind: str, expected: str, request: str = "") -> Row:
    words = f'ros2 service call {service} {kind} "{request}"' if request else ""
    return Row(words or f"ros2 service call {service} {kind}", expected)


SESSIONS = {
    "start": Session(
        (
            Row("ros2 pkg executables sst_ros", "sst_ros simulator"),
            Row("ros2 pkg prefix sst_ros", "sst_ros"),
            Row("ros2 pkg xml sst_ros -t license", "Apache-2.0"),
            Row(f"{CLI} scene list", "example2"),
            Row(f"{SIMULATOR} -p scene:=example1 -p duration:=0.6", "finished"),
            Row(f"{SIMULATOR} -p scene:=exampel1", "did you mean 'example1'", 1),
            Row(f"{SIMULATOR} -p rate:=-3", "must be a whole number from 1", 1),
            Row(f"{SIMULATOR} --log-level loud", "must be one of debug", 2),
            Row(f"{SIMULATOR} -p state_gamma:='[1.0, 2.0]'", "3 finite numbers", 1),
            Row(
                f"{SIMULATOR} --params-file given.yaml -r __node:=other",
                "finished",
            ),
            Row(
                "ros2 run sst_ros recorder --ros-args -p output:=idle_bag"
                """ -p 'topics:=["/joint_states"]'""",
                "is incomplete: no message of /joint_states",
                1,
                30.0,
            ),
        ),
        files={
            "given.yaml": "/**:\n  ros__parameters:\n    scene: swing\n"
            "    duration: 0.2\n    real_time_factor: 1.0\n"
        },
    ),
    "launch": Session(
        (
            Row(f"{LAUNCH} simulate.launch.py --show-args", "use_sim_time"),
            Row(f"{LAUNCH} simulate.launch.py scene:=example2 play:=true", "finished"),
            Row(f"{LAUNCH} simulate.launch.py scen:=swing", "did you mean 'scene'", 1),
            Row(
                f"{LAUNCH} simulate.launch.py params_file:=nowhere.yaml",
                "nowhere.yaml: no such file",
                1,
            ),
            Row(f"{LAUNCH} simulate.launch.py sync:=fre", "fre", 1),
            Row(
                f"{LAUNCH} feedforward.launch.py mode:=nosuch record:=false",
                "nosuch",
                1,
            ),
            Row(f"{LAUNCH} view.launch.py rviz:=true", "rviz2", 1),
            Row(f"{LAUNCH} two_robots.launch.xml", "right.sst_simulator", 0, 60.0),
            Row(f"{LAUNCH} two_nodes.launch.yaml", "sst_simulator", 0, 60.0),
        )
    ),
    "recorded": Session(
        (
            Row(
                f"{LAUNCH} simulate.launch.py scene:=friction play:=true"
                " record:=true bag:=sst output:=my_bag",
                "messages of",
            ),
            Row(f"{CLI} report run my_bag --out report_out", "report_out"),
            Row(f"{CLI} plot my_bag --out plots", "plots"),
            Row(f"{CLI} export my_bag --out tables", "tables"),
            Row(f"{CLI} recover my_bag --out whole_bag", "0 known to be lost"),
            Row(f"{CLI} report run nowhere", "does not exist", 1),
            Row(
                f"{LAUNCH} feedforward.launch.py mode:=computed_torque bag:=sst"
                " output:=ff_bag",
                "messages of",
            ),
            Row(f"{CLI} report run ff_bag --out ff_report", "tracking"),
        )
    ),
    "topics": Session(
        (
            Row("ros2 node list", NODE),
            Row(f"ros2 node info {NODE}", "std_srvs/srv/SetBool"),
            Row("ros2 topic list -t", f"{NODE}/commands [{FLOATS}]"),
            Row("ros2 topic info --verbose /joint_states", "Publisher count: 1"),
            Row(f"ros2 topic type {NODE}/imu", "sensor_msgs/msg/Imu"),
            _echo("/joint_states", "gamma_1"),
            _echo(f"{NODE}/orientation", "frame_id: base_link"),
            _echo("/diagnostics", "sst_simulator: run"),
            _echo(f"{NODE}/phase", "running"),
            _echo(
                f"{NODE}/phase",
                "running",
                "--qos-durability transient_local --qos-reliability reliable ",
            ),
            _echo(f"{NODE}/imu", "frame_id: imu_link"),
            _echo(f"{NODE}/reaction", "force:"),
            Row("ros2 topic hz --window 200 /joint_states", "average rate", 0, 40.0),
            Row(
                f'ros2 topic pub --once {NODE}/commands {FLOATS} "{{data: [0, 0, 0]}}"',
                "publishing #1",
            ),
            Row(
                f"ros2 topic pub --times 3 -w 1 {NODE}/commands {FLOATS}"
                ' "{data: [1]}"',
                "publishing #3",
            ),
            _echo("/diagnostics", "wrong size 3"),
        ),
        beside=(
            f"{SIMULATOR} -p scene:=gravity_payload -p duration:=0.0"
            " -p command_timeout:=0.0 -p imu:=true -p reaction:=prismatic_1",
        ),
        ready="ros2 topic echo --once /joint_states",
    ),
    "services": Session(
        (
            Row("ros2 service list -t", f"{NODE}/set_state [{TRIGGER}]"),
            Row(f"ros2 param list {NODE}", "state_gamma"),
            Row(f"ros2 param get {NODE} scene", "gravity_payload"),
            Row(f"ros2 param describe {NODE} wait_for_subscribers", "string array"),
            Row(f"ros2 param set {NODE} real_time_factor 0.5", "successful"),
            Row(f"ros2 param set {NODE} real_time_factor 5000.0", "out of range"),
            Row(f"ros2 param set {NODE} scene swing", "read-only"),
            Row(f"ros2 param dump {NODE}", "ros__parameters"),
            _call(f"{NODE}/step", TRIGGER, "refused: only a paused run"),
            _call(f"{NODE}/set_state", TRIGGER, "success=False"),
            _call(
                f"{NODE}/pause", "std_srvs/srv/SetBool", "success=True", "{data: true}"
            ),
            _call(f"{NODE}/step", TRIGGER, "success=True"),
            Row(f'ros2 param set {NODE} state_gamma "[0.7, 0.7, 0.7]"', "successful"),
            _call(f"{NODE}/set_state", TRIGGER, "success=True"),
            _call(
                f"{NODE}/get_entity_state",
                "simulation_interfaces/srv/GetEntityState",
                "base_link",
                "{entity: star}",
            ),
            Row(
                f"ros2 action send_goal --feedback {NODE}/simulate_steps"
                ' simulation_interfaces/action/SimulateSteps "{steps: 3}"',
                "SUCCEEDED",
            ),
            _call(f"{NODE}/reset", TRIGGER, "success=True"),
        ),
        beside=(
            f"{SIMULATOR} -p scene:=gravity_payload -p duration:=0.0"
            " -p external_moment:=true",
        ),
        ready="ros2 topic echo --once /joint_states",
    ),
    "control": Session(
        (
            Row("ros2 action list -t", GOAL),
            Row(f"ros2 action info {CONTROL}/follow_joint_trajectory", "servers: 1"),
            Row(
                f"ros2 action send_goal --feedback {CONTROL}/follow_joint_trajectory"
                f' {GOAL} "{{trajectory: {NEAR}}}"',
                "SUCCEEDED",
            ),
            Row(
                f"ros2 action send_goal {CONTROL}/follow_joint_trajectory"
                f' {GOAL} "{{trajectory: {PART}}}"',
                "SUCCEEDED",
            ),
            Row(
                f"ros2 action send_goal {CONTROL}/follow_joint_trajectory"
                f' {GOAL} "{{trajectory: {FAR}}}"',
                "rejected",
            ),
            Row(
                f"ros2 topic pub --rate 10 --times 10 {CONTROL}/joint_trajectory"
                f' {TRAJECTORY} "{NEAR}"',
                "publishing #10",
            ),
            _echo(f"{CONTROL}/tracking_error", "gamma_1"),
            Row(f"ros2 param set {CONTROL} bandwidth 40.0", "successful"),
            Row(f"ros2 param set {CONTROL} integral_rate 500.0", "unstable"),
        ),
        beside=(
            f"{SIMULATOR} -p scene:=reach -p duration:=0.0 -p wait_for_command:=true",
            f"{CONTROLLER} -p scene:=reach -p mode:=computed_torque -p motion:=topic"
            " -p allow_partial_joints_goal:=true",
        ),
        ready="ros2 action list | grep follow_joint_trajectory",
    ),
    "ros2_control": Session(
        (
            Row("ros2 control list_controllers", "effort_controller"),
            Row("ros2 control list_hardware_components", "active"),
            Row("ros2 control list_hardware_interfaces", "gamma_1/effort"),
        ),
        beside=(
            f"{LAUNCH} ros2_control.launch.py scene:=example2"
            " controller:=effort_controller sync:=lockstep",
        ),
        ready="ros2 control list_controllers",
    ),
}


@contextmanager
def _running(command: str, folder: Path) -> Iterator[None]:
    """Run a node beside; Ctrl-C ends it."""
    process = _start(command, folder)
    try:
        yield
    finally:
        _end(process)


def _start(command: str, folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        ["bash", "-c", command],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # Ctrl-C reaches all of its processes
    )


def _end(process: subprocess.Popen[str]) -> str:
    """Send Ctrl-C, and SIGKILL where that does not help; return what it printed."""
    for number in (signal.SIGINT, signal.SIGKILL):
        if process.poll() is None:
            os.killpg(process.pid, number)
        try:
            return process.communicate(timeout=60.0)[0]
        except subprocess.TimeoutExpired:
            continue
    return ""


def try_row(row: Row, folder: Path) -> tuple[str, str, bool]:
    """Type a command; return a line of its output, its status, and if both are right.

    Ctrl-C may give the status 2 or 130 for 0: which of them is up to ros2cli.
    """
    process = _start(row.command, folder)
    try:
        output = process.communicate(timeout=row.ends_after or LONGEST_S)[0]
    except subprocess.TimeoutExpired:
        output = _end(process)
    status = process.returncode
    is_right = status == row.status
    told = str(status)
    if row.ends_after is not None:
        is_right = is_right or (row.status == 0 and status in _INTERRUPTED)
        told = f"Ctrl-C, {status}"
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    has_words = [line for line in lines if row.expected in line]
    shown = (has_words or lines[-1:] or [""])[0]
    return shown, told, is_right and bool(has_words)


def try_session(session: Session, domain: int) -> Iterator[tuple[Row, str, str, bool]]:
    """Yield each row of a session with what `try_row` says of it."""
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for name, text in session.files.items():
            (folder / name).write_text(text, encoding="utf-8")
        for command in session.beside:
            stack.enter_context(_running(command, folder))
        deadline = time.monotonic() + LONGEST_S
        while session.ready and time.monotonic() < deadline:
            _, status, _ = try_row(Row(session.ready, ""), folder)
            if status == "0":
                break
        for row in session.rows:
            yield row, *try_row(row, folder)


def main() -> None:
    """Print the table of the sessions that the command line names, or of all."""
    names = sys.argv[1:] or list(SESSIONS)
    print("| | command | expected | seen | exit status | as expected |")
    print("| --- | --- | --- | --- | --- | --- |")
    number = wrong = 0
    for place, name in enumerate(names):
        for row, shown, status, is_right in try_session(
            SESSIONS[name], FIRST_DOMAIN + place
        ):
            number += 1
            wrong += not is_right
            cells = [row.command, row.expected, shown[:WIDEST]]
            code = " | ".join(f"`{cell}`" for cell in cells).replace("``", "")
            verdict = "yes" if is_right else "**no**"
            print(f"| {number} | {code} | {status} | {verdict} |", flush=True)
    print(f"\n{number - wrong} of {number} as expected", file=sys.stderr)
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
