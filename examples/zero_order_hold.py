# SPDX-License-Identifier: Apache-2.0
"""Zero-order hold: error of sampled torques
=========================================

Torques that are held over a period and taken at its start give an error of first order
in the period; taken at its middle, of second order.
"""

import matplotlib.pyplot as plt
import numpy as np

from sst_ros import TorqueTable, load_scene, simulate

scene = load_scene("example2_heavy")
exact = simulate(scene, tolerance=1e-12).gamma[-1]
periods = np.array([0.02, 0.01, 0.005, 0.002])
errors = {"start of the hold": [], "middle of the hold": []}
for period in periods:
    times = np.arange(0.0, 1.0, period)
    for (_, values), shift in zip(errors.items(), (0.0, 0.5), strict=True):
        a, f, p = (
            np.array(x)
            for x in (
                scene.torque.amplitude,
                scene.torque.frequency,
                scene.torque.phase,
            )
        )
        held = TorqueTable(times, a * np.sin(f * (times[:, None] + shift * period) + p))
        end = simulate(scene, held, 1.0, t_eval=[0.0, 1.0]).gamma[-1]
        values.append(np.abs(end - exact).max())

figure, axes = plt.subplots(figsize=(6.5, 4.0), layout="constrained")
for (name, values), style in zip(errors.items(), ("o-", "s--"), strict=True):
    order = np.polyfit(np.log(periods), np.log(values), 1)[0]
    axes.loglog(1e3 * periods, values, style, label=f"{name}: order {order:.1f}")
axes.set(xlabel="period of the hold [ms]", ylabel="largest error of γ at 1 s [rad]")
axes.grid(alpha=0.3, which="both")
axes.set_xticks(1e3 * periods, [f"{1e3 * period:g}" for period in periods])
axes.minorticks_off()
axes.legend()
figure.savefig("zero_order_hold.png")
