# SPDX-License-Identifier: Apache-2.0
"""The controller without its node: when it begins, goes on, ends, and what it refuses.

Goals.
"""

import contextlib
import dataclasses
import math
import multiprocessing
import os
import pickle
import signal
import struct
import time
import tracemalloc

import numpy as np
import pytest
from runtime.bench import Message, duration
from slow_cases import slow_except

from sst_ros.control.controller import SETTLING_BAND, ControlStopped, Measurement
from sst_ros.control.reference_motions import reference_motion
from sst_ros.errors import InputError, SstError
from sst_ros.runtime import assistant as assistant_process
from sst_ros.runtime import trajectory_following
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.runtime.trajectory_following import Stage, TrajectoryFollower
from sst_ros.runtime.trajectory_messages import ErrorCode, TrajectoryGoal
from sst_ros.scene import scene
from sst_ros.scene.loads import Actuators, DesiredMotion, Initial, Spiral, ToAngles
from sst_ros.simulation.simulation import Simulation

PERIOD_NS = 2_000_000
REST = (0.0, 0.0, 0.0)
START_NS = 1_700_000_000_123_456_789
MOVE = DesiredMotion(spiral=Spiral(phi=0.02, theta=0.5, psi=0.03, duration=0.05))
MODEL = dataclasses.replace(scene.load("example2_heavy"), motion=MOVE, torque=None)

HERE = Measurement(MODEL.initial.gamma, REST)
NAMES = ("gamma_1", "gamma_2", "gamma_3")


def seen(state):
    return Measurement(state.joints.gamma, state.joints.gamma_dot)


def follow(**settings):
    return TrajectoryFollower(MODEL, ControllerNodeParameters(**settings))


def answers(follower, samples, measured=HERE):
    """What is answered to samples of these numbers, where the manipulator does not
    move.
    """
    return [follower.answer(START_NS + k * PERIOD_NS, measured) for k in samples]


def closed_loop(follower, at=lambda k: None):
    """Commands, and the stage at each; the state at the end."""
    simulation, told = Simulation(MODEL), []
    for k in range(40):
        at(k)
        command = follower.answer(START_NS + k * PERIOD_NS, seen(simulation.state))
        if command is None:
            break
        told.append((command, follower.stage))
        simulation.step(command.torque, PERIOD_NS)
    return *zip(*told, strict=True), simulation.state


def test_it_follows_holds_and_ends_with_zero_torque():
    follower = follow(hold=0.01, feedforward_at="middle")
    assert follower.stage is Stage.READY and follower.tracking() is None
    first = follower.preview(seen(Simulation(MODEL).state))
    commands, stages, _ = closed_loop(follower)
    assert commands[0].torque == first.torque
    assert stages == (Stage.FOLLOWING,) * 25 + (Stage.HOLDING,) * 5 + (Stage.ENDED,)
    assert commands[-1].torque == REST and follower.samples == 31
    judged = follower.tracking()
    assert (
        judged.samples == 31
        and judged.largest.max() < 0.01 * judged.band / SETTLING_BAND
    )
    rms, largest = follower.errors
    assert largest == judged.largest.max()
    assert rms == pytest.approx(np.sqrt(np.mean(judged.rms**2)))


def test_samples_that_come_twice_or_late_are_told_apart():
    follower = follow()
    told = answers(follower, (1, 2, 2, 1, 5))
    assert [one is not None for one in told] == [True, True, False, False, True]
    assert (follower.samples, follower.irregular) == (3, 1)


@pytest.mark.slow
def test_a_long_motion_keeps_no_more_than_a_short_one():
    follower = follow(hold=1e6)
    answers(follower, range(600))
    tracemalloc.start()
    for k in range(600, 1200):
        answers(follower, [k])
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 70_000  # 600 rows of a record are 91 000
    assert follower.tracking().samples == 1200


