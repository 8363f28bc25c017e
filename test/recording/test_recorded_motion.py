# SPDX-License-Identifier: Apache-2.0
"""A recorded run as a desired motion: it is done again by the torques that did it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sst_ros import __main__ as cli
from sst_ros.control.plan import examine_motion
from sst_ros.control.reference_motions import reference_motion
from sst_ros.errors import InputError
from sst_ros.recording.recording import read, read_run_motion
from sst_ros.scene import scene, yaml_document
from sst_ros.scene.loads import DesiredMotion, Recorded


@pytest.fixture
def bag(written, example2):
    return written(example2)


def following(bag):
    motion = DesiredMotion(recorded=Recorded(bag=str(bag)))
    return dataclasses.replace(scene.load("example2"), motion=motion)


def test_inverse_dynamics_of_a_recorded_motion_are_the_torques_that_made_it(bag):
    """Held for 1 ms they are a staircase; the smooth motion asks for what lies between."""
    recording, held = read(bag), following(bag)
    plan = examine_motion(reference_motion(held, read_run_motion), held)
    assert plan.motion.duration == pytest.approx(recording.seconds[-1], abs=1e-12)
    for row in (0, 40, len(recording.gamma) - 1):
        at = plan.motion.at(recording.seconds[row])
        assert at.gamma == pytest.approx(recording.gamma[row], abs=1e-13)
        assert at.gamma_dot == pytest.approx(recording.gamma_dot[row], abs=1e-11)
        assert at.quaternion == pytest.approx(recording.quaternion[row], abs=1e-12)
    torque = held.torque.at
    # What is held since the last millisecond lags behind the sine by half of one.
    expected = np.array([torque(time - 0.0005) for time in plan.times.tolist()])
    inside = (plan.times > 0.02) & (plan.times < plan.motion.duration - 0.02)
    half_a_step = 0.0005 * np.max(np.multiply(held.torque.amplitude, held.torque.frequency))
    assert np.abs(plan.torques - expected)[inside].max() < half_a_step
    assert np.abs(expected).max() > 100.0 * half_a_step


def test_the_command_reads_the_bag(bag, tmp_path, capsys):
    path = tmp_path / "again.yaml"
    path.write_text(yaml_document.dump(following(bag)), encoding="utf-8")
    assert cli.main(["plan", "check", str(path)]) == 0
    assert "At any speed: the scene has no limit" in capsys.readouterr().out


def test_what_is_no_bag_is_refused(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        reference_motion(following(tmp_path / "nowhere"), read_run_motion)


def test_the_bag_of_another_manipulator_is_refused(bag):
    other = dataclasses.replace(scene.load("general"), motion=following(bag).motion)
    with pytest.raises(Exception, match="does not close the loops"):
        reference_motion(other, read_run_motion)
