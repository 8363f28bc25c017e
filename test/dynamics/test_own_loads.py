# SPDX-License-Identifier: Apache-2.0
"""Own loads against Lagrange's equations, against built-in loads, and in all that takes
a scene.
"""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from lagrange import Lagrange, exact, partials
from models import seeded_samples
from mpmath import mp

from sst_ros import (
    Batch,
    Simulation,
    certify,
    linearize,
    load_scene,
    own_load,
    simulate,
    sweep,
)
from sst_ros.dynamics import kernel
from sst_ros.dynamics.model import model_of
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import InputError
from sst_ros.scene.own_loads import ANGLE_NAMES, ROTATION, FormulaLoad, LoadParameter
from sst_ros.scene.scene import Scene
from sst_ros.scene.yaml_document import dump, read

POTENTIALS = (
    "0.7 * R13**2 + 0.4 * R23 * R31 - k * R33",
    "k * sin(gamma_1) * mu_2**2 + exp(-beta_3)",
    (
        "0.3 * (gamma_1 - gamma_2)**2 + sqrt(1 + R12**2) * cos(mu_3) + atan2(beta_1,"
        " 2) * k"
    ),
    (
        "tanh(k * beta_2) + positive(mu_1 - 0.1)**2 + max(R11, -2) * abs(R22) / (2 +"
        " min(R33, 5))"
    ),
)
TORQUE = (0.4, -0.3, 0.2)


def of_potential(text, k=1.3):
    parameters = (LoadParameter(name="k", value=k),) if "k" in text else ()
    return FormulaLoad(name="own", potential=text, parameters=parameters)


def mpmath_energy(truth, text, gamma, k=1.3):
    """Evaluate a potential by Python's own arithmetic on the numbers of the independent
    model.
    """
    here = truth.at(gamma)
    names = dict(zip(ROTATION, here.rotation.ravel(), strict=True))
    names |= dict(zip(ANGLE_NAMES, here.angles.ravel(), strict=True))
    functions = {
        name: getattr(mp, name) for name in ("sqrt", "exp", "sin", "cos", "tanh")
    }
    functions |= {"atan2": mp.atan2, "positive": lambda x: max(x, 0), "k": mp.mpf(k)}
    return eval(text, functions | {"abs": abs, "min": min, "max": max}, names)


@pytest.mark.parametrize("text", POTENTIALS)
def test_the_acceleration_under_a_potential_is_lagranges(text):
    sample = seeded_samples(81, 1)[0]
    scene = replace(sample.scene, own_loads=(of_potential(text),))
    truth = Lagrange(sample.scene, sample.rotation)
    gamma = exact(sample.gamma)
    loads = -partials(lambda x: mpmath_energy(truth, text, x), gamma).astype(float)
    expected = truth.acceleration(
        gamma, sample.gamma_dot, sample.torque + loads
    ).astype(float)
    slope = Dynamics.of(scene).derivative(*sample.state, *sample.torque.tolist())
    found = sample.gamma_ddot_of(slope[4:])
    assert np.abs(loads).max() > 0.05
    assert np.abs(found - expected).max() <= 1e-11 * np.abs(expected).max()
    energy = kernel.potential_energy(model_of(scene), sample.state)
    assert energy == pytest.approx(float(mpmath_energy(truth, text, gamma)), rel=1e-13)


def equal_motions(one, other):
    a, b = (simulate(scene, TORQUE, 0.3, tolerance=1e-11) for scene in (one, other))
    assert a.success and b.success
    assert np.abs(a.gamma - b.gamma).max() < 1e-10
    assert np.abs(a.energy - a.energy[0] - b.energy + b.energy[0]).max() < 1e-9


@pytest.mark.slow
def test_formulas_of_built_in_loads_move_alike():
    bare = load_scene("general")
    spring = {"springs": [{"joint": "mu_2", "stiffness": 3.0, "rest": 0.4}]}
    formula = "0.5 * k * (mu_2 - rest)**2"
    numbers = (
        LoadParameter(name="k", value=3.0),
        LoadParameter(name="rest", value=0.4),
    )
    own = FormulaLoad(name="spring", potential=formula, parameters=numbers)
    equal_motions(bare.with_values(spring), replace(bare, own_loads=(own,)))
    heavy = {"star.mass": 4.0, "star.centre": [0.01, 0.0, 0.1]}
    heavy |= {"gravity.acceleration": [0.0, 0.0, -9.81]}
    own = own_load(
        "weight", potential=lambda at: 9.81 * 4.0 * (at.rotation[2] @ [0.01, 0, 0.1])
    )
    equal_motions(bare.with_values(heavy), replace(bare, own_loads=(own,)))


