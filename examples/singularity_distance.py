# SPDX-License-Identifier: Apache-2.0
"""Distance to singularities along a motion
========================================

Condition number of the Jacobian from actuator rates to the angular velocity of the
star, and the determinant of J2, which is zero at a parallel singularity.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import Geometry, load_scene, simulate
from sst_ros.mechanism.geometry import rotation_matrix
from sst_ros.mechanism.workspace import measures

scene = load_scene("example2_heavy")
motion = simulate(scene, t_eval=np.linspace(0.0, 1.0, 201))
rotation = np.array([rotation_matrix(q) for q in motion.quaternion])
found = measures(Geometry.of(scene), motion.gamma, rotation)

figure, (above, below) = plt.subplots(
    2, 1, sharex=True, figsize=(6.5, 5.0), layout="constrained"
)
above.plot(motion.t, found.cond_j)
above.set(ylabel="condition number of J")
below.plot(motion.t, found.det_j2, label="det J2")
below.plot(motion.t, np.sin(found.mu).min(axis=1), "--", label="least sin μₖ")
below.axhline(0.0, color="k", linewidth=0.8)
below.set(xlabel="time t [s]", ylabel="0 at a singularity")
below.legend()
figure.savefig("singularity_distance.png")
