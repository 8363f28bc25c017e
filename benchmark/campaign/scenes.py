# SPDX-License-Identifier: Apache-2.0
"""Random scenes held to their invariants.

Hostile documents and extreme numbers are tests.
"""

from __future__ import annotations

import math
import random
import warnings
from typing import Any, TypeAlias

import yaml

from benchmark.campaign.ledger import Ledger
from benchmark.plain_python import without_llvmlite
from sst_ros import Simulation
from sst_ros.mechanism.geometry import angle_between
from sst_ros.scene.scene import Scene, text_of
from sst_ros.scene.yaml_document import read
from studies.estimate import CLASSES, measure

PERIOD_NS = 1_000_000
Torque: TypeAlias = Any  # what `Simulation.step` takes


def needle() -> str:
    """Return scene `swing` with a star whose first step of 1 ms would take a minute."""
    tree = yaml.safe_load(text_of("swing")[0])
    tree["star"]["inertia"] = {"xx": 1.0, "yy": 1.0, "zz": 1e-12}
    tree |= {"actuated_links": [{}], "intermediate_links": [{}]}
    return yaml.dump(
        {**tree, "stroke": {"at_end": "ignore"}, "workspace": {"at_edge": "ignore"}}
    )


def _finite(ledger: Ledger, name: str, state: Any) -> None:
    numbers = (
        *state.quaternion,
        *state.body_rate,
        *state.joints.gamma,
        *state.joints.gamma_dot,
    )
    if not all(map(math.isfinite, numbers)):
        ledger.add_finding("silent", f"{name}: a number is not finite")


def random_scene(rng: random.Random) -> Scene:
    """Return a physical scene: random geometry, inertias, loads and start."""
    tree = yaml.safe_load(text_of("general" if rng.random() < 0.3 else "swing")[0])
    tree["description"] = "campaign"
    tree["duration"] = 0.2
    for key in (
        "motion",
        "torque",
        "friction",
        "springs",
        "gravity",
        "payload",
        "actuators",
    ):
        tree.pop(key, None)
    scale = 10 ** rng.uniform(-1, 1)
    x, y = (rng.uniform(0.5, 1.5) * scale for _ in range(2))
    z = rng.uniform(abs(x - y) + 0.01 * scale, x + y)
    tree["star"]["inertia"] = {"xx": x, "yy": y, "zz": z}
    if rng.random() < 0.5:
        tree["gravity"] = {"acceleration": [rng.uniform(-9.81, 9.81) for _ in range(3)]}
        tree["payload"] = {
            "mass": rng.uniform(0.1, 3),
            "centre": [0, 0, rng.uniform(0, 0.3)],
        }
    if rng.random() < 0.5:
        joint_kind = rng.choice(("gamma", "mu", "beta"))
        rubbing = {"viscous": rng.uniform(0, 1), "coulomb": rng.uniform(0, 0.5)}
        if rng.random() < 0.5:  # Stribeck
            rubbing |= {
                "static": 2.0 * rubbing["coulomb"],
                "stribeck": 10 ** rng.uniform(-2, 0),
            }
        tree["friction"] = {joint_kind: rubbing}
    if rng.random() < 0.4:
        joint = f"{rng.choice(('gamma', 'mu', 'beta'))}_{rng.randint(1, 3)}"
        tree["springs"] = [
            {"joint": joint, "stiffness": 10 ** rng.uniform(-1, 2), "rest": 0.8}
        ]
    if rng.random() < 0.3:
        tree["actuators"] = {"torque_limit": rng.uniform(0.5, 5), "rotor_inertia": 1e-4}
        if rng.random() < 0.5:
            tree["actuators"]["time_constant"] = 10 ** rng.uniform(-4, -1)
    if rng.random() < 0.3:
        stop = {"stiffness": 10 ** rng.uniform(2, 5), "damping": rng.uniform(0, 1)}
        tree["stroke"] = {"at_end": "elastic", **stop}
    tree["initial"]["gamma_dot"] = [rng.uniform(-1, 1) for _ in range(3)]
    return read(Scene, yaml.dump(tree), "scene")


