# SPDX-License-Identifier: Apache-2.0
"""Energy conservation
===================

A tool under gravity, hung in springs: kinetic and potential energy are exchanged, and
their sum stays constant to rounding.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import load_scene, simulate
from sst_ros.dynamics import kernel
from sst_ros.dynamics.kernel import model_of

scene = load_scene("gravity_payload")
times = np.linspace(0.0, 2.0, 201)
motion = simulate(scene, duration=2.0, t_eval=times, method="dop853", tolerance=1e-13)
kinetic = kernel.kinetic_energy(
    model_of(scene), (*motion.quaternion.T, *motion.body_rate.T)
)
potential = motion.energy - kinetic

figure, (above, below) = plt.subplots(
    2, 1, sharex=True, figsize=(6.5, 5.0), layout="constrained"
)
above.plot(motion.t, kinetic, label="kinetic")
above.plot(motion.t, potential - potential[0], "--", label="potential, change")
above.set(ylabel="energy [J]")
above.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
below.plot(motion.t, (motion.energy - motion.energy[0]) * 1e15)
below.set(xlabel="time t [s]", ylabel="change of the sum [1e-15 J]")
figure.savefig("energy.png")