@pytest.mark.parametrize("frame", ["base", "star"])
def test_a_formula_of_a_constant_moment_moves_as_the_moment(frame):
    bare = load_scene("general")
    if frame == "base":
        own = FormulaLoad(name="push", moment=("0.3", "-0.2", "0.1"))
    else:  # the same in {E}

        def push(at):
            return at.rotation.T @ np.array([0.3, -0.2, 0.1])

        own = own_load("push", moment=push, frame="star")
    built_in = bare.with_values({"moment.value": [0.3, -0.2, 0.1]})
    equal_motions(built_in, replace(bare, own_loads=(own,)))


def wind(at, density, speed):
    """Moment of the wind on a plate across E."""
    e = at.rotation[:, 2]
    relative = np.array([speed, 0.0, 0.0]) - 0.4 * np.cross(at.omega, e)
    pressure = density * np.sqrt(relative @ relative + 1e-6)
    return 0.4 * np.cross(e, pressure * relative)


def spring(at, stiffness):
    """Energy of a spring from E to a point of the base."""
    stretch = 0.4 * at.rotation[:, 2] - np.array([0.3, 0.3, 0.5])
    return 0.5 * stiffness * (stretch @ stretch)


def windy() -> Scene:
    scene = load_scene("gravity_payload")
    own = (
        own_load("spring", potential=spring, parameters={"stiffness": 40.0}),
        own_load("wind", moment=wind, parameters={"density": 0.3, "speed": 3.0}),
    )
    return replace(scene, own_loads=own)


def test_a_traced_function_has_the_values_of_the_function():
    sample, scene = seeded_samples(82, 1)[0], windy()
    model = kernel.model_of(replace(sample.scene, own_loads=scene.own_loads))
    bare = kernel.model_of(sample.scene)
    omega = sample.rotation @ np.array(sample.body_rate)

    class At:
        rotation = sample.rotation

    At.omega = omega
    moment = wind(At, 0.3, 3.0)
    change = kernel.power(model, sample.state, TORQUE) - kernel.power(
        bare, sample.state, TORQUE
    )
    assert change == pytest.approx(moment @ omega, rel=1e-13)
    energy = kernel.potential_energy(model, sample.state)
    assert energy == pytest.approx(spring(At, 40.0), rel=1e-14)


def test_the_energy_of_a_motion_changes_by_the_work_of_own_loads():
    motion = simulate(windy(), TORQUE, 0.5, tolerance=1e-11)
    assert motion.success
    assert abs(motion.energy_residual) < 1e-9
    still = simulate(load_scene("gravity_payload"), TORQUE, 0.5)
    assert np.abs(motion.gamma - still.gamma).max() > 1e-3


def test_step_by_step_and_by_the_paper():
    scene = windy()
    stepped = Simulation(scene)
    for _ in range(100):
        stepped.step(TORQUE, 1_000_000)
    whole = simulate(scene, TORQUE, 0.1, tolerance=1e-11)
    assert np.abs(np.subtract(stepped.state.joints.gamma, whole.gamma[-1])).max() < 1e-9
    with pytest.raises(InputError, match="own_loads"):
        Simulation(
            replace(load_scene("general"), own_loads=scene.own_loads),
            equations="virtual_work",
        )


@pytest.mark.slow
def test_parameters_of_own_loads_vary_in_batches_and_sweeps():
    scene, key = windy(), "own_loads[1].parameters[1].value"
    speeds = [0.0, 3.0, 6.0]
    batch = Batch(scene, parameters={key: speeds})
    gamma, rate = (
        np.tile(x, (3, 1)) for x in (scene.initial.gamma, scene.initial.gamma_dot)
    )
    result = batch.run(gamma, rate, TORQUE, step=1e-3, count=200)
    for row, speed in enumerate(speeds):
        alone = simulate(scene.with_values({key: speed}), TORQUE, 0.2, tolerance=1e-11)
        assert result.gamma[row] == pytest.approx(alone.gamma[-1], abs=1e-9)
    table = sweep(scene, {key: speeds}, torque=TORQUE, duration=0.2, progress=False)
    assert table["gamma_1"].to_numpy() == pytest.approx(result.gamma[:, 0], abs=1e-8)


@pytest.mark.slow
def test_linear_models_have_own_loads():
    scene = windy()
    state = Simulation(scene).state
    model = linearize(scene, state, TORQUE)
    step, columns = 1e-5, []
    for k in range(3):
        ends = []
        for sign in (-2.0, -1.0, 1.0, 2.0):
            gamma = np.array(scene.initial.gamma)
            gamma[k] += sign * step
            moved = scene.with_values({"initial.gamma": gamma.tolist()})
            ends.append(simulate(moved, TORQUE, 1e-6).gamma_ddot[0])
        columns.append(np.tensordot([1.0, -8.0, 8.0, -1.0], ends, 1) / (12.0 * step))
    expected = np.stack(columns, axis=1)
    assert np.abs(model.A[3:, :3] - expected).max() < 1e-6 * np.abs(expected).max()


