# SPDX-License-Identifier: Apache-2.0
"""The controller without its node: when it begins, goes on, ends, and what it refuses; goals."""

import dataclasses
import tracemalloc

import numpy as np
import pytest
from runtime.bench import Message, duration

from sst_ros.control import tracking
from sst_ros.control.controller import ControlStopped, Measurement
from sst_ros.control.reference_motions import reference_motion
from sst_ros.errors import InputError, SstError
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.runtime.trajectory_following import (
    ErrorCode,
    Stage,
    TrajectoryFollower,
    TrajectoryGoal,
)
from sst_ros.scene import scene
from sst_ros.scene.loads import Actuators, DesiredMotion, Initial, Spiral, ToAngles
from sst_ros.simulation.simulation import Simulation

PERIOD_NS = 2_000_000
REST = (0.0, 0.0, 0.0)
START_NS = 1_700_000_000_123_456_789
MOVE = DesiredMotion(spiral=Spiral(phi=0.02, theta=0.5, psi=0.03, duration=0.05))
MODEL = dataclasses.replace(scene.load("example2_heavy"), motion=MOVE, torque=None)

HERE = Measurement(MODEL.initial.gamma, REST)


def seen(state):
    return Measurement(state.joints.gamma, state.joints.gamma_dot)


def follow(**settings):
    return TrajectoryFollower(MODEL, ControllerNodeParameters(**settings))


def answers(follower, samples, measured=HERE):
    """What is answered to samples of these numbers, where the manipulator does not move."""
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
    assert judged.samples == 31 and judged.largest.max() < 0.01 * judged.band / tracking.BAND
    rms, largest = follower.errors
    assert largest == judged.largest.max()
    assert rms == pytest.approx(np.sqrt(np.mean(judged.rms**2)))


def test_samples_that_come_twice_or_late_are_told_apart():
    follower = follow()
    told = answers(follower, (1, 2, 2, 1, 5))
    assert [one is not None for one in told] == [True, True, False, False, True]
    assert (follower.samples, follower.irregular) == (3, 1)


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
        ({"motion": DesiredMotion(to_angles=ToAngles(gamma=(1.7, 0.8, 0.8), duration=1.0))}, {},
         "gamma_1"),
        ({"motion": DesiredMotion(to_angles=ToAngles(gamma=(0.35, 0.3, 1.35), duration=1.0))}, {},
         "beta_"),
        ({"actuators": Actuators(torque_limit=0.5)}, {}, "exceeds the limit 0.5 N m"),
        ({"actuators": Actuators(torque_limit=50.0)}, {"torque_limit": 0.5}, "limit 0.5 N m"),
        ({"actuators": Actuators(torque_limit=0.5)}, {"torque_limit": 50.0}, "limit 0.5 N m"),
        ({}, {"integral_rate": 100.0, "mode": "pd"}, "integral_rate"),
        ({}, {"mode": "pid"}, "mode"),
        ({}, {"stiffness": (1.0, np.nan, 1.0)}, "stiffness"),
        ({}, {"rate": 7}, "rate"),
        ({}, {"mode": "computed_torque", "space": "so3", "stiffness": (1.0,) * 3}, "stiffness"),
        ({}, {"damping": (1.0, 1.0, 1.0), "integral_rate": 1.0}, "integral_rate"),
    ],
)  # fmt: skip
def test_what_cannot_be_followed_is_refused_at_the_start(model, settings, reason):
    with pytest.raises(SstError, match=reason):
        TrajectoryFollower(
            dataclasses.replace(MODEL, **model), ControllerNodeParameters(**settings)
        )


def test_a_trajectory_beside_the_motion_of_the_scene_is_refused_for_that():
    with pytest.raises(InputError, match="must be topic"):
        follow().take(None, None)


def test_it_begins_only_near_the_start_of_the_motion():
    gamma = tuple(np.add(MODEL.initial.gamma, (0.0, 0.06, 0.0)))
    off = seen(Simulation(dataclasses.replace(MODEL, initial=Initial(gamma=gamma))).state)
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
    commands, stages, state = closed_loop(follower, lambda k: k == 10 and follower.stop())
    references = [command.desired for command in commands]
    path, rest = reference_motion(MODEL), references[-1]
    assert references[9] == path.at(0.018)
    assert rest.gamma == pytest.approx(path.at(0.028).gamma, abs=1e-15)
    assert rest.gamma_dot == REST
    rates = np.array([one.gamma_dot for one in references[9:]])
    assert (np.abs(np.diff(rates[:, 2])) < 0.2 * abs(rates[0, 2])).all()  # without a jump
    assert np.array(state.joints.gamma) == pytest.approx(rest.gamma, abs=1e-4)
    assert len(references) == 40 and stages[-1] is Stage.HOLDING


DEFAULTS = ControllerNodeParameters(motion="topic", path_tolerance=0.1, goal_tolerance=0.01)
FREE = ControllerNodeParameters(motion="topic", stopped_velocity_tolerance=0.0)


def tolerance(name="gamma_2", position=0.0, velocity=0.0, acceleration=0.0):
    return Message(name=name, position=position, velocity=velocity, acceleration=acceleration)


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
        (PATH, {"time": 0.5, "off": 0.101, "path": [tolerance("gamma_1", position=-1.0)]}),
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
    assert goal.outcome(2.5, off, REST)[1] == (
        "gamma_3: position error 0.25 rad, goal tolerance 0.01 rad 1.500 s after the end, "
        "goal_time_tolerance 1 s"
    )


def test_the_index_is_that_of_the_point_ahead():
    goal = TrajectoryGoal(message(times=(0.0, 0.5, 1.0)), DEFAULTS)
    assert [goal.index(time) for time in (0.0, 0.49, 0.5, 0.99, 1.0, 9.0)] == [1, 1, 2, 2, 2, 2]


@pytest.mark.parametrize(
    ("given", "place"),
    [
        ({"path": [tolerance("gamma_4")]}, r"path_tolerance\[0\].name = 'gamma_4'"),
        ({"goal": [tolerance(), tolerance(velocity=-0.5)]}, r"goal_tolerance\[1\].velocity"),
        ({"path": [tolerance(position=np.nan)]}, r"path_tolerance\[0\].position"),
        ({"goal_time": -2.0}, "goal_time_tolerance"),
        ({"multi": ["base"]}, r"multi_dof_trajectory\.joint_names"),
    ],
)
def test_bad_tolerances_and_joints_of_several_freedoms_are_refused(given, place):
    with pytest.raises(InputError, match=place):
        TrajectoryGoal(message(**given), DEFAULTS)
