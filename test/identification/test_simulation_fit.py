# SPDX-License-Identifier: Apache-2.0
"""Sensitivities against simulated scenes; constants fitted by simulation."""

import math

import numpy as np
import pytest
from numpy.polynomial import chebyshev
from slow_cases import slow_after
from symmetric_motion import inertia

from sst_ros import load_scene, simulate
from sst_ros.dynamics.model import damping_of
from sst_ros.dynamics.variational import (
    REBOUND,
    VariationalEquations,
    differentiate_damping,
)
from sst_ros.errors import InputError
from sst_ros.identification.identify import identify
from sst_ros.scene.yaml_document import find_number
from tools.reading_figure import PANELS, determined


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


def thick():
    """Links that are not flat: their inertias may change alone."""
    given = load_scene("example2_heavy")
    axial = 1.05 * given.actuated_links[0].inertia.zz
    thicker = {
        "actuated_links.inertia.zz": axial,
        "intermediate_links.inertia.xx": 1e-3,
    }
    return given.with_values(thicker)


def bouncing():
    """Actuator 1 meets the lower end of its stroke at 20 ms, and leaves it some 16 ms
    later.
    """
    return load_scene("impacts").with_values(
        {
            "stroke": {"at_end": "elastic", "stiffness": 2e4, "damping": 0.3},
            "initial.gamma": [0.03, 0.5, 0.6],
            "initial.gamma_dot": [-1.5, 0.2, -0.1],
        }
    )


def rebounding():
    """gamma_1 meets its stop at 0.91 s.

    A stop as soft as this lets E leave the workspace.
    """
    elastic = {
        "at_end": "elastic",
        "stiffness": 500.0,
        "impact_rate": 1.5,
        "restitution": 0.6,
    }
    return load_scene("impacts").with_values(
        {"stroke": elastic, "workspace.at_edge": "ignore"}
    )


def record(motion, noise=0.0):
    """What is measured of a motion: angles with noise, and the torques."""
    return {"t": motion.t, "gamma": motion.gamma + noise, "torque": motion.torque}


def slow(*case):
    return pytest.param(*case, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("build", "end", "name"),
    [
        (thick, 0.08, "star.inertia.zz"),
        slow(thick, 0.08, "actuated_links.inertia.zz"),
        slow(thick, 0.08, "intermediate_links[1].inertia.yy"),
        slow(rubbing, 0.08, "friction.gamma.smoothing"),
        slow(rubbing, 0.08, "friction.gamma.coulomb"),
        slow(rubbing, 0.08, "actuators.time_constant"),
        slow(rubbing, 0.08, "initial.gamma_dot[1]"),
        slow(rubbing, 0.08, "initial.gamma_dot"),
        slow(rubbing, 0.08, "initial.gamma[0]"),
        slow(bouncing, 0.05, "star.inertia.zz"),
        slow(bouncing, 0.05, "stroke.stiffness"),
        slow(bouncing, 0.05, "stroke.damping"),
        slow(rebounding, 1.0, "stroke.restitution"),
        slow(rebounding, 1.0, "stroke.impact_rate"),
    ],
)
def test_sensitivities_are_derivatives_of_what_simulate_finds(build, end, name):
    """A polynomial through runs of scenes with other values.

    Nothing jumps where a stop is met.
    """
    scene = build()
    value = find_number(scene, name)
    motion = VariationalEquations(scene, (name,), scene.torque)
    _, slopes = motion.run(np.array([value]), np.array([end]))
    nodes, states, width = chebyshev.chebpts1(10), [], 0.02 * value
    for node in nodes.tolist():
        changed = scene.with_values({name: value + width * node})
        last = simulate(changed, t_eval=[end], duration=end, tolerance=1e-13)
        assert last.success
        states.append([*last.quaternion[0], *last.body_rate[0]])
    fitted = chebyshev.chebder(chebyshev.chebfit(nodes, np.array(states), 9))
    expected = chebyshev.chebval(0.0, fitted) / width
    assert np.abs(slopes[0, :7, 0] - expected).max() < 1e-10 * np.abs(expected).max()