def test_a_reset_of_the_simulator_begins_the_motion_anew():
    follower = follow(mode="pd", integral_rate=1.0)
    here = Measurement(tuple(np.add(MODEL.initial.gamma, 0.01)), REST)
    told = answers(follower, range(5), here)
    follower.restart()
    assert follower.stage is Stage.READY and follower.tracking() is None
    follower.stop()  # before a run: the scene's own motion stays
    assert follower.stage is Stage.READY
    again = answers(follower, range(100, 105), here)
    assert [one.torque for one in again] == [one.torque for one in told]


@pytest.mark.parametrize(
    ("model", "settings", "reason"),
    [
        ({"motion": None}, {}, "motion"),
        ({"motion": DesiredMotion(
            to_angles=ToAngles(gamma=(1.7, 0.8, 0.8), duration=1.0))}, {}, "gamma_1"),
        ({"motion": DesiredMotion(
            to_angles=ToAngles(gamma=(0.35, 0.3, 1.35), duration=1.0))}, {}, "beta_"),
        ({"actuators": Actuators(torque_limit=0.5)}, {}, "exceeds the limit 0.5 N m"),
        ({"actuators": Actuators(torque_limit=50.0)}, {"torque_limit": 0.5},
         "limit 0.5 N m"),
        ({"actuators": Actuators(torque_limit=0.5)}, {"torque_limit": 50.0},
         "limit 0.5 N m"),
        ({}, {"integral_rate": 100.0, "mode": "pd"}, "integral_rate"),
        ({}, {"mode": "pid"}, "mode"),
        ({}, {"stiffness": (1.0, np.nan, 1.0)}, "stiffness"),
        ({}, {"rate": 7}, "rate"),
        ({}, {"mode": "computed_torque", "space": "so3", "stiffness": (1.0,) * 3},
         "stiffness"),
        ({}, {"damping": (1.0, 1.0, 1.0), "integral_rate": 1.0}, "integral_rate"),
    ],
)  # fmt: skip
def test_what_cannot_be_followed_is_refused_at_the_start(model, settings, reason):
    with pytest.raises(SstError, match=reason):
        TrajectoryFollower(
            dataclasses.replace(MODEL, **model), ControllerNodeParameters(**settings)
        )


def test_a_trajectory_beside_the_motion_of_the_scene_is_refused():
    with pytest.raises(InputError, match="must be topic"):
        follow().take(None, None)


def test_it_begins_only_near_the_start_of_the_motion():
    gamma = tuple(np.add(MODEL.initial.gamma, (0.0, 0.06, 0.0)))
    off = seen(
        Simulation(dataclasses.replace(MODEL, initial=Initial(gamma=gamma))).state
    )
    assert follow(start_tolerance=0.07).answer(START_NS, off) is not None
    for ask in (lambda p: p.preview(off), lambda p: p.answer(START_NS, off)):
        with pytest.raises(InputError, match="where the motion begins"):
            ask(follow())


def test_what_is_not_finite_is_nowhere_near():
    follower = follow()
    with pytest.raises(InputError, match="where the motion begins"):
        follower.preview(HERE._replace(gamma=(np.nan,) * 3))
    answers(follower, [0])
    with pytest.raises(ControlStopped, match="must be finite"):
        answers(follower, [1], HERE._replace(gamma_dot=(np.nan,) * 3))


def test_a_stop_comes_to_rest_on_the_path_and_holds():
    follower = follow(mode="computed_torque", stop_time=0.02, hold=1.0)
    commands, stages, state = closed_loop(
        follower, lambda k: k == 10 and follower.stop()
    )
    references = [command.desired for command in commands]
    path, rest = reference_motion(MODEL), references[-1]
    assert references[9] == path.at(0.018)
    assert rest.gamma == pytest.approx(path.at(0.028).gamma, abs=1e-15)
    assert rest.gamma_dot == REST
    rates = np.array([one.gamma_dot for one in references[9:]])
    # without a jump
    assert (np.abs(np.diff(rates[:, 2])) < 0.2 * abs(rates[0, 2])).all()
    assert np.array(state.joints.gamma) == pytest.approx(rest.gamma, abs=1e-4)
    assert len(references) == 40 and stages[-1] is Stage.HOLDING


