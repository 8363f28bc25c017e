# SPDX-License-Identifier: Apache-2.0
"""Sensitivities against 50-digit differences; constants fitted by simulation and from figures."""

import math

import mpmath as mp
import numpy as np
import pytest
from identification import manipulators
from symmetric_motion import drift_free_rate, inertia

from sst_ros import load_scene, simulate
from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.model import damping_of
from sst_ros.errors import InputError
from sst_ros.identification import parameters
from sst_ros.identification.identify import identify
from sst_ros.identification.parameters import value_of
from sst_ros.identification.simulation_fit import Sensitivities, differentiate_damping
from sst_ros.mechanism.generic_math import ZERO, rotation_rows
from sst_ros.mechanism.geometry import Geometry
from sst_ros.simulation.torque_profile import SineProfile

END, STEPS, COLUMNS = 0.08, 2, 10
TINY = mp.mpf(10) ** -18


def rubbing():
    """Friction and lag whose torques are smooth enough for extrapolation."""
    return load_scene("example2_heavy").with_values(
        {
            "friction.gamma.viscous": 0.1,
            "friction.gamma.coulomb": 0.2,
            "friction.gamma.smoothing": 0.5,
            "actuators.time_constant": 0.02,
            "initial.gamma_dot": [0.3, 0.2, -0.1],
        }
    )


def extrapolated(function, y, begin, end):
    """Gragg, Bulirsch and Stoer in mpmath: modified midpoint rule, extrapolated in 1/n^2."""
    rows = []
    for j in range(1, COLUMNS + 1):
        n, h = 2 * j, (end - begin) / (2 * j)
        before, here = y, [a + h * b for a, b in zip(y, function(begin, y), strict=True)]
        for k in range(1, n):
            slope = function(begin + k * h, here)
            before, here = here, [a + 2 * h * b for a, b in zip(before, slope, strict=True)]
        slope = function(end, here)
        last = [(a + b + h * c) / 2 for a, b, c in zip(before, here, slope, strict=True)]
        row = [last]
        for k in range(1, j):
            factor = mp.mpf(j * j) / ((j - k) ** 2) - 1
            row.append(
                [a + (a - b) / factor for a, b in zip(row[-1], rows[-1][k - 1], strict=True)]
            )
        rows.append(row)
    return rows[-1][-1]


def opened(scene, name, value):
    """The model with one number of mpmath, its derivative under the scene's sines, the start."""
    geometry, wave = Geometry.of(scene), scene.torque
    model = kernel.model_of(parameters.with_symbols(scene, {name: value}), geometry)
    rows = list(zip(wave.amplitude, wave.frequency, wave.phase, strict=True))

    def function(t, y):
        torque = [mp.mpf(a) * mp.sin(mp.mpf(f) * t + mp.mpf(p)) for a, f, p in rows]
        return kernel.derivative(model, tuple(y), torque)

    lags = 3 if model.time_constant is not None else 0
    return model, function, [mp.mpf(x) for x in (*initial_state(scene, geometry), *[0] * lags)]


def integrated(function, y, begin, duration, steps):
    """The state after some steps of equal length."""
    for k in range(steps):
        y = extrapolated(function, y, *(begin + duration * i / steps for i in (k, k + 1)))
    return y


def at_the_end(scene, name, value, _):
    """The state at END in 50 digits."""
    _, function, y = opened(scene, name, value)
    return integrated(function, y, mp.mpf(0), mp.mpf(END), STEPS)


BOUNCE_END = 0.05
PHASES = ((False, 0.02, 1), (True, 0.016, 3), (False, None, 1))
"""Contact or not, a first guess of the duration [s], steps."""


def bouncing():
    """Actuator 1 meets the lower end of its stroke at 20 ms, and leaves it some 16 ms later."""
    return load_scene("impacts").with_values(
        {
            "stroke": {"at_end": "elastic", "stiffness": 2e4, "damping": 0.3},
            "initial.gamma": [0.03, 0.5, 0.6],
            "initial.gamma_dot": [-1.5, 0.2, -0.1],
        }
    )


def after_the_bounce(scene, name, value, monkeypatch):
    """The state at BOUNCE_END in 50 digits: integrated from event to event, which are located.

    There is no jump at the events: the torque of a stop begins and ends at zero.
    """
    model, function, y = opened(scene, name, value)
    begin = mp.mpf(0)

    def gamma(state):
        rows = rotation_rows(tuple(state[:4]))
        return kernel.joint_angle(kernel.leg_motion(model.legs[0], rows, ZERO), 0)

    for contact, guess, steps in PHASES:
        # The branch of the phase, also where a stage of the method lies beyond its end.
        least = -0.5 if contact else 0.5
        monkeypatch.setattr(
            kernel, "positive", lambda x, least=least: x if x > least else mp.mpf(0)
        )

        def state_at(duration, begin=begin, y=y, steps=steps):
            return integrated(function, y, begin, duration, steps)

        duration = BOUNCE_END - begin
        if guess is not None:
            near = (mp.mpf(guess), mp.mpf(guess) * 1.01)
            duration = mp.findroot(lambda x, at=state_at: gamma(at(x)), near, tol=1e-40)
        begin, y = begin + duration, state_at(duration)
    return y


