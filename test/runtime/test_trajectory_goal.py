# SPDX-License-Identifier: Apache-2.0
"""Goals of FollowJointTrajectory without ROS: tolerances, outcomes, and what is refused."""

import dataclasses
from types import SimpleNamespace as Message

import numpy as np
import pytest

from sst_ros.control.controller import Measurement
from sst_ros.control.reference import REST, Reference
from sst_ros.errors import InputError
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.runtime.trajectory_goal import ErrorCode, TrajectoryGoal

HOME = (0.7, 0.8, 0.9)
DESIRED = Reference((0.0, 0.0, 0.0, 1.0), REST, REST, HOME, REST, REST)
DEFAULTS = ControllerNodeParameters(motion="topic", path_tolerance=0.1, goal_tolerance=0.01)


def duration(seconds):
    sec, nanosec = divmod(round(seconds * 1e9), 10**9)
    return Message(sec=sec, nanosec=nanosec)


def tolerance(name="gamma_2", position=0.0, velocity=0.0, acceleration=0.0):
    return Message(name=name, position=position, velocity=velocity, acceleration=acceleration)


def message(times=(0.5, 1.0), path=(), goal=(), goal_time=0.0):
    points = [Message(time_from_start=duration(time)) for time in times]
    return Message(
        trajectory=Message(points=points),
        multi_dof_trajectory=Message(joint_names=[], points=[]),
        path_tolerance=path,
        goal_tolerance=goal,
        component_path_tolerance=[],
        component_goal_tolerance=[],
        goal_time_tolerance=duration(goal_time),
    )


def outcome(time, off=0.0, rate=0.0, defaults=DEFAULTS, **given):
    """At a time, with errors of gamma_2 and its rate."""
    measured = Measurement((HOME[0], HOME[1] - off, HOME[2]), (0.0, -rate, 0.0))
    found = TrajectoryGoal(message(**given), defaults).outcome(time, DESIRED, measured)
    return found and found.code


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
    ],
)
def test_a_goal_goes_on_or_ends(expected, case):
    assert outcome(**case) == expected


def test_without_tolerances_a_goal_ends_with_its_last_point():
    free = dataclasses.replace(
        DEFAULTS, path_tolerance=0.0, goal_tolerance=0.0, stopped_velocity_tolerance=0.0
    )
    assert outcome(0.999, 9.0, 9.0, free) is None
    assert outcome(1.0, 9.0, 9.0, free) is DONE


def test_the_message_names_the_joint_and_both_numbers():
    off = Measurement((HOME[0], HOME[1], HOME[2] - 0.25), REST)
    found = TrajectoryGoal(message(), DEFAULTS).outcome(0.2, DESIRED, off)
    assert found.message == "gamma_3: position error 0.25 rad, path tolerance 0.1 rad"
    late = TrajectoryGoal(message(), DEFAULTS).outcome(2.5, DESIRED, off)
    assert late.message == (
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
    ],
)
def test_bad_tolerances_are_refused(given, place):
    with pytest.raises(InputError, match=place):
        TrajectoryGoal(message(**given), DEFAULTS)


def test_joints_of_several_freedoms_are_refused():
    given = message()
    given.multi_dof_trajectory.joint_names = ["base"]
    with pytest.raises(InputError, match=r"multi_dof_trajectory\.joint_names"):
        TrajectoryGoal(given, DEFAULTS)
