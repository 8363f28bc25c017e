# SPDX-License-Identifier: Apache-2.0
"""The command board: what is used, dropped, clamped and let go of."""

import math
import time

import pytest
from runtime.bench import Arrived, Message, plain, stamped

from sst_ros import load_scene
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.runtime.torque_input import MessageRefused, TorqueInput, by_name
from sst_ros.scene.loads import Actuators
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import ZERO

NAN = math.nan


class Bench:
    """A board of commands that are not let go of, unless that is asked for."""

    def __init__(self, actuators=None, commands=(), **given):
        self.commands = Arrived(map(plain, commands))
        self.stamped, self.moments = Arrived(), Arrived()
        run = SimulatorParameters(**{"command_timeout": 0.0, **given}).run
        self.board = TorqueInput(
            run, actuators, self.commands, self.stamped, self.moments
        )
        self.moving = Simulation(load_scene("example1"))

    def torque(self, *commands):
        """Give commands; return the torque that then acts."""
        self.commands += map(plain, commands)
        return self.board.torque(self.moving, time.monotonic_ns())


def test_the_last_good_command_is_held():
    """What comes while the node starts is not lost.

    With a timeout of zero it holds for ever.
    """
    bench = Bench(commands=[(1.0, 2.0, 3.0), (1.0,)])
    assert bench.board.starts_run()
    assert (bench.board.received, bench.board.dropped) == (1, 1)
    assert bench.torque((NAN, 0, 0), [0] * 4) == (1.0, 2.0, 3.0)
    assert (bench.board.received, bench.board.dropped) == (1, 3)
    assert bench.board.reasons == {"not finite": 1, "wrong size": 2}
    assert "must be 3 finite torques [N m]" in bench.board.last_refusal
    bench.board._since -= 10**15
    assert bench.torque() == (1.0, 2.0, 3.0)


def test_a_command_acts_from_the_tick_after_its_arrival():
    """Of ticks that are done together the first may lie before the arrival."""
    bench = Bench(command_timeout=0.5)
    bench.commands.append(plain((1.0, 2.0, 3.0)))
    bench.commands.arrived_ns = now = time.monotonic_ns()
    assert bench.board.torque(bench.moving, now - 1) == ZERO
    assert not bench.board.constant(now + 1)
    assert bench.board.torque(bench.moving, now + 1) == (1.0, 2.0, 3.0)
    assert bench.board.constant(now + 500_000_001)
    assert not bench.board.constant(now + 500_000_002)  # too old from there on
    assert bench.board.torque(bench.moving, now + 500_000_002) == ZERO
    assert bench.board.constant(now + 600_000_000)


@pytest.mark.parametrize(
    ("names", "effort", "kind"),
    [
        (["gamma_1", "gamma_2"], [1, 2], "wrong names"),
        (["gamma_1", "gamma_2", "elbow"], [1, 2, 3], "wrong names"),
        (["gamma_1", "gamma_2", "gamma_2"], [1, 2, 3], "wrong names"),
        ([], [], "wrong names"),
        (["gamma_1", "gamma_2", "gamma_3"], [1, 2], "wrong size"),
        (["gamma_1", "gamma_2", "gamma_3"], [1, 2, math.inf], "not finite"),
    ],
)
def test_wrong_names_sizes_and_values_are_refused(names, effort, kind):
    with pytest.raises(MessageRefused) as caught:
        by_name(names, effort, "torques [N m] in effort")
    assert caught.value.kind == kind


