# SPDX-License-Identifier: Apache-2.0
"""Own controller without ROS: PD with gravity compensation
========================================================

A function of time and state, sampled and held at 500 Hz (zero-order hold), as a digital
controller. As a ROS 2 node, free running or in lockstep, it is ``controller.py``.
"""

import numpy as np

from sst_ros import InverseDynamics, State, load_scene, simulate

GOAL = np.array([0.95, 0.70, 0.80])  # rad
STIFFNESS, DAMPING = 40.0, 6.0  # N m/rad, N m s/rad

scene = load_scene("gravity_payload")
inverse = InverseDynamics(scene)


def gravity_pd(t: float, state: State) -> np.ndarray:
    """Return PD torques [N m] with gravity compensation.

    The control law is that of Takegaki and Arimoto (1981).
    """
    error = GOAL - state.joints.gamma
    weight = np.array(inverse.gravity_torque(state))
    return STIFFNESS * error - DAMPING * np.array(state.joints.gamma_dot) + weight


motion = simulate(scene, gravity_pd, duration=3.0, control_period=0.002)
print("error at the end [rad]", GOAL - motion.gamma[-1])

figure = motion.plot()
figure.savefig("own_controller.png")
