# SPDX-License-Identifier: Apache-2.0
"""The MJCF of a scene, as MuJoCo reads it: accelerations, loops, what is left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loaded_scenes import loaded
from slow_cases import slow_except

from sst_ros import load_scene, simulate
from sst_ros.description.mjcf import mjcf
from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.scene import names

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is missing: pip install mujoco")

# relative: MuJoCo's ties give way by (1 - 0.9999) of a load, whatever they tie
AS_LOADED = 3e-4
STIFF = 3e-7  # with MOBILITY, up to the tolerance of its solver
MOBILITY = 1e-3  # of bodies in ties, in place of MuJoCo's own estimate [1/kg]


def without_dry_friction(scene):
    """MuJoCo's dry friction is a constraint, ours a smooth function of the rate."""
    values = {}
    for kind in ("gamma", "mu", "beta"):
        if getattr(scene.friction, kind, None) is not None:
            values[f"friction.{kind}"] = {"viscous": 0.3}
    return scene.with_values(values)


def accelerations(scene, mobility=None):
    """Accelerations of actuators in a moving state, by MuJoCo and by the package."""
    model = mujoco.MjModel.from_xml_string(mjcf(scene))
    if mobility is not None:
        model.body_invweight0[:] = mobility
    data, dynamics = mujoco.MjData(model), Dynamics.of(scene)
    torque = [0.7, -0.4, 0.2]
    state = [*start_of(scene), *(torque if scene.lags else ())]
    state[4:7] = [0.3, -0.5, 0.4]
    joints = dynamics.joints(*state[:7])
    for name, angle, rate in zip(JOINTS, joints[:9], joints[9:], strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
        data.qvel[model.joint(name).dofadr[0]] = rate
    data.ctrl[:] = torque
    if scene.lags:
        data.act[:] = torque
    mujoco.mj_forward(model, data)
    found = [data.qacc[model.joint(name).dofadr[0]] for name in JOINTS[:3]]
    drive = [*torque, *(0.0 for _ in dynamics.drive[3:])]
    slope = dynamics.derivative(*state, *drive)
    expected = kernel.actuator_acceleration(dynamics.model, state, slope[4:7])
    return np.array(found), np.array(expected)


@pytest.mark.parametrize("name", slow_except(["friction", "general"], names()))
def test_accelerations_are_those_of_the_package(name):
    scene = without_dry_friction(load_scene(name))
    for mobility, bound in ((None, AS_LOADED), (MOBILITY, STIFF)):
        found, expected = accelerations(scene, mobility)
        assert np.abs(found - expected).max() < bound * np.abs(expected).max()


def test_every_load_that_mujoco_has_is_in_it():
    """Payload, gravity, springs, viscous friction, rotors, lag, general inertia, at
    once.
    """
    scene = without_dry_friction(loaded())
    scene = replace(scene, stroke=load_scene("general").stroke)
    found, expected = accelerations(scene, MOBILITY)
    assert np.abs(found - expected).max() < STIFF * np.abs(expected).max()


def test_a_motion_follows_that_of_the_package():
    scene = load_scene("swing")
    model = mujoco.MjModel.from_xml_string(mjcf(scene))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("initial").id)
    mujoco.mj_step(model, data, nstep=500)
    expected = simulate(scene, (0.0, 0.0, 0.0), 0.5).gamma[-1]
    found = [data.qpos[model.joint(name).qposadr[0]] for name in JOINTS[:3]]
    assert np.abs(found - expected).max() < 1e-5  # it moves by 0.5 rad


def test_the_head_names_what_mujoco_has_not():
    text = mjcf(loaded())
    for word in ("Dry friction", "Elastic stops", "moment on the star"):
        assert word in text
    assert "left out" not in mjcf(load_scene("example2"))


def test_actuators_have_their_limit_and_lag():
    model = mujoco.MjModel.from_xml_string(mjcf(loaded()))
    assert model.actuator_ctrlrange.tolist() == [[-4.0, 4.0]] * 3
    assert model.actuator_dynprm[:, 0].tolist() == [5e-3] * 3
    assert model.dof_armature[model.joint("gamma_2").dofadr[0]] == pytest.approx(1e-2)