class Assistant:
    """Checks at once, and has the result when it was asked for so many times."""

    def __init__(self, function):
        self.function, self.takes, self.calls, self.left = function, 0, 0, 0

    def call(self, *given):
        self.given, self.left, self.calls = given, self.takes, self.calls + 1

    def result(self):
        if self.left:
            self.left -= 1
            return None
        try:
            return self.function(*self.given)
        except SstError as error:
            return error

    def close(self):
        pass


class Stream:
    """A run on trajectories, sample by sample, measured where it is desired."""

    def __init__(self, monkeypatch, takes, **settings):
        monkeypatch.setattr(trajectory_following, "Assistant", Assistant)
        self.follower = TrajectoryFollower(
            dataclasses.replace(MODEL, motion=None),
            ControllerNodeParameters(motion="topic", **settings),
        )
        self.measured, self.references, self.stamp_ns = HERE, [], START_NS
        self.commands = []
        self.assistant = self.follower._assistant
        if self.assistant is not None:
            self.assistant.takes = takes

    def send(self, time, off, stamp_ns=0):
        """A point at a time [s], so far [rad] from where the run begins."""
        return self.send_points((time, off), stamp_ns=stamp_ns)

    def send_points(self, *points, names=NAMES, stamp_ns=0):
        """Points of time, distances by joint, efforts if any."""
        start = dict(zip(NAMES, HERE.gamma, strict=True))
        rows = [
            Message(
                positions=[start[name] + x for name, x in zip(names, off, strict=True)],
                velocities=[], accelerations=[], effort=list(*effort),
                time_from_start=duration(time * 1e9),
            )
            for time, off, *effort in points
        ]  # fmt: skip
        header = Message(stamp=duration(stamp_ns))
        given = Message(header=header, joint_names=list(names), points=rows)
        return self.follower.take(given, self.measured, self.stamp_ns - PERIOD_NS)

    def samples(self, count):
        for _ in range(count):
            if command := self.follower.answer(self.stamp_ns, self.measured):
                self.commands.append(command)
                desired = command.desired
                self.measured = Measurement(desired.gamma, desired.gamma_dot)
                self.references.append(desired)
            self.follower.proceed()
            self.stamp_ns += PERIOD_NS

    def jumps(self):
        """Largest steps of position, velocity and acceleration beside what the others
        explain.
        """
        names = "gamma", "gamma_dot", "gamma_ddot"
        p, v, a = (
            np.array([getattr(one, name) for one in self.references]) for name in names
        )
        dt = 1e-9 * PERIOD_NS
        mean = 0.5 * (v[1:] + v[:-1]) - dt / 12.0 * np.diff(a, axis=0)
        off = (
            np.diff(p, axis=0) - dt * mean,
            np.diff(v, axis=0) - 0.5 * dt * (a[1:] + a[:-1]),
        )
        return [float(np.abs(one).max()) for one in (*off, np.diff(a, axis=0))]


