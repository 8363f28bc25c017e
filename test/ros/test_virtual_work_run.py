# SPDX-License-Identifier: Apache-2.0
"""The paper's equations through the nodes: the same samples as by the default equations."""

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from sst_ros import Simulation, load_scene

pytestmark = pytest.mark.ros
PERIOD_NS = 2_000_000


@pytest.mark.parametrize("name", [pytest.param("example1", marks=pytest.mark.slow), "example2"])
def test_an_example_runs_by_the_equations_of_the_paper(nodes, observer, name):
    states = observer.listen(JointState, "/joint_states")
    simulator = nodes.run(
        "simulator", scene=name, equations="virtual_work", sync="lockstep", duration=0.05,
        real_time_factor=0.0,
    )  # fmt: skip
    observer.until(lambda: states, "preview")
    nodes.run("torque_player", scene=name, stamped=True)
    observer.until(lambda: simulator.poll() is not None, "end of the run")
    assert simulator.returncode == 0
    samples = [np.array(state.position) for state in states if observer.stamp(state)]
    assert len(samples) == 26
    simulation, profile = Simulation(name), load_scene(name).torque.at
    for k, sample in enumerate(samples):
        expected = simulation.state.joints
        np.testing.assert_allclose(
            sample[:9], [*expected.gamma, *expected.mu, *expected.beta], rtol=0.0, atol=1e-12
        )
        simulation.steps(profile((k + 0.5) * PERIOD_NS / 1e9), PERIOD_NS // 2, 2)
