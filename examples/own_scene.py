# SPDX-License-Identifier: Apache-2.0
"""Own scene and own torque function
=================================

A geometry of your own with a payload, driven by torques that are a function of time:
arrays, a table and a picture.
"""

from math import cos, sin

from sst_ros import load_scene, simulate


def torque(t: float) -> tuple[float, float, float]:
    """Torques of the actuators [N m] at a time [s]."""
    return 0.3 * sin(6.0 * t), -0.2 * cos(4.0 * t), 0.1


# Every number of a scene has a key; the others keep their values.
scene = load_scene("my_geometry.yaml").with_values(
    {"payload.mass": 0.2, "payload.centre": [0.0, 0.0, 0.2]}
)
motion = simulate(scene, torque, duration=1.0)
print(motion)
print("largest angles [rad]", motion.gamma.max(axis=0))
print(motion.to_pandas()[["gamma_1", "torque_1", "energy"]].describe())

figure = motion.plot()
figure.savefig("own_scene.png")
