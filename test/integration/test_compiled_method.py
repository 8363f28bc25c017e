# SPDX-License-Identifier: Apache-2.0
"""Steps of every method: the same bits compiled, their order, their Jacobians."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from loaded_scenes import IGNORE, loaded, start_of, viscous
from models import seeded_samples

from sst_ros.dynamics.kernel import derivative
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.integration import codegen
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, METHODS, RK4, RODAS4
from sst_ros.scene.scene import load

DRIVE = (3.0, -2.0, 1.0)
MOMENT = (0.1, 0.2, 0.3)
EXAMPLE2 = load("example2_heavy")


def system_of(scene, torque=None, work=False):
    return ODE(Dynamics.of(scene), torque, work=work)


def both(scene, method):
    """Two pairs, then a march through contact and sliding, in plain Python and under numba."""
    system = system_of(scene, work=True)
    y, drive = start_of(scene, len(system.state)), (*DRIVE, *MOMENT)[: len(system.drive)]
    results = []
    for by_numba in (False, True):
        machine = CompiledMethod(system, method, compiled=by_numba)
        assert machine.compiled == by_numba
        first = machine.step_pair(0.0, 1e-3, y, y, drive)
        second = machine.step_pair(1e-3, 2e-3, first[0], first[1], drive)
        results.append((first, second, machine.step_fixed(0.0, 1e-3, 200, y, drive)))
    return results


needs_numba = pytest.mark.skipif(codegen.numba_version() is None, reason="numba is missing")


@needs_numba
@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))
@pytest.mark.parametrize("name", ["loaded", "general", "friction", "elastic_stops", "fast_spin"])
def test_numba_gives_the_bits_of_plain_python_everywhere(name, method):
    scene = loaded() if name == "loaded" else load(name)
    plain, fast = both(scene, method)
    assert plain == fast


SINE = (replace(EXAMPLE2, **IGNORE), 0.4, EXAMPLE2.torque)
SPIN = (replace(load("fast_spin"), **IGNORE), 0.01, None)
ORDERS = [
    *((SINE, method, n) for method, n in ((RK4, 256), (DORMAND_PRINCE, 64), (DOP853, 16))),
    (SINE, RODAS4, 128),
    *((SPIN, method, n) for method, n in ((RK4, 256), (DORMAND_PRINCE, 96), (RODAS4, 256))),
]


@functools.cache
def truth_of(scene, span, torque):
    """DOP853 in steps that err below rounding, for two lengths of them agree."""
    system = system_of(scene, torque)
    y, drive = start_of(scene), () if torque else (1000.0, -500.0, 700.0)
    machine = CompiledMethod(system, DOP853, compiled=False)
    few, many = (machine.step_fixed(0.0, span / n, n, y, drive) for n in (100, 200))
    assert math.dist(few[:4], many[:4]) < 2e-14
    return system, y, drive, many


@pytest.mark.parametrize(
    ("case", "method", "steps"),
    ORDERS,
    ids=[f"{'sine' if case[2] else 'spin'}-{method.name}" for case, method, _ in ORDERS],
)
def test_measured_order_is_that_of_the_theory(case, method, steps):
    """Errors stay well above rounding. Under sine torques the d/dt of RODAS4 is at work."""
    system, y, drive, truth = truth_of(*case)
    machine = CompiledMethod(system, method, compiled=False)
    errors = []
    for count in (steps, 2 * steps):
        end = machine.step_fixed(0.0, case[1] / count, count, y, drive)
        size = 7 if case is SINE else 4  # rates of 100 rad/s have rounding of their own
        errors.append(math.dist(end[:size], truth[:size]))
    assert errors[1] > 2e-14
    assert math.log2(errors[0] / errors[1]) == pytest.approx(method.order, abs=0.1)


def linearised(scene, torque, t, y, drive):
    system = system_of(scene, torque, work=True)
    machine, size = CompiledMethod(system, RODAS4, compiled=False), len(system.state)
    slope, by_time, matrix = np.zeros(size), np.zeros(size), np.zeros((size, size))
    machine._module.linearise(t, y, drive, (), slope, by_time, matrix)
    return slope, by_time, matrix


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("what", ["inertia", "loaded"])
def test_jacobians_are_exact(what, seed):
    """Against the complex step through the kernel itself, which has no difference to cancel.

    At rest of contact: the elastic stops are not in touch, where complex steps have no meaning.
    """
    (sample,) = seeded_samples(seed + 80, 1)
    scene = loaded() if what == "loaded" else sample.scene
    dynamics = Dynamics.of(scene)
    y = [*start_of(scene)[:4], *(0.3, -0.2, 0.4), *(0.5, -0.4, 0.2)[: len(dynamics.state) - 7]]
    y = [x + 0.003 * (seed + 1) * (-1) ** i for i, x in enumerate(y)]
    slope, by_time, matrix = linearised(scene, None, 0.0, [*y, 0.0], (*DRIVE, *MOMENT))
    moment = MOMENT if dynamics.has_moment_topic else None
    size = len(y)
    truth = np.zeros((size, size))
    for j in range(size):
        stepped = [complex(x) for x in y]
        stepped[j] += 1e-30j
        truth[:, j] = np.imag(derivative(dynamics.model, tuple(stepped), DRIVE, moment)) / 1e-30
    assert np.abs(truth).max() > 1.0
    np.testing.assert_allclose(
        matrix[:size, :size], truth, rtol=0, atol=1e-12 * np.abs(truth).max()
    )
    assert not by_time.any()
    assert not matrix[:, -1].any()  # nothing depends on the work done
    assert np.all(np.isfinite(slope))


def test_the_derivative_by_time_is_exact():
    """With M_dot = 0 it is M^-1 J^T tau_dot: linear in tau, so two exact torques give it."""
    t, torque = 0.13, EXAMPLE2.torque
    y = [*start_of(EXAMPLE2)[:4], 0.3, -0.2, 0.4, 0.0]
    slope, by_time, _ = linearised(EXAMPLE2, torque, t, y, ())
    rows = list(zip(torque.amplitude, torque.frequency, torque.phase, strict=True))
    model = Dynamics.of(EXAMPLE2).model
    now = tuple(a * math.sin(f * t + p) for a, f, p in rows)
    rate = tuple(a * f * math.cos(f * t + p) for a, f, p in rows)
    moving, free = (np.array(derivative(model, tuple(y[:7]), tau)) for tau in (rate, (0.0,) * 3))
    np.testing.assert_allclose(by_time[:7], moving - free, atol=1e-12)
    np.testing.assert_allclose(slope[:7], derivative(model, tuple(y[:7]), now), atol=1e-12)
    assert np.abs(by_time).max() > 1.0


def test_a_step_without_a_finite_result_has_an_infinite_error():
    machine = CompiledMethod(system_of(EXAMPLE2), DORMAND_PRINCE, compiled=False)
    y = start_of(EXAMPLE2)
    assert machine.step_pair(0.0, 1e-3, y, y, (1e308, 1e308, 0.0))[2] == math.inf


def test_a_slope_of_its_own_needs_an_explicit_method():
    with pytest.raises(ValueError, match="needs plain Python"):
        CompiledMethod(system_of(viscous(1.0)), RODAS4, compiled=False, derivative=lambda *x: x)