@pytest.mark.parametrize("takes", [0, 3, 40], ids=lambda takes: f"{takes} samples")
@pytest.mark.parametrize("every", slow_except([50, 167], [10, 50, 167]))
def test_a_stream_is_followed_without_a_jump_despite_long_checks(
    monkeypatch, takes, every
):
    stream, orders = Stream(monkeypatch, takes, mode="computed_torque"), []
    for k in range(1000 // every):
        off = 0.1 * np.sin(0.02 * every * k) * np.array([1.0, -0.5, 0.0])
        orders.append(stream.send(0.5, off))
        stream.samples(every)
    stream.samples(500)
    assert stream.follower.irregular == 0 and stream.follower.stage is Stage.HOLDING
    assert (
        np.abs(np.subtract(stream.references[-1].gamma, HERE.gamma) - off).max() < 1e-12
    )
    # Of a quintic of 0.5 s the jerk is below 60 * 0.2 / 0.5^3 = 96 rad/s^3, its change
    # in 2 ms 0.2.
    position, velocity, acceleration = stream.jumps()
    assert position < 1e-9 and velocity < 1e-6 and acceleration < 0.25
    taken = [
        order for order in orders if not order.outcome.cancelled()
    ]  # by a newer one
    assert not any(order.outcome.exception() for order in taken)
    assert len(taken) >= (len(orders) if takes < every else len(orders) // 9)


@pytest.mark.parametrize("stamped", [True, False])
def test_joints_that_a_trajectory_leaves_out_hold_their_position(monkeypatch, stamped):
    given = {"stamped": stamped, "mode": "pd"}
    stream = Stream(monkeypatch, 0, allow_partial_joints_goal=True, **given)
    stream.send_points((0.2, (0.1, -0.05)), names=("gamma_3", "gamma_1"))
    stream.samples(150)
    at = np.subtract([one.gamma for one in stream.references], HERE.gamma)
    np.testing.assert_allclose(at[-1], (-0.05, 0.0, 0.1), atol=1e-12)
    assert np.abs(at[:, 1]).max() < 1e-12
    stream.send_points((0.2, (0.04,)), names=("gamma_2",))  # from where they are now
    stream.samples(150)
    end = np.subtract(stream.references[-1].gamma, HERE.gamma)
    np.testing.assert_allclose(end, (-0.05, 0.04, 0.1), atol=1e-12)
    header = Message(stamp=duration(0))
    for names in ([], ["gamma_1", "gamma_1"], ["gamma_1", "wrist"]):
        message = Message(header=header, joint_names=names, points=[])
        with pytest.raises(InputError, match="must be some of gamma_1, gamma_2, gamma"):
            stream.follower.take(message, HERE)
    assert stream.follower.stage is Stage.HOLDING


def test_some_joints_are_refused_where_that_is_not_allowed(monkeypatch):
    stream = Stream(monkeypatch, 0)
    with pytest.raises(InputError, match="allow_partial_joints_goal true"):
        stream.send_points((0.2, (0.1,)), names=("gamma_3",))


@pytest.mark.parametrize("mode", ["feedforward", "pd", "gravity_pd", "computed_torque"])
def test_efforts_are_added_to_the_torque_linearly_in_time(monkeypatch, mode):
    """The same motion without them gives the torque that they are added to."""
    added = [(1.0, -0.5, 0.2), (0.6, 0.0, 0.2)]
    torques = []
    for efforts in (added, [[], []]):
        stream = Stream(monkeypatch, 0, stamped=True, mode=mode, bandwidth=20.0)
        offs = (0.02, 0.01, 0.0), (0.04, 0.0, 0.01)
        stream.send_points(*zip((0.1, 0.3), offs, efforts, strict=True))
        stream.samples(201)
        torques.append(np.array([one.torque for one in stream.commands]))
        assert stream.commands[0].torque == tuple(
            np.add(stream.commands[0].feedforward, stream.commands[0].feedback)
        )
    times = 1e-9 * PERIOD_NS * np.arange(201)
    rows = np.array([(0.0, 0.0, 0.0), *added])  # from zero, and held at the end
    expected = [np.interp(times, (0.0, 0.1, 0.3), column) for column in rows.T]
    np.testing.assert_allclose(
        torques[0] - torques[1], np.transpose(expected), atol=1e-9
    )


def test_efforts_go_on_from_those_of_the_trajectory_before(monkeypatch):
    stream = Stream(monkeypatch, 0, stamped=True, mode="pd")
    stream.send_points((0.1, (0.0,) * 3, (1.0, 0.0, 0.0)))
    stream.samples(26)  # half of it is there
    stream.send_points((0.2, (0.0,) * 3, (0.0, 0.0, 0.0)))
    stream.samples(100)
    first = np.array([one.torque[0] for one in stream.commands])
    assert np.abs(np.diff(first)).max() < 0.021 and 0.48 < first.max() < 0.54
    assert first[-1] == pytest.approx(0.0, abs=1e-9)


def test_a_trajectory_without_efforts_ends_those_before(monkeypatch):
    stream = Stream(monkeypatch, 0, stamped=True, mode="pd")
    stream.send_points((0.1, (0.0,) * 3, (1.0, 0.0, 0.0)))
    stream.samples(51)  # all of it is there
    stream.send_points((0.1, (0.0,) * 3), (0.2, (0.0,) * 3))
    stream.samples(100)
    first = np.array([one.torque[0] for one in stream.commands])
    # the second one begins with the sample after that at which it came
    expected = np.interp(np.arange(151), (0, 50, 51, 101), (0.0, 1.0, 1.0, 0.0))
    np.testing.assert_allclose(first, expected, atol=1e-9)


def test_efforts_are_limited_with_the_command(monkeypatch):
    """A limit below the effort of the last point."""
    stream = Stream(monkeypatch, 0, stamped=True, mode="pd", torque_limit=0.5)
    stream.send_points((0.1, (0.0,) * 3, (1.0, 0.0, 0.0)))
    stream.samples(51)
    torques = [one.torque[0] for one in stream.commands]
    expected = np.minimum(np.arange(51) / 50, 0.5)
    np.testing.assert_allclose(torques, expected, atol=1e-9)
    assert stream.follower.limited == 25


@pytest.mark.parametrize("efforts", [((1.0,) * 3, ()), ((1.0,) * 2, (1.0,) * 2),
                                     ((math.nan,) * 3, (0.0,) * 3)])  # fmt: skip
def test_efforts_of_some_points_or_joints_are_refused(monkeypatch, efforts):
    stream = Stream(monkeypatch, 0)
    with pytest.raises(InputError, match=r"points\[[01]\]\.effort .* 3 finite numbers"):
        stream.send_points(
            *((0.1 + k, (0.0,) * 3, effort) for k, effort in enumerate(efforts))
        )


def test_gains_change_between_samples_and_the_error_sum_stays():
    given = {"mode": "pd", "integral_rate": 2.0}
    off = Measurement(tuple(np.subtract(HERE.gamma, 1e-3)), REST)
    tuned, plain = follow(bandwidth=30.0, **given), follow(bandwidth=30.0, **given)
    (before,) = answers(tuned, [0], off)
    answers(plain, [0], off)
    stronger = ControllerNodeParameters(bandwidth=60.0, **given)
    tuned.tune(stronger)
    for follower, factor in ((tuned, 4.0), (plain, 1.0)):
        (after,) = answers(follower, [1], off)
        inertia = follower._controller.inertia
        spring = np.multiply(inertia, 900.0 * factor)
        damping = np.multiply(inertia, 60.0 * math.sqrt(factor))
        summed = np.multiply(before.error, 2.0 * 1e-9 * PERIOD_NS)
        expected = spring * (after.error + summed) + damping * after.error_rate
        np.testing.assert_allclose(after.feedback, expected, rtol=1e-9)


def test_unstable_gains_are_refused_and_change_nothing():
    follower = follow(mode="pd", bandwidth=30.0, integral_rate=2.0)
    answers(follower, [0], HERE)
    for worse in ({"integral_rate": 200.0}, {"bandwidth": 0.5, "integral_rate": 2.0}):
        with pytest.raises(InputError, match=r"integral_rate .* the loop is unstable"):
            follower.tune(ControllerNodeParameters(mode="pd", **worse))
    same = follow(mode="pd", bandwidth=30.0, integral_rate=2.0)
    answers(same, [0], HERE)
    off = Measurement(tuple(np.subtract(HERE.gamma, 1e-3)), REST)
    assert answers(follower, [1], off)[0].torque == answers(same, [1], off)[0].torque


def test_gains_that_no_motion_can_have_refuse_the_trajectory(monkeypatch):
    stream = Stream(monkeypatch, 0, mode="pd")
    unstable = {"mode": "pd", "motion": "topic", "integral_rate": 200.0}
    stream.follower.tune(ControllerNodeParameters(**unstable))  # checked with a motion
    order = stream.send(0.2, (0.1, 0.0, 0.0))
    stream.follower.proceed()
    assert "the loop is unstable" in str(order.outcome.exception())
    stream.follower.tune(ControllerNodeParameters(mode="pd", motion="topic"))
    assert stream.send(0.2, (0.1, 0.0, 0.0)).outcome.result(0) is None


def test_control_goes_on_beside_the_check_of_a_trajectory():
    """With the process that does it: stopped for 50 samples, no check is too quick."""
    with pytest.MonkeyPatch.context() as patch:
        stream = Stream(patch, 0, mode="computed_torque")
    stream.send(1.0, (0.05, 0.0, 0.0))
    stream.samples(100)
    follower = stream.follower
    with contextlib.closing(
        assistant_process.Assistant(follower._plan)
    ) as follower._assistant:
        for number in range(3):  # what is imported and traced first is not a check
            os.kill(follower._assistant._process.pid, signal.SIGSTOP)
            order, took = stream.send(1.0, (0.05 + 0.01 * number, 0.0, 0.0)), []
            while not order.outcome.done():
                assert stream.stamp_ns < START_NS + 60 * 10**9
                began = time.thread_time()
                stream.samples(1)
                took.append(time.thread_time() - began)
                if len(took) == 50:
                    os.kill(follower._assistant._process.pid, signal.SIGCONT)
                if len(took) > 50:
                    time.sleep(0.002)
            assert len(took) > 50 and order.outcome.exception() is None
            stream.samples(50)
        follower.proceed()
    assert sorted(took)[len(took) // 2] < 0.002
    assert max(stream.jumps()[:2]) < 1e-6


@pytest.mark.timeout(20)
def test_a_long_result_of_which_a_part_has_come_delays_no_sample():
    """Of a process that has to let others run meanwhile.

    A kernel keeps 200 kB of what is sent.
    """
    ours, theirs = multiprocessing.Pipe()
    with pytest.MonkeyPatch.context() as patch, theirs:
        patch.setattr(
            assistant_process, "Pipe", lambda: (ours, multiprocessing.Pipe()[1])
        )
        with contextlib.closing(assistant_process.Assistant(bytes)) as assistant:
            long = bytes(1_000_000)
            assistant.call(long)  # nobody has taken it yet
            assert (theirs.recv(), theirs.recv()) == (bytes, (long,))
            sent = pickle.dumps(long)
            os.write(theirs.fileno(), struct.pack("!i", len(sent)) + sent[:1000])
            assert assistant.result() is None
            os.set_blocking(theirs.fileno(), False)
            rest = memoryview(sent)[1000:]
            while (found := assistant.result()) is None:
                with contextlib.suppress(BlockingIOError):
                    rest = rest[os.write(theirs.fileno(), rest) :] if rest else rest
            assert found == long


def test_a_checking_process_ends_with_reason_and_another_begins():
    with contextlib.closing(assistant_process.Assistant(math.sqrt)) as assistant:

        def result(*given):
            assistant.call(*given)
            end = time.monotonic() + 60.0
            while (found := assistant.result()) is None:
                assert time.monotonic() < end
                time.sleep(0.01)
            return found

        assert result(4.0) == 2.0
        with pytest.raises(ValueError) as failed:
            math.sqrt(-1.0)
        assert str(failed.value) in str(result(-1.0))
        os.kill(assistant._process.pid, signal.SIGKILL)
        assert "has ended with status -9" in str(result(9.0))
        assert result(9.0) == 3.0


def test_a_trajectory_begins_at_its_stamp_and_is_replaced(monkeypatch):
    stream = Stream(monkeypatch, 2)
    first = stream.send(0.1, (0.02, 0.0, 0.0), START_NS + 10 * PERIOD_NS)
    stream.samples(10)
    before = len(stream.references)
    off = np.array([np.subtract(one.gamma, HERE.gamma) for one in stream.references])
    assert before > 5 and np.abs(off).max() < 1e-15
    stream.samples(1 + 50 + 1)
    gammas = (
        np.array([one.gamma for one in stream.references])[before:, 0] - HERE.gamma[0]
    )
    assert (np.diff(gammas[:51]) > 0.0).all() and gammas[50:] == pytest.approx(0.02)
    # While it moves: one in the future, and before that comes one for now, which
    # replaces it.
    begin = stream.stamp_ns
    second = stream.send(0.2, (0.0, 0.0, 0.0))
    stream.samples(40)
    third = stream.send(0.1, (0.05, 0.0, 0.0), begin + 60 * PERIOD_NS)
    stream.samples(10)
    assert third.outcome.done() and stream.follower.has(third)
    assert stream.follower.order is second
    fourth = stream.send(0.1, (0.01, 0.0, 0.0))
    stream.samples(100)
    assert stream.follower.order is fourth and not stream.follower.has(third)
    assert stream.references[-1].gamma[0] - HERE.gamma[0] == pytest.approx(0.01)
    assert first.outcome.exception() is fourth.outcome.exception() is None
    assert max(stream.jumps()[:2]) < 1e-3  # in 0.1 s it accelerates to 4 rad/s^2


def test_points_whose_time_has_passed_are_left_out(monkeypatch):
    stream = Stream(monkeypatch, 0)
    stream.send(0.2, (0.02, 0.0, 0.0))
    stream.samples(50)
    old = stream.send(0.1, (0.05, 0.0, 0.0), stream.stamp_ns - 150_000_000)
    assert "all points have passed" in str(old.outcome.exception())
    late = stream.send(0.3, (0.05, 0.0, 0.0), stream.stamp_ns - 200_000_000)
    stream.samples(47)
    assert stream.references[-1].gamma_dot[0] > 0.0
    stream.samples(4)  # 0.3 s after the stamp
    assert late.passed >= 0.2 and stream.references[-1].gamma_dot == REST
    assert stream.references[-1].gamma[0] - HERE.gamma[0] == pytest.approx(0.05)


def test_a_check_whose_beginning_has_changed_is_repeated(monkeypatch):
    stream = Stream(monkeypatch, 30, stop_time=0.02)
    stream.send(1.0, (0.1, 0.0, 0.0))
    stream.samples(200)
    order, calls = stream.send(0.5, (0.0, 0.0, 0.0)), stream.assistant.calls
    stream.samples(10)
    stream.follower.stop()
    stream.samples(300)
    assert order.outcome.exception() is None and stream.assistant.calls > calls
    assert stream.references[-1].gamma == pytest.approx(HERE.gamma)
    assert (
        max(stream.jumps()[:2]) < 1e-3
    )  # its rate is 0.2 rad/s when the stop of ten samples begins
    stopped = stream.send(0.5, (0.1, 0.0, 0.0))
    stream.follower.restart()
    stream.samples(100)
    assert stopped.outcome.cancelled()
    assert stream.follower.stage is Stage.WAITING


DEFAULTS = ControllerNodeParameters(
    motion="topic", path_tolerance=0.1, goal_tolerance=0.01
)
FREE = ControllerNodeParameters(motion="topic", stopped_velocity_tolerance=0.0)


def tolerance(name="gamma_2", position=0.0, velocity=0.0, acceleration=0.0):
    return Message(
        name=name, position=position, velocity=velocity, acceleration=acceleration
    )


def message(times=(0.5, 1.0), path=(), goal=(), goal_time=0.0, multi=()):
    points = [Message(time_from_start=duration(time * 1e9)) for time in times]
    return Message(
        trajectory=Message(points=points),
        multi_dof_trajectory=Message(joint_names=[*multi], points=[]),
        path_tolerance=path,
        goal_tolerance=goal,
        component_path_tolerance=[],
        component_goal_tolerance=[],
        goal_time_tolerance=duration(goal_time * 1e9),
    )


def outcome(time, off=0.0, rate=0.0, defaults=DEFAULTS, **given):
    """At a time, with errors of gamma_2 and its rate."""
    goal = TrajectoryGoal(message(**given), defaults)
    found = goal.outcome(time, (0.0, off, 0.0), (0.0, rate, 0.0))
    return found and found[0]


PATH, GOAL = ErrorCode.PATH_TOLERANCE_VIOLATED, ErrorCode.GOAL_TOLERANCE_VIOLATED
DONE = ErrorCode.SUCCESSFUL


@pytest.mark.parametrize(
    ("expected", "case"),
    [
        (None, {"time": 0.999999, "off": 0.099}),
        (PATH, {"time": 0.999999, "off": -0.101}),
        (PATH, {"time": 0.0, "off": np.nan}),
        (None, {"time": 0.5, "off": 0.101, "path": [tolerance(position=0.2)]}),
        (PATH, {"time": 0.5, "off": 0.201, "path": [tolerance(position=0.2)]}),
        (None, {"time": 0.5, "off": 9.0, "path": [tolerance(position=-1.0)]}),
        (None, {"time": 0.5, "rate": 9.0}),
        (PATH, {"time": 0.5, "rate": 9.0, "path": [tolerance(velocity=8.0)]}),
        (
            PATH,
            {"time": 0.5, "off": 0.101, "path": [tolerance("gamma_1", position=-1.0)]},
        ),
        (None, {"time": 0.5, "path": [tolerance(acceleration=1e-9)]}),
        (DONE, {"time": 1.0, "off": 0.0099, "rate": 0.0099}),
        (None, {"time": 1.0, "off": 0.0101}),
        (None, {"time": 1.0, "rate": 0.0101}),
        (DONE, {"time": 1.0, "off": 0.09, "goal": [tolerance(position=-1.0)]}),
        (DONE, {"time": 1.0, "rate": 9.0, "goal": [tolerance(velocity=-1.0)]}),
        (None, {"time": 2.0, "off": 0.0101}),
        (GOAL, {"time": 2.001, "off": 0.0101}),
        (DONE, {"time": 2.001, "off": 0.0099}),
        (GOAL, {"time": 1.21, "off": 0.0101, "goal_time": 0.2}),
        (None, {"time": 1e6, "off": 0.0101, "goal_time": -1.0}),
        # Without tolerances a goal ends with its last point.
        (None, {"time": 0.999, "off": 9.0, "rate": 9.0, "defaults": FREE}),
        (DONE, {"time": 1.0, "off": 9.0, "rate": 9.0, "defaults": FREE}),
    ],
)
def test_a_goal_goes_on_or_ends(expected, case):
    assert outcome(**case) == expected


def test_the_message_names_the_joint_and_both_numbers():
    goal, off = TrajectoryGoal(message(), DEFAULTS), (0.0, 0.0, 0.25)
    found = goal.outcome(0.2, off, REST)
    assert found[1] == "gamma_3: position error 0.25 rad, path tolerance 0.1 rad"
    assert (
        goal.outcome(2.5, off, REST)[1]
        == "gamma_3: position error 0.25 rad, goal tolerance 0.01 rad 1.500 s after the"
        " end, goal_time_tolerance 1 s"
    )


def test_the_index_is_that_of_the_point_ahead():
    goal = TrajectoryGoal(message(times=(0.0, 0.5, 1.0)), DEFAULTS)
    assert [goal.index(time) for time in (0.0, 0.49, 0.5, 0.99, 1.0, 9.0)] == [
        1,
        1,
        2,
        2,
        2,
        2,
    ]


@pytest.mark.parametrize(
    ("given", "place"),
    [
        ({"path": [tolerance("gamma_4")]}, r"path_tolerance\[0\].name = 'gamma_4'"),
        (
            {"goal": [tolerance(), tolerance(velocity=-0.5)]},
            r"goal_tolerance\[1\].velocity",
        ),
        ({"path": [tolerance(position=np.nan)]}, r"path_tolerance\[0\].position"),
        ({"goal_time": -2.0}, "goal_time_tolerance"),
        ({"multi": ["base"]}, r"multi_dof_trajectory\.joint_names"),
    ],
)
def test_bad_tolerances_and_joints_of_many_freedoms_are_refused(given, place):
    with pytest.raises(InputError, match=place):
        TrajectoryGoal(message(**given), DEFAULTS)
