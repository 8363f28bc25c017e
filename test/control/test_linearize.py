# SPDX-License-Identifier: Apache-2.0
"""Linear models against central differences of motions in 50 digits, and states of
equilibrium.
"""

from dataclasses import replace

import numpy as np
import pytest
from mechanism.test_loads import loaded
from models import folding_star, seeded_samples
from mpmath import mp, mpf
from slow_cases import slow_after, slow_except

from benchmark.plain_python import without_llvmlite
from sst_ros import (
    InputError,
    SingularConfiguration,
    equilibrium,
    linearize,
    load_scene,
    simulate,
)
from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.dynamics import kernel
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.integration import held_flow
from sst_ros.mechanism.generic_math import quaternion_product
from sst_ros.mechanism.geometry import Geometry, quaternion_of
from sst_ros.scene.bodies import Stroke
from sst_ros.scene.loads import Actuators
from sst_ros.state import State

TINY = mpf(10) ** -12


def move(model, y, torque, time, steps):
    """The state after a time, by the classical Runge-Kutta method."""

    def slope(y):
        return np.array(kernel.derivative(model, tuple(y), torque))

    h = time / steps
    for _ in range(steps):
        k1 = slope(y)
        k2 = slope(y + h / 2 * k1)
        k3 = slope(y + h / 2 * k2)
        y = y + h / 6 * (k1 + 2 * (k2 + k3) + slope(y + h * k3))
    return y


def state_of(scene, near, x, coordinates):
    """The state at x, a deviation from the state `near` unless x has gamma and
    gamma_dot.
    """
    q, space = tuple(near[:4]), ActuatorSpaceMap(Geometry.of(scene))
    if coordinates == "star":
        return np.array([*quaternion_product(q, (*x[:3] / 2, 1)), *(near[4:] + x[3:])])
    for _ in range(6):
        q = space.newton_step(*q, *space.carriages(x[:3]))[:4]
    return np.array([*q, *space.star_accelerations(*q, *x[3:6], 0, 0, 0)[:3], *x[6:]])


def coordinates_of(model, near, y, coordinates):
    if coordinates == "star":
        back = (*(-near[:3]), near[3])
        turn = quaternion_product(back, tuple(y[:4]))
        return np.array(
            [*(2 * part / turn[3] for part in turn[:3]), *(y[4:] - near[4:])]
        )
    joints = kernel.joints(model, tuple(y[:7]))
    return np.array([*joints.gamma, *joints.gamma_dot, *y[7:]])


def differences(scene, y, torque, coordinates, dt):
    """A and B by central differences of motions, over `dt` or over a tiny time."""
    model, y, torque = (
        kernel.model_of(scene),
        *(np.array([*map(mpf, x)]) for x in (y, torque)),
    )
    spans = [(TINY, 1), (-TINY, 1)] if dt is None else [(mpf(dt), 8)]
    ends = [move(model, y, torque, *span) for span in spans]
    zero = coordinates_of(model, y, y, coordinates)

    def after(deviation):
        start = state_of(scene, y, zero + deviation[: len(zero)], coordinates)
        moved = [
            move(model, start, torque + deviation[len(zero) :], *span) for span in spans
        ]
        x = [
            coordinates_of(model, *pair, coordinates)
            for pair in zip(ends, moved, strict=True)
        ]
        return x[0] if dt else (x[0] - x[1]) / (2 * TINY)

    rows = TINY * np.eye(len(zero) + 3, dtype=int)
    found = np.array([(after(row) - after(-row)) / (2 * TINY) for row in rows]).astype(
        float
    )
    return found[:-3].T, found[-3:].T


@pytest.mark.parametrize(
    "coordinates", ["gamma", pytest.param("star", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("lag", [pytest.param(None, marks=pytest.mark.slow), 0.1])
@pytest.mark.parametrize("dt", slow_except([None], [None, 2e-3]))
def test_matrices_are_those_of_differences_in_50_digits(coordinates, lag, dt):
    (sample,) = seeded_samples(341, 1)
    drive = Actuators(rotor_inertia=1e-4, gear_ratio=20.0, time_constant=lag)
    scene = replace(loaded(sample, 0.4), actuators=drive)
    if dt:  # a kink would spoil the truth, not the model
        scene = replace(scene, stroke=Stroke())
    given, command = tuple(sample.torque.tolist()), (0.5, -1.0, 2.0)
    joints = Dynamics.of(scene).joints(*sample.state)
    state = State.of(0, sample.state, joints, given)
    found = linearize(scene, state, command, dt=dt, coordinates=coordinates)
    assert found.A.shape == (len(found.states),) * 2 == ((9, 9) if lag else (6, 6))
    y = (*sample.state, *(given if lag else ()))
    with mp.workdps(50):
        expected = differences(scene, y, command, coordinates, dt)
    for matrix, truth in zip((found.A, found.B), expected, strict=True):
        assert np.abs(matrix - truth).max() <= 1e-10 * np.abs(truth).max()


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 6))]
)
def test_a_period_across_a_contact_has_the_model_of_differences(seed):
    scene = load_scene("elastic_stops").with_values({"torque": None})
    rng = np.random.default_rng(seed)
    start = np.array([1.4995, 0.8019, 0.9342, 1.885, -1.97, 1.288]) + rng.normal(
        0.0, 0.01, 6
    )
    x, dt = np.array([*start, *rng.normal(0.0, 1.0, 3)]), 0.1
    given = (x[:3], x[3:6])

    def move(x, **options):
        return simulate(scene, x[6:].tolist(), dt, initial=(x[:3], x[3:6]), **options)

    assert move(x).gamma[:, 0].max() > np.pi / 2
    found = linearize(scene, given, x[6:], dt=dt)
    columns = []
    for row in 1e-5 * np.eye(9):
        ends = [move(x + step, tolerance=1e-12, t_eval=[dt]) for step in (row, -row)]
        high, low = (np.hstack([end.gamma[-1], end.gamma_dot[-1]]) for end in ends)
        columns.append((high - low) / 2e-5)
    truth = np.transpose(columns)
    error = np.abs(np.hstack([found.A, found.B]) - truth).max()
    assert error <= 1e-5 * np.abs(truth).max()


