# SPDX-License-Identifier: Apache-2.0
"""Runs of which a part is not recorded: nothing is made up in between."""

import dataclasses
import pickle

import numpy as np
import pytest

from sst_ros import Trajectory, simulate
from sst_ros.errors import InputError
from sst_ros.recording import recording
from sst_ros.recording.recording import read_run_motion
from sst_ros.scene import scene
from sst_ros.state import nanoseconds

GAP_NS = 5_000_000_000


def shifted(bags, entries, by_ns):
    """The same messages later, stamps included."""
    found = []
    for entry in entries:
        content = entry.content
        if hasattr(content, "header") and (stamp := nanoseconds(content.header.stamp)):
            moved = dataclasses.replace(content.header, stamp=bags.time(stamp + by_ns))
            content = dataclasses.replace(content, header=moved)
        received = entry.received_ns + by_ns
        found.append(dataclasses.replace(entry, received_ns=received, content=content))
    return found


@pytest.fixture(scope="module")
def twice(bags):
    """Messages of two runs of 0.1 s one after the other, with nothing in between."""
    once = bags.simulated(scene.load("example2"), 0.1)
    again = [one for one in once if one.sample >= 0]
    return [*once, *shifted(bags, again, GAP_NS)]


@pytest.fixture
def motion(read, twice):
    return read(twice).trajectory


@pytest.mark.parametrize("time", [2.0, 0.1000001, 4.999, [0.05, 2.0]])
def test_a_time_in_a_gap_is_refused_with_the_gap(motion, time):
    with pytest.raises(
        InputError, match=r"t = .*: nothing is known of the motion from 0.1 to 5 s"
    ):
        motion.at(time)


def test_beside_a_gap_and_at_its_ends_the_motion_is_known(motion):
    known = [0.0, 0.033, 0.1, 5.0, 5.0333, 5.1]
    found = motion.at(known)
    assert found.gamma[[0, 2]] == pytest.approx(motion.gamma[[0, 50]], abs=0.0)
    assert found.gamma[:3] == pytest.approx(found.gamma[[3, 4, 5]], abs=2e-3)


def test_a_gap_goes_with_the_motion(motion, tmp_path):
    motion.save(tmp_path / "motion.npz")
    others = {
        "loaded": Trajectory.load(tmp_path / "motion.npz"),
        "copied": pickle.loads(pickle.dumps(motion)),
        "sampled": motion.at([0.0, 5.05]),
        "cut": motion[10:80],
    }
    for other in others.values():
        with pytest.raises(InputError, match=r"from 0.1 to 5 s"):
            other.at(3.0)


def test_a_motion_with_a_gap_is_none_to_be_followed(written, twice):
    with pytest.raises(InputError, match=r"orientation.*from 0.1 to 5 s"):
        read_run_motion(written(twice))


def test_lost_samples_are_no_gap_where_the_torques_are_known(read, bags, example2):
    """The motion between them follows from the torques."""
    kept = [
        one for one in example2
        if not (one.topic in (bags.JOINTS, bags.ORIENTATION) and 20 < one.sample < 60)
    ]  # fmt: skip
    known, whole = read(kept).trajectory, read(example2).trajectory
    times = [0.05, 0.09, 0.1111]
    assert known.at(times).gamma == pytest.approx(whole.at(times).gamma, abs=1e-10)
    unapplied = [
        one for one in kept if one.topic != bags.APPLIED or not 20 < one.sample < 60
    ]
    with pytest.raises(InputError, match=r"from 0.04 to 0.12 s"):
        read(unapplied).trajectory.at(0.1)


def test_gaps_of_own_data_are_spans(tmp_path):
    run = simulate("example2", duration=0.1)
    arrays = run.t, run.quaternion, run.body_rate, run.torque
    with pytest.raises(InputError, match=r"gaps = .*: must be rising pairs of times"):
        Trajectory(run.scene, *arrays, gaps=[[0.05, 0.02]])
    with pytest.raises(InputError, match=r"gaps = .*: must be rising pairs of times"):
        Trajectory(run.scene, *arrays, gaps=[0.05, np.nan])
    motion = Trajectory(run.scene, *arrays, gaps=[[0.02, 0.05]])
    with pytest.raises(InputError, match=r"from 0.02 to 0.05 s"):
        motion.at(0.03)
    assert recording.Trajectory(run.scene, *arrays).gaps.shape == (0, 2)
