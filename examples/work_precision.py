# SPDX-License-Identifier: Apache-2.0
"""Work-precision diagram of the integration methods
=================================================

Error of the orientation at the end against evaluations of the equations of motion,
under constant torques. ``sst-ros report accuracy`` makes the full diagram with
processor times.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import simulate

TORQUE, DURATION = (0.5, -0.2, 0.1), 0.8  # N m, s


def run(method, tolerance, steps):
    """Simulate with a tolerance, returning states at the ends of `steps` equal
    intervals.
    """
    return simulate(
        "example2_heavy",
        TORQUE,
        DURATION,
        method=method,
        tolerance=tolerance,
        t_eval=np.linspace(0.0, DURATION, steps + 1),
    )


end = run("dop853", 1e-14, 20).quaternion[-1]
settings = {
    "rk4": [(1.0, steps) for steps in (2, 4, 8, 16, 32, 64, 128)],
    "dopri5": [(10.0**-k, 1) for k in range(2, 12)],
    "dop853": [(10.0**-k, 1) for k in range(2, 12)],
    "rodas5p": [(10.0**-k, 1) for k in range(2, 8)],
}
figure, axes = plt.subplots(figsize=(6.5, 4.5), layout="constrained")
for (method, values), marker in zip(settings.items(), "o^sD", strict=True):
    found = [run(method, *value) for value in values]
    errors = [2.0 * np.linalg.norm(motion.quaternion[-1] - end) for motion in found]
    axes.loglog(
        [motion.evaluations for motion in found], errors, marker=marker, label=method
    )
axes.set(
    xlabel="evaluations (a Jacobian counts as 30)",
    ylabel="error of the orientation [rad]",
)
axes.grid(alpha=0.3)
axes.legend()
figure.savefig("work_precision.png")