def test_sensitivities_by_a_parameter_of_an_own_load():
    scene, key = windy(), "own_loads[0].parameters[0].value"
    found = (
        simulate(scene, TORQUE, 0.2, sensitivities=[key])
        .sensitivities[key]
        .gamma[-1, :, 0]
    )
    ends = [
        simulate(
            scene.with_values({key: 40.0 + x}), TORQUE, 0.2, tolerance=1e-12
        ).gamma[-1]
        for x in (-0.2, -0.1, 0.1, 0.2)
    ]
    expected = np.tensordot([1.0, -8.0, 8.0, -1.0], ends, 1) / 1.2
    assert np.abs(found - expected).max() < 1e-7 * np.abs(expected).max()


@pytest.mark.slow
def test_motions_under_own_loads_are_proven():
    scene = replace(load_scene("general"), own_loads=windy().own_loads)
    proven = certify(scene, (0.2, 0.0, 0.0), 0.02, bound=1e-6, progress=False)
    assert proven.success, proven.message
    loose = simulate(scene, (0.2, 0.0, 0.0), 0.02, method="dop853", tolerance=1e-6)
    assert proven.trajectory.gamma[-1] == pytest.approx(loose.gamma[-1], abs=1e-6)


def test_own_loads_are_the_same_from_text_and_another_process():
    scene = windy()
    assert read(Scene, dump(scene), "scene") == scene
    assert pickle.loads(pickle.dumps(scene)) == scene
    assert simulate(
        pickle.loads(pickle.dumps(simulate(scene, TORQUE, 0.1))).scene, TORQUE, 0.1
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("__import__('os').system('true')", "must call one of"),
        ("(lambda: 1)()", "must call one of"),
        ("R13.__class__", "Attribute is not allowed"),
        ("gamma_1[0]", "Subscript is not allowed"),
        ("[x for x in (1,)]", "must be arithmetic"),
        ("1 if R13 else 2", "IfExp is not allowed"),
        ("'a' * 9", "finite numbers only"),
        ("True", "finite numbers only"),
        ("1e999", "finite numbers only"),
        ("9**9**9", "whole numbers up to 8"),
        ("R13**0.5", "whole numbers up to 8"),
        ("R13**100", "whole numbers up to 8"),
        ("1 / 0", "must not divide by zero"),
        ("k * R13", "k is neither state, parameter nor term"),
        ("omega_x**2", "must be of the pose alone: omega_x is a rate"),
        ("sin", "its arguments in brackets"),
        ("sin(R13, 2)", "must give sin 1 argument"),
        ("max(*R13)", "must give max 2 arguments"),
        ("R13 +", "must be a formula"),
        ("(" * 3000 + "1" + ")" * 3000, "must have at most 4000 characters"),
        ("(" * 900 + "1" + ")" * 900, "must be a formula"),
        ("-" * 900 + "1", "must be a formula|must have at most 200 levels"),
        ("+".join(["R13"] * 990), "must have at most 200 levels"),
    ],
)
def test_what_is_no_formula_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        FormulaLoad(name="bad", potential=text)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "give one of potential, moment"),
        (
            {"potential": "1", "moment": ("1", "2", "3")},
            "give one of potential, moment",
        ),
        ({"moment": ("1", "2")}, "must be three formulas"),
        ({"potential": "1", "terms": {"R13": "2"}}, "means nothing else"),
        ({"potential": "1", "terms": {"a": "b", "b": "1"}}, "b is neither state"),
        (
            {"potential": "1", "parameters": ({"name": "sin", "value": 1.0},)},
            "means nothing else",
        ),
        (
            {"potential": "1", "parameters": ({"name": "k", "value": 1.0},) * 2},
            "is given twice",
        ),
    ],
)
def test_loads_that_contradict_themselves_are_refused(given, message):
    with pytest.raises(InputError, match=message):
        FormulaLoad(name="bad", **given)


def decides(at):
    return 1.0 if at.rotation[0, 0] > 0.0 else 2.0


def of_math(at):
    return math.sin(at.gamma[0])


def of_rate(at):
    return at.omega[0]


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (decides, "it decides by a number of the state"),
        (of_math, "NumPy's sqrt"),
        (of_rate, "must be a function that formulas can say"),
        (lambda at: [1.0, 2.0], "must be a function that formulas can say"),
        (lambda: 1.0, "must be a function that formulas can say"),
    ],
)
def test_functions_that_are_no_formulas_are_refused(function, message):
    with pytest.raises(InputError, match=message):
        own_load("bad", potential=function)
