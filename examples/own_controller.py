# SPDX-License-Identifier: Apache-2.0
"""Your own controller without ROS: a function of time and state, sampled and held at 500 Hz.

python examples/own_controller.py [own_controller.png]
"""

import sys

import numpy as np

from sst_ros import InverseDynamics, State, load_scene, simulate

GOAL = np.array([0.95, 0.70, 0.80])  # rad
STIFFNESS, DAMPING = 40.0, 6.0  # N m/rad, N m s/rad

scene = load_scene("gravity_payload")
inverse = InverseDynamics(scene)


def gravity_pd(t: float, state: State) -> np.ndarray:
    """PD control with gravity compensation (Takegaki and Arimoto 1981): torques [N m]."""
    error = GOAL - state.joints.gamma
    weight = np.array(inverse.gravity_torque(state))
    return STIFFNESS * error - DAMPING * np.array(state.joints.gamma_dot) + weight


motion = simulate(scene, gravity_pd, duration=3.0, control_period=0.002)
print("error at the end [rad]", GOAL - motion.gamma[-1])
motion.plot().savefig(sys.argv[1] if len(sys.argv) > 1 else "own_controller.png")
