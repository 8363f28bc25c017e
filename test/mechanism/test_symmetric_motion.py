# SPDX-License-Identifier: Apache-2.0
"""The one-degree-of-freedom motion of Example 1 against the full dynamics, at elastic
stops too.
"""

from dataclasses import replace

import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from slow_cases import slow_after
from symmetric_motion import HOME, drift_free_rate, inertia, inertia_slope

from sst_ros import Simulation, load_scene, simulate
from sst_ros.dynamics.model import damping_of
from sst_ros.scene.bodies import Stroke, Workspace
from sst_ros.scene.loads import Initial

EXAMPLE1 = load_scene("example1")
HEAVY = EXAMPLE1.with_values(
    {"star.inertia.xx": 0.39, "star.inertia.yy": 0.39, "star.inertia.zz": 0.26}
)
REST = (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "scene", slow_after(1, [EXAMPLE1, HEAVY]), ids=["example1", "star x 1.25"]
)
def test_without_drift_the_full_dynamics_return_after_one_period(scene):
    start = {"initial.gamma_dot": [drift_free_rate(scene)] * 3}
    motion = simulate(scene.with_values(start), t_eval=[np.pi / 6], tolerance=1e-14)
    # Samples are taken at whole nanoseconds. An error of the rate shows about pi/6
    # times as large.
    drift = motion.gamma[-1] + (np.pi / 6 - motion.t[-1]) * motion.gamma_dot[-1] - HOME
    assert np.abs(drift).max() < 5e-13


def test_example_1_starts_with_the_rate_without_drift():
    assert EXAMPLE1.initial.gamma_dot == pytest.approx(
        (drift_free_rate(EXAMPLE1),) * 3, abs=1e-12
    )


@pytest.mark.parametrize("e", [0.1, 0.5, 0.6, 0.9, 0.99, 0.998, 0.999, 1.0 - 1e-6, 1.0])
def test_the_damping_satisfies_the_exact_relation(e):
    """d (1 + e) = ln((1 + d) / (1 - d e)), solved by mpmath to 40 digits."""
    damping = damping_of(
        Stroke(at_end="elastic", stiffness=10.0, restitution=e, impact_rate=2.5)
    )
    if e == 1.0:
        assert damping == 0.0
        return
    with mpmath.workdps(40):
        restitution = mpmath.mpf(e)

        def relation(d):
            return d * (1 + restitution) - mpmath.log((1 + d) / (1 - d * restitution))

        d = mpmath.mpf(2.5) * damping
        exact = mpmath.findroot(
            relation, (d * (1 - mpmath.mpf("1e-9")), d), verify=False
        )
        assert abs(d / exact - 1) < 2e-13


def bounced(**stroke):
    """Example 1 on its way from pi/4 to the upper stops, all three at the same rate."""
    scene = replace(
        EXAMPLE1,
        torque=None,
        stroke=Stroke(at_end="elastic", **stroke),
        workspace=Workspace(at_edge="ignore"),
        initial=Initial(gamma=(HOME,) * 3, gamma_dot=(1.0,) * 3),
    )
    simulation = Simulation(scene, tolerance=1e-13)
    for _ in range(150):
        simulation.step(REST, 10_000_000)
    return simulation


@pytest.mark.parametrize(
    ("stiffness", "restitution"), [(2e3, 0.5), (1e6, 0.5), (1e6, 0.9)]
)
def test_three_contacts_at_once_bounce_as_one_freedom_does(stiffness, restitution):
    """Example 1 in symmetric motion is one equation that SciPy integrates by itself."""
    how = {"stiffness": stiffness, "restitution": restitution, "impact_rate": 1.0}
    simulation = bounced(**how)
    joints, c = simulation.state.joints, damping_of(Stroke(at_end="elastic", **how))
    # rounding, grown
    assert np.ptp(joints.gamma) < 3e-12 and np.ptp(joints.gamma_dot) < 3e-12

    def acceleration(t, y):
        x, v = y
        depth = max(x - np.pi / 4, 0.0)
        push = stiffness * depth * max(1.0 + c * v, 0.0)
        return v, -(push + 0.5 * inertia_slope(EXAMPLE1, x) * v * v) / inertia(
            EXAMPLE1, x
        )

    def contact(t, y):
        return y[0] - np.pi / 4

    contact.terminal = True
    t, y = 0.0, (0.0, 1.0)
    rates = []
    while t < 1.5:
        found = solve_ivp(
            acceleration,
            (t, 1.5),
            y,
            "DOP853",
            events=contact,
            rtol=2.3e-14,
            atol=1e-15,
        )
        t, y = found.t[-1], found.y[:, -1]
        if found.status == 1:
            rates.append(y[1])
            y = (np.pi / 4 + np.sign(y[1]) * 1e-16 + y[1] * 1e-13, y[1])
            t += 1e-13
    assert len(rates) == 2
    assert joints.gamma[0] - HOME == pytest.approx(y[0], abs=2e-9)
    assert joints.gamma_dot[0] == pytest.approx(y[1], abs=2e-9)


@pytest.mark.slow
def test_stiff_stops_have_the_restitution_at_the_impact_rate():
    """The relation is exact for a constant inertia: the depth of contact is what
    remains.
    """
    # Rate at the stops of a motion that keeps its energy, from rate 1 at home.
    rate = np.sqrt(inertia(EXAMPLE1, 0.0) / inertia(EXAMPLE1, np.pi / 4))
    found = []
    for stiffness in (1e6, 1e8):
        simulation = bounced(stiffness=stiffness, restitution=0.5, impact_rate=rate)
        energy = simulation.dynamics.total_energy(
            (*simulation.state.quaternion, *simulation.state.body_rate)
        )
        before = 1.5 * inertia(EXAMPLE1, 0.0)
        found.append(abs(np.sqrt(energy / before) - 0.5))
    assert found[1] < 1e-4 and found[1] < 0.2 * found[0]