@pytest.mark.parametrize(
    ("name", "most_calls"),
    slow_after(1, [("example2_heavy", 1), ("friction", 2), ("stiff", 25)]),
)
def test_a_period_takes_a_call_of_a_program_a_step(monkeypatch, name, most_calls):
    calls, compile_step = [], held_flow._compile_step

    def compile_counted(ode):
        step = compile_step(ode)

        def counted(rows):
            calls.append(len(rows))
            return step(rows)

        return counted

    monkeypatch.setattr(held_flow, "_compile_step", compile_counted)
    linearize(name, None, (0.01, 0.0, 0.0), dt=1e-3)
    *steps, checks = calls
    assert len(steps) <= most_calls
    assert checks == 7


@pytest.mark.slow
def test_a_period_has_the_same_bits_without_llvmlite():
    pytest.importorskip("llvmlite", reason="needs llvmlite: pip install .[fast]")
    compiled = linearize("friction", None, (0.01, 0.0, 0.0), dt=2e-3)
    with without_llvmlite():
        plain = linearize("friction", None, (0.01, 0.0, 0.0), dt=2e-3)
    assert (compiled.A == plain.A).all()
    assert (compiled.B == plain.B).all()


def test_a_period_across_a_limit_has_no_model():
    given, still = ((0.785, 0.785, 0.785), (4.0, -2.0, -2.0)), (0.0, 0.0, 0.0)
    (end,) = simulate("elastic_stops", still, 1.0, initial=given).t[-1:]
    linearize("elastic_stops", given, still, dt=0.99 * end)
    with pytest.raises(
        InputError, match=r"dt = .*: must end before a limit: beta_2 < 0"
    ):
        linearize("elastic_stops", given, still, dt=1.01 * end)


def test_a_start_on_a_stop_is_there_also_after_rounding():
    """The assembly of gamma_1 = 0 has an angle of -1e-17 rad."""
    scene = load_scene("swing").with_values({"stroke": {"at_end": "stop"}})
    there, still = (0.0, 0.45, 0.75), (0.0, 0.0, 0.0)
    linearize(scene, (there, (0.5, 0.0, 0.0)), still, dt=0.005)
    with pytest.raises(
        InputError, match=r"dt = .*: must end before a limit: gamma_1 < 0"
    ):
        linearize(scene, (there, (-0.5, 0.0, 0.0)), still, dt=0.005)


@pytest.mark.parametrize(
    "name", slow_except(["stiff"], ["gravity_payload", "example2_stroke", "stiff"])
)
def test_at_an_equilibrium_nothing_accelerates(name):
    scene = load_scene(name)
    state = equilibrium(scene, scene.initial.gamma)
    rest = (*state.quaternion, *state.body_rate, *(state.torque if scene.lags else ()))
    assert np.abs(Dynamics.of(scene).derivative(*rest, *state.torque)).max() <= 1e-12


def test_a_parallel_singularity_has_a_model_of_the_star_alone():
    scene, (rotation, *_) = folding_star()
    q = tuple(quaternion_of(rotation).tolist())
    y = (*q, 0.1, 0.2, 0.3)
    state = State.of(0, y, Dynamics.of(scene).joints(*y), (0.0,) * 3)
    assert np.isfinite(linearize(scene, state, (0.0,) * 3, coordinates="star").A).all()
    with pytest.raises(SingularConfiguration, match="parallel"):
        linearize(scene, state, (0.0,) * 3)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"torque": (1.0, 2.0)}, "torque"),
        ({"torque": (1e3, 0.0, 0.0)}, "at most 10.0 N m"),
        ({"dt": 0.0}, "dt"),
        ({"dt": 1e5}, "singularity or is too long"),
        ({"dt": True}, "dt"),
        ({"coordinates": "mu"}, "must be gamma or star"),
        ({"coordinates": ["star"]}, "coordinates = .* must be text"),
        ({"state": (9.0, 9.0)}, "initial"),
    ],
)
def test_what_is_no_point_of_a_motion_is_refused(given, named):
    scene = replace(load_scene("example1"), actuators=Actuators(torque_limit=10.0))
    with pytest.raises(InputError, match=named):
        linearize(scene, **{"state": None, "torque": (5.0, -3.0, 4.0), **given})


def test_python_control_takes_the_model():
    # `control` alone might be a folder of that name: these tests are in one.
    reason = "needs control: pip install .[control]"
    pytest.importorskip("control.statesp", reason=reason)
    model = linearize("gravity_payload", None, (0.0,) * 3, dt=0.01)
    system = model.to_control()
    assert system.state_labels == list(model.states) and system.dt == 0.01
    assert (system.A == model.A).all() and (system.B == model.B).all()


def test_eigenvalues_are_shown_at_rest_alone():
    state = equilibrium("gravity_payload", [0.7, 0.75, 0.8])
    pushed = np.add(state.torque, [0.1, 0.0, 0.0])
    for coordinates in ("gamma", "star"):
        at_rest = linearize(
            "gravity_payload", state, state.torque, coordinates=coordinates
        )
        moving = linearize("gravity_payload", state, pushed, coordinates=coordinates)
        assert at_rest.at_equilibrium
        assert "eigenvalue" in repr(at_rest)
        assert not moving.at_equilibrium
        assert "eigenvalue" not in repr(moving)