def invariants(ledger: Ledger) -> None:
    """Simulate random scenes: finite, closed, energy balanced, error estimated."""
    rng = ledger.rng
    for number in ledger.numbers(434, least=8):
        name = f"scene {number} (seed {ledger.seed})"
        with ledger.case(name, bound=20.0):
            scene = random_scene(rng)
            fine = Simulation(scene, tolerance=1e-13)
            plain = Simulation(scene, tolerance=1e-9)
            torque = _draw_torque(rng)
            for _ in range(100):
                _finite(ledger, name, plain.step(torque, PERIOD_NS))
                fine.step(torque, PERIOD_NS)
            if not plain.closure_residual < 1e-14:
                ledger.add_finding(
                    "silent", f"{name}: closure {plain.closure_residual:.1e}"
                )
            energy = sum(abs(x) for x in fine.state.body_rate) ** 2
            if not abs(plain.energy_residual) < 1e-7 * (1 + energy):
                ledger.add_finding(
                    "silent", f"{name}: energy residual {plain.energy_residual:.1e} J"
                )
            error = float(angle_between(plain.state.quaternion, fine.state.quaternion))
            if (
                error > 1e-12
                and error > 3 * plain.error_estimate + 3 * fine.error_estimate
            ):
                note = f"{name}: error {error:.1e}, estimate {plain.error_estimate:.1e}"
                ledger.add_finding("silent", note)


def _draw_torque(rng: random.Random) -> Torque:
    """Three numbers, or a function of time that jumps, or has a pulse."""
    torque, later_torque = ([rng.uniform(-2, 2) for _ in range(3)] for _ in range(2))
    begin, end = sorted(rng.uniform(0, 0.1) for _ in range(2))
    functions = (
        lambda t: torque if t < begin else later_torque,
        lambda t: torque if begin < t < end else later_torque,
    )
    return rng.choice((tuple(torque), *functions))


def estimates(ledger: Ledger) -> None:
    """Compare the error estimate with the true error, by the bounds of the page of
    estimates.
    """
    for number in ledger.numbers(60):
        for name in CLASSES:
            with ledger.case(f"{name} {number} (seed {ledger.seed})", bound=120.0):
                row = measure((name, ledger.seed, number))
                if row["state"] != "resolved":
                    continue
                error, estimate = row["error"], row["estimate"]
                within = row["status"] == 2 or error <= 3 * row["tolerance"]
                bound = 3 * estimate
                if name == "saturated_feedback":  # see the page
                    bound = max(bound, row["tolerance"])
                if error > bound or not within:
                    note = (
                        f"{name} {number}: error {error:.1e}, estimate {estimate:.1e}"
                    )
                    ledger.add_finding("silent", note)


def bits(ledger: Ledger) -> None:
    """Simulate random scenes as machine code and as plain Python: not one bit may
    differ.
    """
    rng = random.Random(ledger.seed + 1)
    for number in ledger.numbers(200):
        name = f"scene {number} (seed {ledger.seed + 1})"
        method = (
            rng.choice(("rk4", "dopri5", "dop853", "rodas5p"))
            if number % 10
            else "auto"
        )
        with ledger.case(f"{name} {method}", bound=120.0), warnings.catch_warnings():
            warnings.simplefilter("error")
            scene = random_scene(rng)
            torque = rng.uniform(-2, 2), rng.uniform(-2, 2), rng.uniform(-2, 2)
            run = Simulation(scene, method)
            fast_states = [run.step(torque, PERIOD_NS) for _ in range(40)]
            with without_llvmlite():
                run = Simulation(scene, method)
                plain_states = [run.step(torque, PERIOD_NS) for _ in range(40)]
            for plain, fast in zip(plain_states, fast_states, strict=True):
                if plain != fast:
                    ledger.add_finding(
                        "silent", f"{name} {method}: bits differ at {plain.time_ns} ns"
                    )
                    break
