# SPDX-License-Identifier: Apache-2.0
"""The one-degree-of-freedom motion of Example 1, against mpmath and the full dynamics."""

import mpmath as mp
import numpy as np
import pytest
from symmetric_motion import HOME, drift_free_rate, inertia, inertia_slope

from sst_ros import Simulation, load_scene

EXAMPLE1 = load_scene("example1")
HEAVY = EXAMPLE1.with_values(
    {"star.inertia.xx": 0.39, "star.inertia.yy": 0.39, "star.inertia.zz": 0.26}
)


@pytest.mark.parametrize("x", [-0.6, 0.0, 0.2, 0.5])
def test_the_slope_is_that_of_the_inertia(x):
    slope = (inertia(HEAVY, x + 1e-6) - inertia(HEAVY, x - 1e-6)) / 2e-6
    assert inertia_slope(HEAVY, x) == pytest.approx(slope, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("scene", [EXAMPLE1, HEAVY], ids=["example1", "star x 1.25"])
def test_the_rate_without_drift_is_that_of_mpmath(scene):
    rate = drift_free_rate(scene)
    star, link = scene.star.inertia, scene.intermediate_inertias[0]
    drive = scene.actuated_inertias[0][2][2]

    def moment(x):
        return star.zz / (2 - mp.cos(2 * x)) ** 2 + drive + link[1][1] + wide(x)

    def wide(x):
        return 2 * link[0][0] * mp.cos(x) ** 2 / (2 - mp.cos(2 * x)) ** 2

    def slope_of_moment(x):
        turning = moment(x) - drive - link[1][1]
        inner = 2 - mp.cos(2 * x)
        return -4 * mp.sin(2 * x) / inner * turning - 2 * mp.tan(x) * wide(x)

    def rates(t, y):
        push = mp.mpf("1.13") * mp.sin(12 * t) - slope_of_moment(y[0]) * y[1] ** 2 / 2
        return [y[1], push / moment(y[0])]

    def drift(start):
        return mp.odefun(rates, 0, [mp.mpf(0), start], tol=mp.mpf(10) ** -16)(mp.pi / 6)[0]

    with mp.workdps(18):
        # Newton's step from the rate found: the drift over its slope is the rate's error.
        here = drift(mp.mpf(rate))
        slope = (drift(mp.mpf(rate) + mp.mpf("1e-6")) - here) / mp.mpf("1e-6")
        assert abs(here / slope) < 1e-12


def test_example_1_starts_with_the_rate_without_drift():
    assert EXAMPLE1.initial.gamma_dot == pytest.approx((drift_free_rate(EXAMPLE1),) * 3, abs=1e-12)


def test_the_heavier_star_returns_after_one_period():
    rate = drift_free_rate(HEAVY)
    scene = HEAVY.with_values({"initial.gamma_dot": [rate] * 3})
    simulation, torque = Simulation(scene, tolerance=1e-13), scene.torque.at
    steps = 500
    dt_ns = round(np.pi / 6 * 1e9 / steps)
    for _ in range(steps):
        state = simulation.step(torque, dt_ns)
    # The period is rounded to steps of whole nanoseconds: 250 ns at 0.4 rad/s.
    assert np.abs(np.array(state.joints.gamma) - HOME).max() < 2e-7
