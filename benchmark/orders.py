# SPDX-License-Identifier: Apache-2.0
"""Measured orders of convergence, and energy over a long run with springs.

python -m benchmark.orders [--seconds 1000]
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace

from scipy.integrate import solve_ivp

from benchmark.measure import describe_machine, join_line
from sst_ros.dynamics import kernel
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.gauss import Collocation
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, RK4, RODAS4
from sst_ros.scene import scene as scenes
from sst_ros.simulation.simulation import Simulation

SPAN = 0.4
STEPS = {"rk4": 128, "dopri5": 128, "dop853": 16, "rodas4": 128}
WITHIN, MOST_DRIFT = 0.1, 1e-12


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and say whether the targets are met; the exit status is 0 either way."""
    parser = argparse.ArgumentParser(prog="python -m benchmark.orders", description=__doc__)
    parser.add_argument("--seconds", type=int, default=1000, help="of the run with springs")
    options = parser.parse_args(arguments)
    _orders()
    _energy(options.seconds)
    print("\n" + join_line(describe_machine("numpy", "scipy", "numba")))
    return 0


def _orders() -> None:
    """Truth: SciPy's DOP853 at its tightest, in short steps, on the kernel before tracing."""
    scene = scenes.load("example2_heavy")
    assert scene.torque is not None
    model, torque = kernel.model_of(scene), scene.torque.at
    state = Simulation(scene).state
    start = [*state.quaternion, *state.body_rate]
    truth = solve_ivp(
        lambda t, y: kernel.derivative(model, tuple(y), torque(t)),
        (0.0, SPAN), start, method="DOP853", rtol=2.3e-14, atol=1e-15, max_step=0.002,
    ).y[:, -1]  # fmt: skip
    system = ODE(Dynamics.of(scene), scene.torque)
    print(f"Orders on example2_heavy, {SPAN} s: error with n steps and with 2 n")

    def show(name: str, order: int, n: int, errors: list[float]) -> None:
        found = math.log(errors[0] / errors[1]) / math.log(2.0)
        met = "met" if abs(found - order) <= WITHIN else "MISSED"
        sizes = f"{n:6} steps {errors[0]:9.1e} {errors[1]:9.1e}"
        print(f"{name:8}{sizes}  order {found:.3f} of {order}, target +-{WITHIN}: {met}")

    for method in (RK4, DORMAND_PRINCE, DOP853, RODAS4):
        runner, n = CompiledMethod(system, method, compiled=False), STEPS[method.name]
        ends = [runner.step_fixed(0.0, SPAN / k, k, start, []) for k in (n, 2 * n)]
        show(method.name, method.order, n, [math.dist(end, truth) for end in ends])
    for nodes, n in ((2, 64), (4, 12)):
        gauss = Collocation(system, nodes, compiled=False)
        motions = [gauss.prepare(0.0, SPAN / k, k, start, iterations=20) for k in (n, 2 * n)]
        for motion in motions:
            motion.run()
        ends = [motion.end for motion in motions]
        show(f"gauss {nodes}", 2 * nodes, n, [math.dist(end, truth) for end in ends])


def _energy(seconds: int) -> None:
    scene = replace(scenes.load("gravity_payload"), friction=None)
    simulation = Simulation(scene, "dop853", tolerance=1e-14, compiled=True)
    stored = simulation.dynamics.total_energy(simulation.sample[0])
    scale, worst = max(abs(stored), 1.0), 0.0
    for _ in range(seconds * 100):
        simulation.step((0.0, 0.0, 0.0), 10_000_000)
        worst = max(worst, abs(simulation.energy_residual))
    met = "met" if worst / scale <= MOST_DRIFT else "MISSED"
    print(f"\nEnergy with springs, dop853, {seconds} s: off by {worst / scale:.1e}"
          f" of {scale:.2g} J, target {MOST_DRIFT:.0e}: {met}")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
