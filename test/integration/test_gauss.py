# SPDX-License-Identifier: Apache-2.0
"""Gauss collocation against the theory of its tables, and motions against SciPy's DOP853."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from loaded_scenes import loaded, start_of
from scipy.integrate import solve_ivp

from sst_ros.dynamics import kernel
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.host import compiled_module
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.compiled_method import orientation_distance as apart
from sst_ros.integration.methods import DOP853
from sst_ros.integration.simd_source import flat_sin
from sst_ros.scene.scene import load
from sst_ros.simulation.simulate_gauss import Collocation, PreparedMotion, tables

EXAMPLE2 = load("example2_heavy")
STATE = start_of(EXAMPLE2)
WAYS = ("compiled", "plain", "compiled later")


@pytest.mark.parametrize("nodes", [2, 4, 8])
def test_tables_integrate_all_polynomials_that_they_can(nodes):
    rows = tables(nodes)
    c, b, a = rows[0], rows[1], rows[2:].T
    for power in range(2 * nodes):
        assert b @ c**power == pytest.approx(1.0 / (power + 1), abs=1e-14)
    for power in range(nodes):
        np.testing.assert_allclose(a @ c**power, c ** (power + 1) / (power + 1), atol=1e-14)


@pytest.fixture(scope="module")
def truth():
    model, torque = kernel.model_of(EXAMPLE2), EXAMPLE2.torque.at
    found = solve_ivp(
        lambda t, y: kernel.derivative(model, tuple(y), torque(t)),
        (0.0, 1.0),
        STATE,
        method="DOP853",
        rtol=2.3e-14,
        atol=1e-15,
    )
    return found.y[:, -1]


def solved(method, t, h, count, *begin, iterations=5):
    """Last change of a motion, and the state at its end."""
    motion = PreparedMotion(method, count, iterations)
    motion.begin(t, h, *begin)
    return motion.run(), motion.states[-1].tolist()


@pytest.mark.parametrize(
    ("nodes", "steps", "iterations", "error"),
    [(8, 3, 5, 1e-6), (8, 6, 6, 1e-9), (12, 3, 6, 1e-9), (12, 5, 8, 1e-12)],
)
def test_a_second_of_example_2_in_a_few_steps(truth, nodes, steps, iterations, error):
    system = ODE(Dynamics.of(EXAMPLE2), EXAMPLE2.torque)
    method = Collocation(system, nodes, compiled=False)
    change, end = solved(method, 0.0, 1.0 / steps, steps, STATE, iterations=iterations)
    assert apart(end, truth) < error
    assert math.dist(end[4:], truth[4:]) < 10.0 * error
    assert math.hypot(*end[:4]) == pytest.approx(1.0, abs=1e-15)
    assert change > apart(end, truth)


@pytest.mark.parametrize(("nodes", "steps"), [(2, 128), (3, 48), (4, 24)])
def test_measured_order_of_convergence_is_twice_the_nodes(truth, nodes, steps):
    """Iterated to the end. Eight nodes come to rounding before their limit."""
    method = Collocation(ODE(Dynamics.of(EXAMPLE2), EXAMPLE2.torque), nodes, compiled=False)
    coarse, fine = (
        apart(solved(method, 0.0, 1.0 / n, n, STATE, iterations=20)[1], truth)
        for n in (steps, 2 * steps)
    )
    assert fine > 1e-12
    assert math.log2(coarse / fine) == pytest.approx(2 * nodes, abs=0.1)


@pytest.fixture(scope="module")
def methods():
    """The same method compiled, plain, and compiled after a million evaluations."""
    system = ODE(Dynamics.of(EXAMPLE2), EXAMPLE2.torque)
    found = [Collocation(system, 4, compiled=how) for how in (True, False, None)]
    for method in found:
        method.charge(1_000_000)
    return dict(zip(WAYS, found, strict=True))


def test_numba_has_the_digits_of_plain_python(methods):
    """All but the last where it may multiply and add in one; all where it was not asked for."""
    one, plain, other = (solved(m, 0.1, 0.1, 5, STATE, iterations=4) for m in methods.values())
    np.testing.assert_allclose(one[1], plain[1], rtol=0, atol=1e-14)
    assert one[0] == pytest.approx(plain[0], rel=1e-9)
    assert other == plain
    coded = [method.code is not None for method in methods.values()]
    assert coded == [compiled_module.numba_version() is not None, False, coded[0]]


@pytest.mark.parametrize("way", WAYS)
def test_a_motion_is_computed_again_and_again_and_from_elsewhere(truth, methods, way):
    motion = PreparedMotion(methods[way], 20, 6)
    motion.begin(0.0, 0.025, STATE)
    changes = [motion.run() for _ in range(3)]
    assert changes == [changes[0]] * 3
    motion.begin(0.5, 0.025, motion.states[-1].tolist())
    motion.run()
    assert apart(motion.states[-1].tolist(), truth) < 1e-9


@pytest.mark.parametrize("way", WAYS)
def test_what_cannot_be_computed_is_refused(methods, way):
    with pytest.raises(ValueError, match="shape"):
        solved(methods[way], 0.0, 0.1, 1, STATE, [0.0, 0.0, 0.0])
    assert solved(methods[way], 0.0, math.inf, 1, STATE)[0] == math.inf


@pytest.mark.parametrize("scale", [1.0, 1e3, 1e6, 1e9, 1e14])
def test_the_flat_sine_is_the_sine(scale):
    rng = np.random.default_rng(5)
    for x in [*rng.uniform(-scale, scale, 500), *(k * math.pi / 4.0 for k in range(-9, 10))]:
        sine_of_x = float(mpmath.sin(mpmath.mpf(float(x))))
        within = 2.0 * max(math.ulp(sine_of_x), 0.5 * math.ulp(x) * (abs(x) > 1e6))
        assert abs(flat_sin(float(x)) - sine_of_x) <= within


def test_every_term_lag_and_a_drive_are_carried_along():
    """Against many steps of a method that is tested by itself."""
    scene = loaded()
    system = ODE(Dynamics.of(scene), work=True)
    y = start_of(scene, len(system.state))
    drive = [0.5, -0.3, 0.2, 0.1, 0.0, -0.2][: len(system.drive)]
    wanted = CompiledMethod(system, DOP853, compiled=False).step_fixed(0.0, 2.5e-4, 80, y, drive)
    method = Collocation(system, 8, compiled=False)
    _, found = solved(method, 0.0, 2e-3, 10, y, drive, iterations=9)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)
