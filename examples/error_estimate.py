# SPDX-License-Identifier: Apache-2.0
"""Error estimate against true error
=================================

The global error of the orientation is estimated online. Here it is compared, over the
length of the motion, with the difference from a much finer solution.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import Simulation, load_scene

STEP_NS, COUNT = 50_000_000, 100
scene = load_scene("swing")
coarse = Simulation(scene, "dopri5", tolerance=1e-8)
fine = Simulation(scene, "dop853", tolerance=1e-14)
time, estimate, error = [], [], []
for _ in range(COUNT):
    states = [s.step((0.0, 0.0, 0.0), STEP_NS) for s in (coarse, fine)]
    a, b = (np.array(state.quaternion) for state in states)
    time.append(states[0].time_ns / 1e9)
    error.append(2.0 * min(np.linalg.norm(a - b), np.linalg.norm(a + b)))
    estimate.append(coarse.error_estimate)

figure, axes = plt.subplots(figsize=(6.5, 4.0), layout="constrained")
axes.semilogy(time, error, label="true error")
axes.semilogy(time, estimate, "--", label="error estimate")
axes.set(
    xlabel="time t [s]",
    ylabel="orientation [rad]",
    title="dopri5, tolerance 1e-8 per step",
)
axes.grid(alpha=0.3)
axes.legend(loc="lower right")
figure.savefig("error_estimate.png")