def test_restitution_and_impact_rate_together_have_both_slopes():
    scene, t = rebounding(), np.array([1.0])
    names = ("stroke.impact_rate", "stroke.restitution")
    values = np.array([find_number(scene, name) for name in names])
    _, both = VariationalEquations(scene, names, scene.torque).run(values, t)
    for k in range(2):
        _, one = VariationalEquations(scene, names[k : k + 1], scene.torque).run(
            values[[k]], t
        )
        assert both[0, :, k] == pytest.approx(one[0, :, 0], rel=1e-9, abs=1e-9)
        assert np.abs(one).max() > 1e-3


def test_slopes_of_the_damping_by_restitution_and_impact_rate():
    elastic = {"at_end": "elastic", "stiffness": 2000.0, "impact_rate": 0.7}
    for e in (0.05, 0.3, 0.8, 0.97):
        scene = load_scene("swing").with_values(
            {"stroke": elastic | {"restitution": e}}
        )
        for name, slope in zip(REBOUND, differentiate_damping(scene), strict=True):
            high, low = (
                damping_of(
                    scene.with_values({name: find_number(scene, name) + h}).stroke
                )
                for h in (1e-6, -1e-6)
            )
            assert slope == pytest.approx((high - low) / 2e-6, rel=1e-7)


@pytest.mark.slow
def test_smoothing_and_lag_are_found_though_torque_is_nonlinear():
    plant = rubbing()
    names = (
        "friction.gamma.smoothing",
        "actuators.time_constant",
        "initial.gamma_dot[0]",
    )
    motion = simulate(
        plant, t_eval=np.linspace(0.0, 0.3, 61), duration=0.3, tolerance=1e-11
    )
    guess = plant.with_values(dict(zip(names[:2], (0.3, 0.03), strict=True)))
    found = identify(motion, guess, names, method="simulation")
    assert found.values == pytest.approx([0.5, 0.02, 0.3], rel=1e-6)
    assert found.undetermined == () and found.error < 1e-9
    assert found.scene.actuators.time_constant == pytest.approx(0.02, rel=1e-6)


@pytest.mark.parametrize("torque", slow_after(1, [(0.3, -0.2, 0.1), None]))
def test_the_torques_of_a_trajectory_lag_once(torque):
    name, drop = "friction.gamma.viscous", {} if torque is None else {"torque": None}
    lag = {"actuators.time_constant": 0.02, name: 0.1}
    plant = load_scene("example2_heavy").with_values(lag | drop)
    times = np.linspace(0.0, 0.3, 151)
    motion = simulate(plant, torque, t_eval=times, duration=0.3, tolerance=1e-11)
    by_torques = identify(motion, plant, [name, "star.inertia"])
    assert by_torques.values[by_torques.names.index(name)] == pytest.approx(
        0.1, rel=1e-6
    )
    guess = plant.with_values({name: 0.12})
    found = identify(motion, guess, [name], method="simulation")
    assert found.values == pytest.approx([0.1], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "torque", [(3.0, -2.0, 1.0), pytest.param(None, marks=pytest.mark.slow)]
)
def test_torques_that_a_limit_has_cut_off_are_those_that_acted(torque):
    free = load_scene("example2_heavy")
    limited = free.with_values(
        {"actuators.torque_limit": 2.5} | ({"torque": None} if torque else {})
    )
    times = np.linspace(0.0, 0.3, 301)
    motion = simulate(limited, torque, t_eval=times, duration=0.3, tolerance=1e-11)
    assert np.abs(motion.torque).max() == 2.5 < np.abs(motion.law.values(times)).max()
    guess = free.with_values({"star.inertia.zz": 0.3})
    found = identify(motion, guess, ["star.inertia.zz"], method="simulation")
    assert found.values == pytest.approx([free.star.inertia.zz], rel=1e-3)


@pytest.mark.slow
def test_standard_deviations_cover_the_errors_of_noisy_angles():
    plant = load_scene("example2_heavy")
    names = ("star.inertia.xx", "star.inertia.zz")
    motion = simulate(plant, t_eval=np.linspace(0.0, 0.6, 31), tolerance=1e-11)
    guess = plant.with_values({"star.inertia.xx": 0.5, "star.inertia.zz": 0.2})
    off = []
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(0.0, 1e-3, (31, 3))
        found = identify(record(motion, noise), guess, names, method="simulation")
        assert found.error == pytest.approx(1e-3, rel=0.3)
        true = [plant.star.inertia.xx, plant.star.inertia.zz]
        off.append((found.estimate - true) / found.deviation)
    assert np.mean(np.abs(off) < 2.0) > 0.7
    assert np.abs(off).max() < 4.0


