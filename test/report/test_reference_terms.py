# SPDX-License-Identifier: Apache-2.0
"""Scenes with terms that the paper has not: compared rightly, or said not to be comparable."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from bags import altered

from sst_ros.recording import recording
from sst_ros.report import reference, states
from sst_ros.report.run import summarise
from sst_ros.scene import scene, yaml_document
from sst_ros.scene.loads import Actuators, Friction, Gravity, JointFriction, Moment, Spring

EXAMPLE2 = scene.load("example2")


def judged(run):
    """The comparisons and the notes of a report."""
    integration, ideal = reference.integration(run), reference.ideal(run)
    said = summarise(run, integration, ideal, states.check_with_paper(run))
    return integration, ideal, " ".join(said["notes"])


@pytest.fixture
def recorded(tmp_path, bags):
    def record(some, seconds=0.1, change=lambda entries: entries):
        return recording.read(bags.write(tmp_path / "bag", change(bags.simulated(some, seconds))))

    return record


LOADED = replace(
    EXAMPLE2,
    star=replace(EXAMPLE2.star, mass=2.6, centre=(0.0, 0.0, 0.2)),
    gravity=Gravity(acceleration=(0.0, 0.0, -9.8)),
    friction=JointFriction(mu=Friction(viscous=0.1, coulomb=0.2)),
    springs=(Spring(joint="beta_2", stiffness=3.0, rest=0.1),),
    moment=Moment(value=(0.1, 0.2, 0.3)),
)


@pytest.mark.parametrize(
    "some",
    [
        LOADED,
        replace(EXAMPLE2, actuators=Actuators(rotor_inertia=1e-4, gear_ratio=10.0)),
        replace(EXAMPLE2, actuators=Actuators(torque_limit=2.5)),
        replace(EXAMPLE2, actuators=Actuators(time_constant=0.02, torque_limit=2.5)),
    ],
    ids=["loads", "rotors", "limit", "lag and limit"],
)
def test_loads_and_actuators_are_compared_as_they_are(recorded, some):
    integration, ideal, notes = judged(recorded(some))
    assert integration.compared == 51
    assert integration.error.gamma.max() < 1e-9 and integration.error.gamma_dot.max() < 1e-8
    assert ideal.error.gamma.max() < 1e-2
    assert ("the actuators lag" in notes) == bool(some.actuators and some.actuators.time_constant)


def test_a_lag_that_the_simulator_forgot_would_be_seen(recorded):
    run = recorded(EXAMPLE2)
    lagging = replace(run.scene, actuators=Actuators(time_constant=0.02))
    assert reference.integration(altered(run, scene=lagging)).error.gamma.max() > 1e-4


def test_a_lagging_run_begins_again_from_the_efforts_of_a_sample(recorded, bags):
    def lose(entries):
        return [e for e in entries if not (e.topic == bags.APPLIED and e.sample == 20)]

    run = recorded(replace(EXAMPLE2, actuators=Actuators(time_constant=0.02)), change=lose)
    integration = reference.integration(run)
    assert integration.restarts_ns == (40_000_000,)
    assert integration.compared == 50 and np.nanmax(integration.error.gamma) < 1e-9


def moved(bags, value, named=True):
    """Turn a recording under a constant moment into one that takes it from a topic."""

    def change(entries):
        result = []
        for entry in entries:
            content = entry.content
            if entry.topic == bags.SCENE:
                one = yaml_document.read(scene.Scene, content.data, "bag")
                text = yaml_document.dump(replace(one, moment=Moment(topic=True)))
                content = dataclasses.replace(content, data=text)
            elif entry.topic == bags.APPLIED and named:
                points = [
                    dataclasses.replace(point, effort=np.append(point.effort, value))
                    for point in content.points
                ]
                names = [*content.joint_names, "moment_x", "moment_y", "moment_z"]
                content = dataclasses.replace(content, joint_names=names, points=points)
            result.append(dataclasses.replace(entry, content=content))
        return result

    return change


PUSHED = replace(EXAMPLE2, moment=Moment(value=(0.3, -0.2, 0.1)))


def test_a_recorded_moment_is_used(recorded, bags):
    run = recorded(PUSHED, change=moved(bags, PUSHED.moment.value))
    assert run.ticks.moment.tolist() == [list(PUSHED.moment.value)] * 100
    integration, ideal, notes = judged(run)
    assert integration.compared == 51 and integration.error.gamma.max() < 1e-9
    assert ideal is None and "no ideal to compare with" in notes
    wrong = dataclasses.replace(run.ticks, moment=1.01 * run.ticks.moment)
    assert reference.integration(altered(run, ticks=wrong)).error.gamma.max() > 1e-7


def test_a_moment_that_is_not_recorded_is_told_and_nothing_is_compared(recorded, bags):
    integration, ideal, notes = judged(recorded(PUSHED, change=moved(bags, (), named=False)))
    assert integration.compared == 0 and ideal is None
    assert "is not recorded: nothing is compared" in notes
