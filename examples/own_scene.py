# SPDX-License-Identifier: Apache-2.0
"""Your own scene and your own torques over time: arrays, a table and a picture.

python examples/own_scene.py [own_scene.png]
"""

import sys
from math import cos, sin
from pathlib import Path

from sst_ros import load_scene, simulate

SCENE = Path(__file__).parent / "my_geometry.yaml"


def torque(t: float) -> tuple[float, float, float]:
    """Torques of the actuators [N m] at a time [s]."""
    return 0.3 * sin(6.0 * t), -0.2 * cos(4.0 * t), 0.1


# Every number of a scene has a key; others stay.
scene = load_scene(SCENE).with_values({"payload.mass": 0.2, "payload.centre": [0.0, 0.0, 0.2]})
motion = simulate(scene, torque, duration=1.0)
print(motion)
print("largest angles [rad]", motion.gamma.max(axis=0))
print(motion.to_pandas().head(3))
motion.plot().savefig(sys.argv[1] if len(sys.argv) > 1 else "own_scene.png")
