# SPDX-License-Identifier: Apache-2.0
"""Command lines, warnings of the graph, signals, and ends of real nodes."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest
from programs import python
from rcl_interfaces.srv import GetParameters
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros.conftest import COMMANDS, NODE
from std_msgs.msg import Float64MultiArray, String

import sst_ros
from sst_ros.runtime.settings import NODE_COMMANDS as NODES

pytestmark = pytest.mark.ros


@pytest.mark.parametrize("command", NODES)
def test_help_starts_nothing(run_here, command):
    status, out, _ = run_here(command, "--help")
    assert status == 0 and f"usage: {command}" in out and "default:" in out


@pytest.mark.parametrize(
    ("words", "refused", "said"),
    [
        ("--scen friction", 2, "did you mean '--scene'?"),
        ("--ros-args --params-file {path}", 1, "did you mean 'scene'?"),
        ("--ros-args --params-file nowhere.yaml", 2, "nowhere.yaml"),
        ("--ros-args --bogus", 2, "--bogus"),
    ],
)
def test_unknown_arguments_are_refused(run_here, tmp_path, words, refused, said):
    path = tmp_path / "file.yaml"
    path.write_text("/**: {ros__parameters: {sceen: friction, csv: foreign}}\n")
    status, _, err = run_here("simulator", *words.format(path=path).split())
    assert status == refused and said in err and "csv = " not in err


def test_plain_options_are_parameters_and_a_run_has_no_end(nodes, observer):
    scene = observer.listen(String, f"{NODE}/scene", latched=True)
    words = ["--scene", "fast_spin", "--wait-for-subscribers", "/diagnostics,~/scene"]
    process = nodes.start("simulator", *words)
    observer.until(lambda: scene, "the scene")
    assert "name: fast_spin" in scene[0].data
    # The scene has a duration of 0.2 s.
    said = observer.told("simulated_time_s", lambda seconds: float(seconds) > 1.0)
    assert said["phase"] == "running" and nodes.stop(process)[0] == 0


def test_in_lockstep_the_duration_is_that_of_the_scene(nodes, observer):
    nodes.start("simulator", "--scene", "fast_spin", "--sync", "lockstep")
    reply = observer.call(GetParameters, f"{NODE}/get_parameters", names=["duration"])
    assert reply.values[0].double_value == 0.2


@pytest.mark.parametrize(
    ("topics", "said"),
    [
        ("[joint_states]", "no subscriber of /joint_states within 0.5 s"),
        ("[elsewhere]", "must be topics that the node publishes: "),
    ],
)
def test_a_run_that_nobody_records_ends(nodes, topics, said):
    process = nodes.run(
        "simulator", wait_for_subscribers=topics, subscriber_timeout=0.5
    )
    status, _, err = nodes.ended(process)
    assert status == 1
    assert said in err.splitlines()[-1]


def test_what_keeps_commands_and_clocks_away_is_named(nodes, observer):
    process = nodes.run("simulator", use_sim_time=True)
    qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    observer.node.create_publisher(Float64MultiArray, COMMANDS, qos)
    other = nodes.run("simulator")
    wanted = (
        "of /observer is best effort",
        "there is no /clock",
        "another node is named",
    )
    for words in wanted:
        observer.until(
            lambda words=words: any(
                words in one["said"] for one in observer.diagnostics()
            ),
            words,
        )
    assert nodes.stop(other)[0] == 0
    status, _, err = nodes.stop(process)
    assert status == 0 and all(words in err for words in wanted)


def handles_signals(process):
    """Whether the node has taken over SIGTERM: what the interpreter does before is not
    ours.
    """
    status = Path(f"/proc/{process.pid}/status").read_text()
    caught = next(
        line.split()[1] for line in status.splitlines() if line.startswith("SigCgt")
    )
    return int(caught, 16) >> (signal.SIGTERM - 1) & 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_a_node_starts_makes_no_traceback(nodes, observer, number):
    """See `starts` of benchmark/campaign/nodes.py for other moments of the start."""
    process = nodes.start("simulator", "--duration", "0")
    observer.until(lambda: handles_signals(process), "signal handler")
    time.sleep(0.2)  # it is in the middle of its start
    assert nodes.stop(process, number)[0] == 0


@pytest.mark.parametrize("delay", [0.02, 0.1])
def test_ctrl_c_while_python_starts_a_node_of_ros2_run_ends_it(nodes, delay):
    """Its executable blocks SIGINT until the node handles it: Python would print a
    traceback.
    """
    root = Path(sst_ros.__file__).parents[1]
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    process = nodes.start(
        "", executable=[str(root / "executables" / "simulator")],
        env={"PATH": path, "PYTHONPATH": str(root)},
    )  # fmt: skip
    time.sleep(delay)  # the moment of the start is what is varied
    status, _, err = nodes.stop(process)
    # Before `env` has blocked it, the signal ends the process without a word.
    assert status in (0, -signal.SIGINT) and err == ""


LATE = """
import os, signal, sys
from sst_ros.nodes.process import run
status = run(['simulator', '--ros-args', '-p', 'duration:=0.01'])
class Late:
    def __del__(self, kill=os.kill, own=os.getpid(), number=signal.SIGINT):
        kill(own, number)
