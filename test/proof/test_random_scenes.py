# SPDX-License-Identifier: Apache-2.0
"""200 random smooth scenes: solutions of 60 digits lie inside of what is proven."""

import numpy as np
import pytest
from mpmath import mp, mpf
from slow_cases import slow_after

from sst_ros import SineTorque, certify, load_scene
from studies.sixty_digits import Motion, angle

REST = (0.0, 0.0, 0.0)
END, COUNT = 0.05, 200  # s; the truth of a scene takes about as long as its proof
SCENES = ("example2_heavy", "general", "gravity_payload")


def draw(number):
    """A scene with one of: nothing more, a lag, tanh friction, an external moment."""
    rng = np.random.default_rng([36, number])
    values = {
        "stroke.at_end": "ignore",
        "workspace.at_edge": "ignore",
        "initial.orientation": None,
    }
    name, kind = str(rng.choice(SCENES)), int(rng.integers(4))
    values["initial.gamma"] = tuple(rng.uniform(0.65, 0.95, 3).tolist())
    values["initial.gamma_dot"] = tuple(rng.uniform(-1.0, 1.0, 3).tolist())
    if kind == 1:
        values["actuators"] = {"time_constant": float(10.0 ** rng.uniform(-2.5, -1.0))}
    if kind == 2:
        level, smoothing = rng.uniform(0.01, 0.3), rng.uniform(0.3, 1.0)
        friction = {
            "viscous": 0.3,
            "coulomb": float(level),
            "smoothing": float(smoothing),
        }
        values["friction"] = {"gamma": friction}
    if kind == 3:
        values["moment"] = {"value": tuple(rng.uniform(-1.0, 1.0, 3).tolist())}
    rows = (
        rng.uniform(-2.0, 2.0, 3),
        rng.uniform(2.0, 20.0, 3),
        rng.uniform(0.0, 6.28, 3),
    )
    amplitude, frequency, phase = (tuple(row.tolist()) for row in rows)
    torque = SineTorque(amplitude=amplitude, frequency=frequency, phase=phase)
    return load_scene(name).with_values(values), torque


def compare(number):
    """Bounds of the table and of the error of simulate, each over the true one.

    One rate.
    """
    scene, torque = draw(number)
    proven = certify(scene, torque, END, t_eval=[END])
    assert proven.success and proven.until == END
    y, columns = Motion(scene, torque).at(END), proven.columns
    true = angle(y[:4], [columns[f"quaternion_{part}"][0] for part in "xyzw"])
    error = angle(y[:4], proven.trajectory.quaternion[0])
    with mp.workdps(40):
        rates = [
            abs(x - mpf(columns[f"body_rate_{part}"][0]))
            <= columns[f"body_rate_{part}_bound"][0]
            for x, part in zip(y[4:7], "xyz", strict=True)
        ]
        ratios = (
            float(columns["angle"][0] / true),
            float(columns["distance"][0] / error),
        )
    return *ratios, all(rates)


@pytest.mark.slow
@pytest.mark.parametrize("number", slow_after(1, [0, 101]))
def test_a_random_motion_lies_inside(number):
    table, simulated, rates = compare(number)
    assert table >= 1.0 and simulated >= 1.0 and rates


@pytest.mark.slow
@pytest.mark.search
@pytest.mark.timeout(3600)
def test_all_random_motions_lie_inside():
    found = np.array([compare(number) for number in range(COUNT)])
    assert np.all(found >= 1.0)
    print(np.quantile(found[:, :2], (0.0, 0.05, 0.5, 0.95, 1.0), axis=0))


def test_a_start_of_equal_rates_is_enclosed():
    # The first order of what moves the body rate there is zero, the second is not.
    rates = {"initial.gamma_dot": (1.0, 1.0, 1.0)}
    proven = certify(load_scene("example2").with_values(rates), REST, 0.01)
    assert not proven.reason and proven.largest < 1e-14