@pytest.mark.slow
def test_angles_of_example_1_fix_inertia_times_initial_rate():
    """No drift over a period: I_eff gamma_dot(0) = -1.13 / 12, far better than either
    alone.
    """
    scene, period = load_scene("example1"), math.pi / 6
    motion = simulate(scene, t_eval=np.linspace(0.0, period, 27), duration=period)
    guess = scene.with_values({"star.inertia.zz": 0.3})
    noise = np.random.default_rng(0).normal(0.0, math.radians(1.0), (27, 3))
    names = ("star.inertia.zz", "initial.gamma_dot")
    found = identify(record(motion, noise), guess, names, method="simulation")
    assert found.relative[0] < 0.02 < 0.05 < found.relative[1]
    rate = found.scene.initial.gamma_dot[0]
    product = inertia(found.scene, 0.0) * rate
    assert product == pytest.approx(-1.13 / 12.0, rel=4.0 * found.relative[0])
    # Along what stays open the product stays: relative changes of 1e-3 cancel.
    changed = found.values * (1.0 + 1e-3 * found.directions[-1])
    moved = found.scene.with_values(
        dict(zip(found.names, changed.tolist(), strict=True))
    )
    there = inertia(moved, 0.0) * moved.initial.gamma_dot[0]
    assert there == pytest.approx(product, rel=1e-4)
    assert "known to " in found.table()


@pytest.mark.slow
def test_inertias_that_no_bodies_have_do_not_enter_the_scene():
    """The thin arc of the links is flat: a smaller zz alone breaks the triangle
    inequality.
    """
    plant = load_scene("example2_heavy")
    heavier = plant.with_values({"star.inertia.xx": 0.34})
    motion = simulate(heavier, t_eval=np.linspace(0.0, 0.3, 31), tolerance=1e-10)
    found = identify(motion, plant, ("actuated_links.inertia.zz",), method="simulation")
    given = plant.actuated_links[0].inertia
    assert found.estimate[0] < 0.95 * given.zz == 0.95 * (given.yy - given.xx)
    assert found.warnings[0].startswith("no bodies have the inertias that fit best")
    assert found.scene.actuated_links == plant.actuated_links
    assert found.values.tolist() == [given.zz]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ((), "must be keys of numbers"),
        (("base.v",), "is geometry"),
        (
            ("friction.gamma.smoothing",),
            "must be the key of a number that the scene has",
        ),
        (("star.moment.x",), "must be the key of a number that the scene has"),
    ],
)
def test_bad_input_is_refused(names, message):
    scene = load_scene("example2_heavy")
    motion = simulate(scene, t_eval=np.linspace(0.0, 0.1, 21), duration=0.1)
    with pytest.raises(InputError, match=message):
        identify(motion, scene, names, method="simulation")


def test_readings_without_torques_are_refused():
    scene, t = load_scene("example2_heavy"), np.linspace(0.0, 0.1, 21)
    with pytest.raises(InputError, match="torque"):
        identify({"t": t, "psi": t}, scene, ("star.inertia.zz",), method="simulation")


def test_fig_9_fixes_inertia_times_initial_rate_and_little_more():
    _, name, read, rate = PANELS[0]
    labels, relative = determined(name, read, rate)
    assert relative[0] == pytest.approx(0.012, abs=0.001)
    assert relative[1] == pytest.approx(0.14, abs=0.01)
    assert np.all(relative[2:] > 1e3)
    assert "I_{zz}^{+" in labels[0] and r"\dot{\gamma}^{+" in labels[0]
    assert r"\dot{\gamma}^{-" in labels[1]


@pytest.mark.parametrize(("panel", "worst"), [(1, 0.05), (2, 0.2)])
def test_example_2_fixes_the_star_but_two_combinations_never(panel, worst):
    _, name, read, rate = PANELS[panel]
    _, relative = determined(name, read, rate)
    assert relative[0] < 0.011 and relative[2] < worst
    assert 0.3 < relative[3] < 0.45
    assert 1.0 < relative[4] < 10.0
    assert np.all(relative[5:] > 1e6)