def test_a_stale_command_is_let_go_of_and_a_fresh_one_held_again():
    bench = Bench(command_timeout=100.0)
    assert bench.torque((1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)
    bench.board._since -= 10**12
    assert bench.torque() == ZERO and bench.torque() == ZERO
    assert (bench.board.timeouts, bench.board.stale) == (1, True)
    bench.board.refresh()
    assert bench.torque() == (1.0, 2.0, 3.0)
    assert bench.torque((0.0, 0.0, 1.0)) == (0.0, 0.0, 1.0) and not bench.board.stale


def test_limits_clamp_count_and_hold_for_the_damping_after():
    bench = Bench(Actuators(torque_limit=0.5, idle_damping=2.0), command_timeout=100.0)
    assert bench.torque((0.1, -5.0, 0.6)) == (0.1, -0.5, 0.5)
    assert bench.board.clamped == 1 and bench.board.constant(time.monotonic_ns())
    bench.board._since -= 10**12
    rates = bench.moving.state.joints.gamma_dot
    expected = tuple(min(max(-2.0 * rate, -0.5), 0.5) for rate in rates)
    assert any(rates) and bench.torque() == expected
    assert not bench.board.constant(time.monotonic_ns())  # it depends on the rates


def test_a_flood_is_taken_in_turns():
    bench = Bench()
    assert bench.torque(*((float(k), 0.0, 0.0) for k in range(1000))) == (
        49.0,
        0.0,
        0.0,
    )
    assert len(bench.commands) == 950


def test_lockstep_wants_the_stamp():
    bench = Bench(sync="lockstep")
    bench.commands.append(plain((9.0, 9.0, 9.0)))
    bench.stamped += [stamped(0, [7, 7, 7]), stamped(4, [8, 8, 8])]
    assert bench.board.answer(5) is None
    assert bench.board.reasons == {"no stamp": 1, "stamp": 1}
    bench.stamped += [stamped(5, [1, 2, 3]), stamped(5, [4, 5, 6])]
    assert bench.board.answer(5) == (1.0, 2.0, 3.0)  # the first answer counts
    assert bench.board.reasons["stamp"] == 2


def test_clear_forgets_what_has_arrived():
    bench = Bench(commands=[(1.0, 2.0, 3.0)])
    bench.board.clear()
    assert bench.torque() == ZERO and not bench.board.begun


def wrench(x, frame_id=""):
    header = Message(frame_id=frame_id)
    return Message(header=header, wrench=Message(torque=Message(x=x, y=0.0, z=0.0)))


def test_moments_are_checked_and_let_go_of():
    bench = Bench(command_timeout=0.5)
    bench.moments += [wrench(1.5), wrench(NAN)]
    bench.torque()
    assert bench.board.moment == (1.5, 0.0, 0.0)
    assert bench.board.reasons == {"not finite": 1}
    bench.board._moment_since -= 10**9
    bench.torque()
    assert bench.board.moment == ZERO


def test_an_effort_that_is_no_number_is_no_command_when_asked():
    """As joint_state_topic_hardware_interface of ros2_control sends it, with a stamp of
    its own.
    """
    bench = Bench(partial_commands=True)
    bench.stamped += [stamped(5, [NAN] * 3)]
    assert not bench.board.starts_run()
    bench.stamped += [
        stamped(7, [3.0, NAN, 1.0], names=["gamma_3", "gamma_2", "gamma_1"])
    ]
    assert bench.torque() == (1.0, 0.0, 3.0)
    bench.stamped += [
        stamped(8, [NAN] * 3),
        stamped(9, [math.inf, NAN, 0.0]),
        stamped(9, [NAN]),
    ]
    assert bench.torque() == (1.0, 0.0, 3.0)
    assert (bench.board.received, bench.board.reasons) == (1, {"not finite": 1})
    plain = Bench()
    plain.stamped += [stamped(7, [NAN, 0.0, 1.0])]
    assert plain.torque() == ZERO and plain.board.reasons == {"not finite": 1}


@pytest.mark.parametrize(
    ("frame_id", "used"),
    [
        ("", True),
        ("base_link", False),
        ("left/base_link", True),
        ("star", False),
        ("world", False),
    ],
)
def test_a_moment_in_another_frame_than_the_base_is_refused(frame_id, used):
    bench = Bench(base_frame="left/base_link")
    bench.moments += [wrench(1.5, frame_id)]
    bench.torque()
    if used:
        assert bench.board.moment == (1.5, 0.0, 0.0) and not bench.board.reasons
    else:
        assert bench.board.moment == ZERO and bench.board.reasons == {"frame": 1}
        reason = f"frame_id {frame_id!r}, must be 'left/base_link' or empty"
        assert reason in bench.board.last_refusal


def test_a_refusal_says_how_long_a_list_was():
    bench = Bench()
    bench.torque([1.0] * 20_000)
    said = (
        "[1.0, 1.0, 1.0, 1.0, 1.0, 1.0, ...] (20000 in all) must be 3 finite torques"
        " [N m]"
    )
    assert bench.board.last_refusal == said
    bench.torque([1.0] * 6)
    assert bench.board.last_refusal.startswith(
        "[1.0, 1.0, 1.0, 1.0, 1.0, 1.0] must be 3"
    )
    with pytest.raises(
        MessageRefused, match=r"names \['a', .*\] \(7 in all\) must be gamma_1"
    ):
        by_name(["a"] * 7, [0.0] * 7, "torques [N m] in effort")