sys.late = Late()  # deleted after the handlers of Python have gone
sys.exit(status)
"""


def test_a_signal_while_python_exits_changes_nothing(domain):
    assert "Traceback" not in python(LATE).stderr


def test_signals_are_handled_before_what_takes_time_to_import():
    code = (
        "import sys; before = set(sys.modules); from sst_ros.nodes import signals; "
        "print(*sorted(set(sys.modules) - before))"
    )
    root = Path(sst_ros.__file__).parents[1]
    # -S: the site of an installation imports a lot.
    out = python("-S", "-c", code, cwd=root).stdout
    assert "sst_ros.nodes.signals" in out.split()
    assert not {"typing", "pathlib", "subprocess", "numpy", "rclpy"} & set(out.split())


def test_a_node_under_nohup_keeps_it():
    code = (
        "import signal as s; s.signal(s.SIGHUP, s.SIG_IGN); from sst_ros.nodes import"
        " signals; "
    )
    python(f"{code}signals.handle(); assert s.getsignal(s.SIGHUP) is s.SIG_IGN")


AMID = """
import signal, sys
from sst_ros.nodes import signals

def again(*_):
    "A second signal wherever the handler of the first is."
    if numbers:
        signal.raise_signal(numbers.pop())

numbers = [signal.SIGTERM, signal.SIGINT] * 20
signals.handle()
sys.setprofile(again)
signal.raise_signal(signal.SIGINT)
sys.setprofile(None)
print(bool(signals.came))
"""


def test_a_signal_to_the_tests_ends_no_later_node(run_here):
    usual = signal.getsignal(signal.SIGINT)

    def interrupt_the_node():
        handler = usual
        deadline = time.monotonic() + 60.0
        while handler is usual or not callable(handler):
            assert time.monotonic() < deadline
            time.sleep(0.001)
            handler = signal.getsignal(signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    sender = threading.Thread(target=interrupt_the_node)
    sender.start()
    with pytest.raises(KeyboardInterrupt):
        run_here("torque_player", timeout=60.0)
    sender.join()
    status, _, err = run_here("simulator", rate=300)
    assert status == 1 and "must divide 1e9" in err


def test_a_signal_within_the_handler_of_another_does_not_block():
    assert python(AMID, timeout=30).stdout == "True\n"


BESIDE_A_COMPILATION = """if True:
    import signal, sys, threading, time
    from sst_ros.nodes import process, signals
    from sst_ros.programs import llvm

    def compile_for_ever():
        with llvm._ENGINE_LOCK:
            begun.set()
            time.sleep(3600.0)

    begun = threading.Event()
    threading.Thread(target=compile_for_ever, daemon=True).start()
    begun.wait()
    signals.came.add(signal.SIGTERM)
    print("last words", end="")
    sys.exit(process.run(["simulator"]))
    """


def test_a_node_that_ends_does_not_wait_for_a_compilation():
    assert python(BESIDE_A_COMPILATION).stdout == "last words"
