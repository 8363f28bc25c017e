# SPDX-License-Identifier: Apache-2.0
"""The controller without its node: when it begins, goes on, ends, and what it refuses."""

import dataclasses
import tracemalloc

import numpy as np
import pytest

from sst_ros.control import tracking
from sst_ros.control.controller import ControlStopped, Measurement
from sst_ros.control.reference_motions import reference_motion
from sst_ros.errors import InputError, SstError
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.runtime.trajectory_following import Stage, TrajectoryFollower
from sst_ros.scene import scene
from sst_ros.scene.motions import DesiredMotion, Spiral, ToAngles
from sst_ros.scene.scene import Actuators, Initial
from sst_ros.simulation.simulation import Simulation

PERIOD_NS = 2_000_000
START_NS = 1_700_000_000_123_456_789
MOVE = DesiredMotion(spiral=Spiral(phi=0.02, theta=0.5, psi=0.03, duration=0.05))
MODEL = dataclasses.replace(scene.load("example2_heavy"), motion=MOVE, torque=None)


def seen(state):
    return Measurement(state.joints.gamma, state.joints.gamma_dot)


def test_it_follows_holds_and_ends_with_zero_torque():
    follower = TrajectoryFollower(
        MODEL, ControllerNodeParameters(hold=0.01, feedforward_at="middle")
    )
    simulation = Simulation(MODEL)
    assert follower.stage is Stage.READY and follower.tracking() is None
    first = follower.preview(seen(simulation.state))
    stages, commands = [], []
    for k in range(40):
        command = follower.answer(START_NS + k * PERIOD_NS, seen(simulation.state))
        if command is None:
            break
        stages.append(follower.stage)
        commands.append(command)
        simulation.step(command.torque, PERIOD_NS)
    assert commands[0].torque == first.torque
    assert stages == [Stage.FOLLOWING] * 25 + [Stage.HOLDING] * 5 + [Stage.ENDED]
    assert commands[-1].torque == (0.0, 0.0, 0.0) and follower.samples == 31
    judged = follower.tracking()
    assert judged.samples == 31 and judged.largest.max() < 0.01 * judged.band / tracking.BAND
    rms, largest = follower.errors
    assert largest == judged.largest.max()
    assert rms == pytest.approx(np.sqrt(np.mean(judged.rms**2)))


def test_samples_that_come_twice_or_late_are_told_apart():
    follower = TrajectoryFollower(MODEL, ControllerNodeParameters())
    here = Measurement(MODEL.initial.gamma, (0.0, 0.0, 0.0))
    for k, answered in ((1, True), (2, True), (2, False), (1, False), (5, True)):
        assert (follower.answer(START_NS + k * PERIOD_NS, here) is not None) == answered
    assert (follower.samples, follower.irregular) == (3, 1)


def test_a_long_motion_keeps_no_more_than_a_short_one(monkeypatch):
    monkeypatch.setattr(tracking, "_KEPT", 100)
    follower = TrajectoryFollower(MODEL, ControllerNodeParameters(hold=1e6))
    here = Measurement(MODEL.initial.gamma, (0.0, 0.0, 0.0))
    for k in range(600):
        follower.answer(START_NS + k * PERIOD_NS, here)
    tracemalloc.start()
    for k in range(600, 1200):
        follower.answer(START_NS + k * PERIOD_NS, here)
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 70_000  # 600 rows of a record are 106 000
    assert follower.tracking().samples == 1200


def test_a_reset_of_the_simulator_begins_the_motion_anew():
    follower = TrajectoryFollower(MODEL, ControllerNodeParameters(mode="pd", integral_rate=1.0))
    here = Measurement(tuple(np.add(MODEL.initial.gamma, 0.01)), (0.0, 0.0, 0.0))
    told = [follower.answer(START_NS + k * PERIOD_NS, here) for k in range(5)]
    follower.restart()
    assert follower.stage is Stage.READY and follower.tracking() is None
    again = [follower.answer(START_NS + (100 + k) * PERIOD_NS, here) for k in range(5)]
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
    ],
    ids=["no motion", "stroke", "workspace", "actuators", "limit", "both limits", "unstable"],
)  # fmt: skip
def test_what_cannot_be_followed_is_refused_at_the_start(model, settings, reason):
    with pytest.raises(SstError, match=reason):
        TrajectoryFollower(
            dataclasses.replace(MODEL, **model), ControllerNodeParameters(**settings)
        )


@pytest.mark.parametrize(
    "given",
    [
        {"mode": "pid"},
        {"bandwidth": 0.0},
        {"damping": (1.0, -1.0, 1.0)},
        {"stiffness": (1.0, np.nan, 1.0)},
        {"rate": 7},
        {"mode": "computed_torque", "space": "so3", "stiffness": (1.0, 1.0, 1.0)},
        {"damping": (1.0, 1.0, 1.0), "integral_rate": 1.0},
    ],
)
def test_bad_parameters_are_refused(given):
    with pytest.raises(InputError):
        ControllerNodeParameters(**given)


def test_it_begins_only_near_the_start_of_the_motion():
    off = dataclasses.replace(
        MODEL, initial=Initial(gamma=tuple(np.add(MODEL.initial.gamma, (0.0, 0.06, 0.0))))
    )
    state = Simulation(off).state
    near = ControllerNodeParameters(start_tolerance=0.07)
    assert TrajectoryFollower(MODEL, near).answer(START_NS, seen(state)) is not None
    for ask in (lambda p: p.preview(seen(state)), lambda p: p.answer(START_NS, seen(state))):
        with pytest.raises(InputError, match="where the motion begins"):
            ask(TrajectoryFollower(MODEL, ControllerNodeParameters()))


def test_what_is_not_finite_is_nowhere_near():
    follower = TrajectoryFollower(MODEL, ControllerNodeParameters())
    here = Measurement(MODEL.initial.gamma, (0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="where the motion begins"):
        follower.preview(dataclasses.replace(here, gamma=(np.nan,) * 3))
    follower.answer(START_NS, here)
    with pytest.raises(ControlStopped, match="must be finite"):
        follower.answer(START_NS + PERIOD_NS, dataclasses.replace(here, gamma_dot=(np.nan,) * 3))


def test_a_stop_comes_to_rest_on_the_path_and_holds():
    settings = ControllerNodeParameters(mode="computed_torque", stop_time=0.02, hold=1.0)
    follower, simulation = TrajectoryFollower(MODEL, settings), Simulation(MODEL)
    references = []
    for k in range(40):
        if k == 10:
            follower.stop()
        command = follower.answer(START_NS + k * PERIOD_NS, seen(simulation.state))
        references.append(command.desired)
        simulation.step(command.torque, PERIOD_NS)
    path = reference_motion(MODEL)
    moving, rest = references[9], references[-1]
    assert moving == path.at(0.018)
    assert rest.gamma == pytest.approx(path.at(0.028).gamma, abs=1e-15)
    assert rest.gamma_dot == (0.0, 0.0, 0.0)
    rates = np.array([one.gamma_dot for one in references[9:]])
    assert (np.abs(np.diff(rates[:, 2])) < 0.2 * abs(rates[0, 2])).all()  # without a jump
    assert np.array(simulation.state.joints.gamma) == pytest.approx(rest.gamma, abs=1e-4)
    assert follower.stage is Stage.HOLDING


def test_a_stop_before_the_run_forgets_the_trajectory():
    follower = TrajectoryFollower(MODEL, ControllerNodeParameters())
    follower.stop()
    assert follower.stage is Stage.READY  # the scene's own motion stays
