# SPDX-License-Identifier: Apache-2.0
"""joint_states as a robot gives them, beside the true ones."""

import numpy as np
import pytest
from ros.conftest import NODE
from sensor_msgs.msg import JointState

pytestmark = pytest.mark.ros
TRUE = f"{NODE}/true_joint_states"
RATE, PERIOD = 200, 0.005


def measured(nodes, observer, *, sync="lockstep", seconds=1.0, **given):
    """Stamps [ns], angles and rates as they are measured and as they are, in a run of
    example2.
    """
    heard = observer.states, observer.listen(JointState, TRUE)
    begun = [len(messages) for messages in heard]
    waits = f"[joint_states,{TRUE}]"
    simulator = nodes.run(
        "simulator", sync=sync, duration=seconds, publish_rate=RATE,
        wait_for_subscribers=waits, real_time_factor=0.0 if sync == "lockstep" else 4.0,
        **given,
    )  # fmt: skip
    if sync == "lockstep":
        nodes.run("torque_player", rate=RATE)
    observer.until(lambda: simulator.poll() is not None, "the end", 100.0)
    count = round(seconds * RATE) + 1
    observer.until(
        lambda: len(observer.stamps(heard[1][begun[1] :])) == count, "all samples"
    )
    found = []
    for messages, first in zip(heard, begun, strict=True):
        run = [one for one in messages[first:] if observer.stamp(one)]
        rows = [(*one.position, *one.velocity) for one in run]
        found.append((np.array([observer.stamp(one) for one in run]), np.array(rows)))
    return found


@pytest.mark.breadth
def test_noise_is_that_of_the_parameters_and_repeats_by_seed(nodes, observer):
    noise = {"angle_noise": 1e-3, "rate_noise": 0.1, "measurement_seed": 7}
    (stamps, seen), (true_stamps, true) = measured(nodes, observer, **noise)
    assert len(stamps) == 201 and np.array_equal(stamps, true_stamps)
    off = seen - true
    # The deviation of 9 x 201 numbers is known to 1 / sqrt(2 n) = 1.7 %.
    assert off[:, :9].std() == pytest.approx(1e-3, rel=0.07)
    assert off[:, 9:].std() == pytest.approx(0.1, rel=0.07)
    # of one joint and another: 1 / 14
    assert np.abs(np.corrcoef(off.T) - np.eye(18)).max() < 0.4
    (_, again), (_, same) = measured(nodes, observer, **noise)
    assert np.array_equal(again, seen) and np.array_equal(same, true)


def test_encoders_count_and_what_is_late_is_what_was(nodes, observer):
    counts, delay = 4096, 3
    given = {"encoder_counts": counts, "measurement_delay": delay}
    (stamps, seen), (true_stamps, true) = measured(nodes, observer, **given)
    assert np.array_equal(stamps, true_stamps)
    step = 2.0 * np.pi / counts
    angles = seen[:, :9] / step
    assert np.abs(angles - np.round(angles)).max() < 1e-9
    assert np.abs(seen[delay:, :9] - true[:-delay, :9]).max() <= 0.5 * step * (
        1.0 + 1e-9
    )
    rates = np.diff(seen[:, :9], axis=0) / PERIOD
    np.testing.assert_allclose(seen[delay + 1 :, 9:], rates[delay:], rtol=0, atol=1e-9)


def test_samples_are_dropped_in_the_share_that_is_asked_for(nodes, observer):
    (stamps, seen), (all_stamps, true) = measured(
        nodes, observer, sync="free", seconds=5.0, dropped_samples=0.3
    )
    assert set(stamps) < set(all_stamps)
    share = 1.0 - len(stamps) / len(all_stamps)
    assert share == pytest.approx(0.3, abs=0.06)  # four deviations of 1001 samples
    assert np.array_equal(seen, true[np.isin(all_stamps, stamps)])


def test_in_lockstep_no_sample_may_be_dropped(run_here):
    status, _, err = run_here("simulator", sync="lockstep", dropped_samples=0.1)
    assert status == 1 and "dropped_samples = 0.1: must be 0 in lockstep" in err
