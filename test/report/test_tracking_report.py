# SPDX-License-Identifier: Apache-2.0
"""The report of a run that followed a reference, from bags that the test wrote."""

import dataclasses

import bags
import numpy as np
import pytest

from sst_ros.errors import InputError
from sst_ros.mechanism.frames import angle_between
from sst_ros.recording import recording
from sst_ros.report import tracking
from sst_ros.scene import scene

HOME = np.array(scene.load("example2").initial.gamma)
OFF = np.array([0.01, -0.02, 0.03])
STILL = np.zeros(3)


@pytest.fixture(scope="module")
def entries():
    plain = bags.simulated(scene.load("example2"), 0.1)
    return bags.tracked(plain, lambda _: (HOME + OFF, STILL))


def test_the_track_is_what_was_written(entries, written):
    bag = written(entries)
    followed = tracking.read_tracking(bag)
    run, track = recording.read(bag), followed.track
    assert len(track.time) == 51 and track.time[-1] == pytest.approx(0.1)
    assert track.gamma == pytest.approx(np.tile(HOME + OFF, (51, 1)))
    assert track.gamma - track.error == pytest.approx(run.gamma)
    # The torque of a sample is that of the tick that begins there; after the last there is none.
    begins = np.isin(run.ticks.start_ns, run.time_ns)
    assert np.array_equal(track.torque[:-1], run.ticks.torque[begins])
    assert not track.torque[-1].any()
    largest = np.abs(HOME + OFF - run.gamma).max(axis=0)
    assert followed.metrics.largest == pytest.approx(largest)


def test_the_error_of_the_orientation_is_the_angle_to_that_of_the_reference(entries, written):
    plain = bags.without(entries, bags.DESIRED, bags.ERROR)
    followed = tracking.read_tracking(written(bags.tracked(plain, lambda _: (HOME, STILL))))
    q = followed.recording.quaternion
    assert followed.orientation_error.max() > 1e-3
    assert followed.orientation_error == pytest.approx(angle_between(q, q[0]), abs=1e-12)


def test_the_last_report_of_the_controller_says_how_often_a_torque_was_limited(entries, written):
    said = bags.diagnostics_entry(entries[-1].received_ns + 1, samples_limited=7)
    said.content.status[0].name = "/sst_inverse_dynamics: control"
    assert tracking.read_tracking(written([*entries, said])).metrics.limited == 7


def test_the_report_writes_a_table_and_a_picture(entries, written, tmp_path):
    told = tracking.write_tracking_report(written(entries), tmp_path)
    assert (tmp_path / "tracking.txt").read_text(encoding="utf-8") == told
    assert "error, largest" in told and "nan" not in told
    for name in ("tracking", "tracking_error", "control_torques"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000


def test_a_recording_without_a_reference_is_refused(entries, written, tmp_path):
    with pytest.raises(InputError, match="reference"):
        tracking.write_tracking_report(written(bags.without(entries, bags.DESIRED)), tmp_path)


def test_messages_of_other_joints_are_refused(entries, written):
    names = {"name": ["a", "b", "c"]}
    renamed = bags.edited(entries, bags.ERROR, 3, lambda one: dataclasses.replace(one, **names))
    with pytest.raises(InputError, match="tracking_error"):
        tracking.read_tracking(written(renamed))