BODIES = ("star.inertia.zz", "actuated_links.inertia.zz", "intermediate_links[1].inertia.yy")
LOADS = ("friction.gamma.smoothing", "friction.gamma.coulomb", "actuators.time_constant")
STOPS = ("star.inertia.zz", "stroke.stiffness", "stroke.damping")


@pytest.mark.parametrize(
    ("build", "names", "end", "final_state"),
    [
        (lambda: load_scene("example2_heavy"), BODIES, END, at_the_end),
        pytest.param(rubbing, LOADS, END, at_the_end, marks=pytest.mark.slow),
        *(
            pytest.param(bouncing, (name,), BOUNCE_END, after_the_bounce, marks=pytest.mark.slow)
            for name in STOPS
        ),
    ],
)
def test_sensitivities_are_those_of_50_digit_differences(
    build, names, end, final_state, monkeypatch
):
    scene = build()
    motion = Sensitivities(scene, names, SineProfile(scene.torque))
    values = np.array([value_of(scene, name) for name in names])
    _, slopes = motion.run(values, np.array([end]))
    with mp.workdps(50):
        for i, name in enumerate(names):
            centre = mp.mpf(float(values[i]))
            high, low = (
                final_state(scene, name, centre + sign * TINY, monkeypatch) for sign in (1, -1)
            )
            expected = [float((a - b) / (2 * TINY)) for a, b in zip(high, low, strict=True)]
            size = max(map(abs, expected))
            assert np.abs(slopes[0, :, i] - expected).max() < 1e-10 * size


@pytest.mark.parametrize("name", ["initial.gamma_dot[1]", "initial.gamma[0]", "initial.gamma_dot"])
def test_sensitivities_to_the_initial_state_are_those_of_differences(name):
    scene = rubbing()
    motion = Sensitivities(scene, (name,), SineProfile(scene.torque))
    value = np.array([value_of(scene, name)])
    h = 1e-3
    _, slopes = motion.run(value, np.array([END]))
    states = [motion.run(value + k * h, np.array([END]))[0][0] for k in (-2, -1, 1, 2)]
    expected = (states[0] - 8 * states[1] + 8 * states[2] - states[3]) / (12 * h)
    assert np.abs(slopes[0, :, 0] - expected).max() < 1e-9


def test_the_slope_of_the_damping_by_the_restitution():
    elastic = {"at_end": "elastic", "stiffness": 2000.0, "impact_rate": 0.7}
    for e in (0.05, 0.3, 0.8, 0.97):
        scene = load_scene("swing").with_values({"stroke": elastic | {"restitution": e}})
        high, low = (
            damping_of(scene.with_values({"stroke.restitution": e + h}).stroke)
            for h in (1e-6, -1e-6)
        )
        assert differentiate_damping(scene) == pytest.approx((high - low) / 2e-6, rel=1e-7)


@pytest.mark.slow
def test_smoothing_and_lag_which_no_torque_is_linear_in_are_found():
    plant = rubbing()
    names = ("friction.gamma.smoothing", "actuators.time_constant", "initial.gamma_dot[0]")
    motion = simulate(plant, t_eval=np.linspace(0.0, 0.3, 61), duration=0.3, tolerance=1e-11)
    figure = {"t": motion.t} | {f"gamma_{k + 1}": motion.gamma[:, k] for k in range(3)}
    guess = plant.with_values(dict(zip(names[:2], (0.3, 0.03), strict=True)))
    found = identify(figure, guess, names, method="simulation")
    assert found.values == pytest.approx([0.5, 0.02, 0.3], rel=1e-6)
    assert found.undetermined == () and found.error < 1e-9
    assert found.scene.actuators.time_constant == pytest.approx(0.02, rel=1e-6)


@pytest.mark.slow
def test_the_standard_deviations_cover_the_errors_of_noisy_readings():
    plant = load_scene("example2_heavy")
    names = ("star.inertia.xx", "star.inertia.zz")
    motion = simulate(plant, t_eval=np.linspace(0.02, 0.6, 30), tolerance=1e-11)
    guess = plant.with_values({"star.inertia.xx": 0.5, "star.inertia.zz": 0.2})
    off = []
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(0.0, 1e-3, (30, 3))
        read = {f"gamma_{k + 1}": motion.gamma[:, k] + noise[:, k] for k in range(3)}
        read |= {"t": motion.t, "deviation": 1e-3}
        found = identify(read, guess, names, method="simulation")
        assert found.error == pytest.approx(1.0, abs=0.3)
        true = [plant.star.inertia.xx, plant.star.inertia.zz]
        off.append((found.estimate - true) / found.deviation)
    assert np.mean(np.abs(off) < 2.0) > 0.7
    assert np.abs(off).max() < 4.0


