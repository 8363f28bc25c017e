# SPDX-License-Identifier: Apache-2.0
"""Random scenes with ranges, converted documents, contacts and clamps: no corner lies
outside.

The other motions are those of `simulate` at a tolerance of 1e-12, whose own estimate is
allowed.
"""

import itertools

import numpy as np
import pytest
from slow_cases import slow_except

from sst_ros import certify, load_scene, simulate
from sst_ros.mechanism.geometry import angle_between

END, COUNT = 0.1, 60  # s


def draw(number):
    """A scene with a converted document, a contact or clamp, or neither.

    And its ranges.
    """
    rng = np.random.default_rng([51, number])
    values = {"stroke.at_end": "ignore", "workspace.at_edge": "ignore"}
    values["initial.orientation"] = None
    values["initial.gamma"] = tuple(rng.uniform(0.65, 0.95, 3).tolist())
    values["initial.gamma_dot"] = tuple(rng.uniform(-1.0, 1.0, 3).tolist())
    values["torque"] = {
        "amplitude": rng.uniform(-3.0, 3.0, 3).tolist(),
        "frequency": rng.uniform(2.0, 30.0, 3).tolist(),
        "phase": rng.uniform(0.0, 6.0, 3).tolist(),
    }
    kind = number % 3
    if kind == 0:
        arcs = rng.uniform(86.0, 94.0, 3).tolist()
        values["base"] = {"arcs_deg": arcs, "radius": 0.35}
    if kind == 1:
        values["actuators"] = {"torque_limit": float(rng.uniform(0.5, 2.5))}
    if kind == 2:
        values["initial.gamma"] = (0.05, *rng.uniform(0.06, 0.15, 2).tolist())
        values["initial.gamma_dot"] = (-1.0, *rng.uniform(-0.5, 0.5, 2).tolist())
        stiffness, restitution = rng.uniform(500.0, 20000.0), rng.uniform(0.4, 0.9)
        values["stroke"] = {
            "at_end": "elastic", "stiffness": float(stiffness),
            "restitution": float(restitution), "impact_rate": 1.0,
        }  # fmt: skip
    scene = load_scene("general").with_values(values)
    width = float(10.0 ** rng.uniform(-7.0, -5.0))
    keys = ["star.inertia.zz", "initial.gamma_dot[1]", "star.alpha_deg[0]"]
    if number % 2:
        return scene, {}
    return scene, dict.fromkeys(keys, width)


def changed(scene, ranges, signs):
    """The scene at a corner of its ranges."""
    width = next(iter(ranges.values()), 0.0)
    alpha, rate = list(scene.star.alpha_deg), list(scene.initial.gamma_dot)
    alpha[0], alpha[2] = alpha[0] + signs[2] * width, alpha[2] - signs[2] * width
    rate[1] += signs[1] * width
    zz = scene.star.inertia.zz + signs[0] * width
    values = {
        "star.inertia.zz": zz,
        "initial.gamma_dot": tuple(rate),
        "star.alpha_deg": tuple(alpha),
    }
    return scene.with_values(values)


def compare(number):
    """Most true distance over what is proven; None where the proof ends before."""
    scene, ranges = draw(number)
    proven = certify(scene, None, END, t_eval=[END], ranges=ranges, tolerance=1e-7)
    if proven.reason:
        return None, proven.reason
    corners = list(itertools.product((-1, 1), repeat=3)) if ranges else [(0, 0, 0)]
    worst = 0.0
    for signs in corners:
        other = changed(scene, ranges, signs) if ranges else scene
        motion = simulate(other, None, END, t_eval=[END], tolerance=1e-12)
        apart = float(
            angle_between(motion.quaternion[-1], proven.trajectory.quaternion[-1])
        )
        worst = max(worst, (apart - motion.error_estimate - 1e-14) / proven.error)
    return worst, ""


@pytest.mark.parametrize("number", slow_except([0], [0, 2, 5]))
def test_a_random_corner_lies_inside(number):
    worst, reason = compare(number)
    assert not reason and worst <= 1.0


@pytest.mark.slow
@pytest.mark.search
@pytest.mark.timeout(3600)
def test_all_random_corners_lie_inside():
    found = [compare(number) for number in range(COUNT)]
    proven = [worst for worst, _ in found if worst is not None]
    assert max(proven) <= 1.0 and len(proven) > 0.8 * COUNT
