# SPDX-License-Identifier: Apache-2.0
"""Identification from noise-free runs of a digital controller, and what is refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from bags import simulated
from identification import manipulators

from sst_ros import load_scene, reference_motion, simulate
from sst_ros.cli.commands import run_command
from sst_ros.errors import InputError
from sst_ros.identification import parameters
from sst_ros.identification.identify import identify
from sst_ros.scene.loads import Actuators
from sst_ros.scene.yaml_document import dump

EXACT = 1e-9
SCENES = (
    "thin_arcs",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("general", "payload")),
)


@cache
def identified(name):
    """The true scene and what is identified from a run of it, from wrong values."""
    plant = getattr(manipulators, name)()
    # The mean over a period is of fourth order; general geometry has the worst
    # condition.
    period = 4e-4 if name == "general" else manipulators.PERIOD
    return plant, identify(
        manipulators.run(plant, period=period), manipulators.wrong(plant)
    )


@pytest.mark.parametrize("name", SCENES)
def test_base_parameters_are_those_of_the_plant(name):
    assert_exact(*identified(name))


def test_a_recording_gives_them_as_exactly(bags, tmp_path, monkeypatch):
    """The bag has stamps in whole nanoseconds, and the torque of every tick, two a
    sample.
    """
    plant = load_scene("example2_heavy")
    monkeypatch.setattr(bags, "TICK_NS", round(manipulators.PERIOD * 1e9))
    path = bags.write(tmp_path / "bag", bags.simulated(plant, 1.0))
    assert_exact(plant, identify(path, manipulators.wrong(plant)))


def check_estimate(plant, found):
    true = found.base.transform @ parameters.values(plant, found.names)
    assert np.linalg.norm(found.estimate - true) < EXACT * np.linalg.norm(true)


def arrays_of(motion, torque):
    """A run as arrays, with held torques."""
    arrays = {name: getattr(motion, name) for name in ("t", "gamma", "gamma_dot")}
    return arrays | {"held": True, "torque": torque, "quaternion": motion.quaternion[0]}


def assert_exact(plant, found):
    """Check the base parameters against those of the plant."""
    check_estimate(plant, found)
    assert found.undetermined == found.vague == found.warnings == ()
    assert found.consistent


@pytest.mark.parametrize("name", SCENES)
def test_torques_of_another_motion_are_predicted(name):
    """By the inverse dynamics of the identified scene."""
    plant, found = identified(name)
    other = manipulators.sweeping(plant, 1.0, speed=0.9)
    states = manipulators.states(reference_motion(other), np.linspace(0.0, 1.0, 50))
    expected = manipulators.torques(plant, *states)
    by_scene = manipulators.torques(found.scene, *states)
    assert np.abs(by_scene - expected).max() < EXACT * np.abs(expected).max()


def test_smooth_samples_without_a_hold_are_as_exact():
    """A free swing under sine torques: samples of torque, angle and rate at the same
    instants.
    """
    scene = load_scene("example2_heavy")
    motion = simulate(scene, t_eval=np.arange(1001) * 1e-3, tolerance=1e-13)
    found = identify(
        motion, scene.with_values({"star.inertia.xx": 0.5}), parameters=("star",)
    )
    true = found.base.transform @ parameters.values(scene, found.names)
    assert np.abs(found.estimate - true).max() < EXACT * np.abs(true).max()


@pytest.mark.slow
def test_of_a_free_motion_without_noise_the_bodies_can_exist():
    # All terms cancel, so that the data fix no scale; their rounding is not that of
    # zero torque.
    plant = load_scene("swing")
    found = identify(
        simulate(plant, t_eval=np.arange(1000) * 1e-3, tolerance=1e-12), plant
    )
    assert found.consistent
    assert found.noise.min() > 1e-13


def test_unknown_friction_and_offsets_are_found():
    plant = manipulators.sweeping(manipulators.thin_arcs(), 1.5).with_values(
        manipulators.FRICTION
    )
    motion = manipulators.run(plant)
    arrays = arrays_of(motion, motion.torque[1:] + np.array([0.1, -0.2, 0.3]))
    guessed = {"viscous": 1.0, "coulomb": 1.0, "smoothing": 0.1}
    model = plant.with_values({"friction": {"gamma": guessed}})
    found = identify(arrays, model, parameters=("star", "friction", "offset"))
    values = dict(zip(found.names, found.values, strict=True))
    for name, true in manipulators.FRICTION.items():
        if "smoothing" not in name:
            assert values[name] == pytest.approx(true, rel=1e-6)
    assert [values[f"offset[{k}]"] for k in range(3)] == pytest.approx(
        [0.1, -0.2, 0.3], rel=1e-7
    )
    assert found.scene.friction.gamma.viscous == pytest.approx(0.2, rel=1e-6)


def test_a_motion_that_is_too_poor_names_what_it_leaves_open():
    """All gamma equal: the star turns about E alone, so xx, yy and xy do not matter."""
    scene = load_scene("example1")
    motion = simulate(scene, t_eval=np.arange(501) * 1e-3)
    found = identify(motion, scene)
    lost = {label.split()[0] for label in found.undetermined}
    assert lost >= {"star.inertia.xx", "star.inertia.yy", "star.inertia.xy"}
    assert "star.inertia.zz" not in lost
    assert "not determined by this motion: star.inertia.xx" in found.table()
    assert "identify design" in found.table()


def test_saturated_samples_are_left_out_with_a_warning():
    plant = manipulators.sweeping(manipulators.thin_arcs(), 1.5)
    motion = manipulators.run(plant, period=1e-3)
    limit = float(np.abs(motion.torque).max()) * 0.8
    model = plant.with_values({"actuators.torque_limit": limit})
    found = identify(
        arrays_of(motion, np.clip(motion.torque[1:], -limit, limit)), model
    )
    assert "a torque was at the limit" in found.warnings[0]
    check_estimate(plant, found)


@cache
def samples():
    plant, t = manipulators.thin_arcs(), np.arange(400) * 5e-3
    motion = reference_motion(plant)
    gamma = np.array([motion.at(time).gamma for time in t.tolist()])
    torque = manipulators.torques(plant, *manipulators.states(motion, t))
    return {"t": t, "gamma": gamma, "torque": torque}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"gamma": None},
            r"gamma = None: is missing; must be finite numbers, shape \(n, 3\)",
        ),
        (
            {"t": None},
            r"t = None: is missing; must be finite numbers, shape \(n,\) \[s\]$",
        ),
        ({"t": [[0.0], [1.0, 2.0]]}, r"must be finite numbers, shape \(n,\) \[s\]$"),
        ({"t": np.zeros(400)}, "must be rising times"),
        (
            {"torque": np.zeros((400, 2))},
            r"torque = \(400, 2\): must be finite.*shape \(n, 3\)",
        ),
        (
            {"torque": np.zeros((397, 3))},
            r"torque = \(397, 3\): must have the shape \(400, 3\)",
        ),
        ({"speed": 1.0}, "speed = 1.0: unknown key; allowed are t, gamma"),
        ({"gamma": np.full((400, 3), np.nan)}, r"gamma\[0, 0\] = nan: must be finite"),
        (
            {"gamma": np.linspace(3.0, 3.1, 1200).reshape(400, 3)},
            "must be angles of this manipulator",
        ),
        ({"gamma": np.full((400, 3), 0.785)}, "a manipulator at rest shows no inertia"),
        ({"quaternion": (0.0, 0.0, 0.0, 1.0)}, "must be angles of this manipulator"),
    ],
)
def test_bad_data_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        identify(samples() | change, manipulators.thin_arcs())


def test_bad_arguments_are_refused():
    scene = manipulators.thin_arcs()
    short = {name: rows[:10] for name, rows in samples().items()}
    for data, options, message in (
        (short, {}, "must be 20 samples or more"),
        (samples(), {"method": "magic"}, "must be inverse_dynamics or simulation"),
        (samples(), {"cutoff": 1e3}, "below half the rate of samples"),
        (samples(), {"noise": (0.1, 0.0, 0.1)}, "three finite standard deviations"),
        (samples(), {"parameters": ("mass",)}, "begins no parameter"),
        (samples(), {"parameters": ()}, "must name one or more"),
    ):
        with pytest.raises(InputError, match=message):
            identify(data, scene, **options)
    with pytest.raises(InputError, match="must be given with arrays"):
        identify(samples())


def test_a_recording_becomes_a_scene(written, example2, tmp_path, capsys):
    bag = written(example2)
    out = tmp_path / "identified.yaml"
    words = ["identify", str(bag), "--parameters", "star", "--out", str(out)]
    assert run_command(words) == 0
    printed = capsys.readouterr().out
    assert "star.inertia.zz" in printed and f"wrote {out}" in printed
    found, given = load_scene(out), load_scene("example2")
    for part in ("xx", "yy", "zz"):
        expected = getattr(given.star.inertia, part)
        assert getattr(found.star.inertia, part) == pytest.approx(expected, rel=1e-3)
    assert dict(found.provenance)["star"].startswith("identified")
    assert run_command(words) == 1
    assert "exists already" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    "actuators",
    [pytest.param(None, marks=pytest.mark.slow), Actuators(time_constant=0.02)],
)
def test_a_recording_is_fitted_by_simulation(written, tmp_path, capsys, actuators):
    recorded = replace(load_scene("example2"), actuators=actuators)
    guess = tmp_path / "guess.yaml"
    changed = recorded.with_values({"star.inertia.zz": 0.25})
    guess.write_text(dump(changed), encoding="utf-8")
    bag = written(simulated(recorded, 0.3))
    words = ["identify", str(bag), "--scene", str(guess), "--method", "simulation"]
    out = tmp_path / "identified.yaml"
    assert (
        run_command([*words, "--parameters", "star.inertia.zz", "--out", str(out)]) == 0
    )
    assert "known to" in capsys.readouterr().out
    expected = recorded.star.inertia.zz
    assert load_scene(out).star.inertia.zz == pytest.approx(expected, rel=1e-8)
    assert run_command(words) == 1
    assert "must be keys of numbers of the scene" in capsys.readouterr().err
    assert (
        run_command([*words, "--parameters", "star.inertia.zz", "--cutoff", "3"]) == 1
    )
    assert "takes no cutoff" in capsys.readouterr().err


@pytest.mark.slow
def test_a_scene_becomes_a_motion(tmp_path, capsys):
    out = tmp_path / "exciting.yaml"
    words = ["identify", "design", "example2", "--duration", "1", "--harmonics", "3"]
    assert run_command([*words, "--parameters", "star", "--out", str(out)]) == 0
    assert "condition number" in capsys.readouterr().out
    assert load_scene(out).motion.kind == "waypoints"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["design"], "must be given after design"),
        (["bag", "reach"], "only there"),
        (["design", "reach", "--cutoff", "3"], "is no option of identify design"),
        (
            ["design", "reach", "--method", "simulation"],
            "is no option of identify design",
        ),
        (["bag", "--seed", "3"], "is no option of identify BAG"),
        (["nowhere"], "nowhere"),
    ],
)
def test_what_does_not_fit_is_refused(words, message, capsys):
    assert run_command(["identify", *words]) == 1
    assert message in capsys.readouterr().err