@pytest.mark.slow
def test_one_reading_of_example_1_fixes_only_a_product():
    """No drift over a period: I_eff gamma_dot(0) = -1.13 / 12, and neither of the two alone."""
    scene, period = load_scene("example1"), math.pi / 6
    psi = simulate(scene).at([0.0, period]).euler_zyz[:, 2]
    guess = scene.with_values({"star.inertia.zz": 0.3})
    read = {"t": [0.0, period], "psi": psi, "deviation": math.radians(1.0)}
    found = identify(read, guess, ("star.inertia.zz", "initial.gamma_dot"), method="simulation")
    rate = found.scene.initial.gamma_dot[0]
    assert rate == pytest.approx(drift_free_rate(found.scene), rel=1e-9)
    assert inertia(found.scene, 0.0) * rate == pytest.approx(-1.13 / 12.0, rel=1e-3)
    assert len(found.undetermined) == 1
    assert "star.inertia.zz" in found.undetermined[0] and "gamma_dot" in found.undetermined[0]
    # Along what stays open the product stays: relative changes cancel.
    step = 1e-3 * found.directions[-1]
    changed = found.values * (1.0 + step)
    moved = found.scene.with_values(dict(zip(found.names, changed.tolist(), strict=True)))
    product = inertia(moved, 0.0) * moved.initial.gamma_dot[0]
    assert product == pytest.approx(inertia(found.scene, 0.0) * rate, rel=2e-5)
    assert "not determined: " in found.table()


def test_bodies_that_cannot_exist_give_way_to_the_nearest():
    """The thin arc of the links is flat: a smaller zz alone breaks the triangle inequality."""
    plant = load_scene("example2_heavy")
    heavier = plant.with_values({"star.inertia.xx": 0.34})
    motion = simulate(heavier, t_eval=np.linspace(0.05, 0.3, 6), tolerance=1e-10)
    read = {f"gamma_{k + 1}": motion.gamma[:, k] for k in range(3)} | {"t": motion.t}
    found = identify(read, plant, ("actuated_links.inertia.zz",), method="simulation")
    given = plant.actuated_links[0].inertia
    assert found.estimate[0] < 0.95 * given.zz == 0.95 * (given.yy - given.xx)
    assert found.warnings[0].startswith("no bodies have the inertias that fit best")
    assert found.scene.actuated_links[0].inertia.zz == pytest.approx(found.estimate[0], rel=1e-5)


@pytest.mark.parametrize(
    ("names", "change", "message"),
    [
        ((), {}, "must be keys of numbers"),
        (("base.radius",), {}, "is geometry"),
        (("friction.gamma.smoothing",), {}, "must be the key of a number that the scene has"),
        (("star.inertia.zz",), {"t": [0.2, 0.1]}, "must be ascending times"),
        (("star.inertia.zz",), {"speed": [1.0, 1.0]}, "must be t, deviation or one of"),
        (("star.inertia.zz",), {"psi": [1.0]}, r"psi = \(1,\): must have the shape \(2,\)"),
        (("star.inertia.zz",), {"deviation": 0.0}, "deviation = 0.0: must be > 0"),
    ],
)
def test_bad_input_is_refused(names, change, message):
    read = {"t": [0.0, 0.1], "psi": [1.0, 1.0]} | change
    with pytest.raises(InputError, match=message):
        identify(read, load_scene("example2_heavy"), names, method="simulation")


def test_options_of_the_other_method_are_refused():
    scene = manipulators.thin_arcs()
    with pytest.raises(InputError, match="takes no cutoff"):
        identify({}, scene, ("star.inertia.zz",), method="simulation", cutoff=3.0)
    with pytest.raises(InputError, match="must be in the scene"):
        identify({"t": [0.1], "psi": [0.0]}, scene, ("star.inertia.zz",), method="simulation")


def test_the_sensitivity_to_the_restitution_over_a_bounce():
    """gamma_1 meets its stop at 0.91 s; the slope of the damping takes part."""
    elastic = {"at_end": "elastic", "stiffness": 500.0, "impact_rate": 1.5, "restitution": 0.6}
    scene = load_scene("impacts").with_values({"stroke": elastic})
    motion = Sensitivities(scene, ("stroke.restitution",), SineProfile(scene.torque))
    end, h = np.array([1.0]), 1e-4
    _, slopes = motion.run(np.array([0.6]), end)
    high, low = (motion.run(np.array([0.6 + sign * h]), end)[0][0] for sign in (1.0, -1.0))
    expected = (high - low) / (2.0 * h)
    assert np.abs(expected).max() > 1e-3
    assert np.abs(slopes[0, :, 0] - expected).max() < 1e-6 * np.abs(expected).max()
