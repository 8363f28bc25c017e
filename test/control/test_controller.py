# SPDX-License-Identifier: Apache-2.0
"""The controllers against the paper's equations, closed forms and what a closed loop
must do.
"""

import dataclasses

import numpy as np
import pytest
from models import seeded_samples
from scipy.spatial.transform import Rotation

from sst_ros.control.actuator_space import ActuatorSpaceMap, ReferenceMotion
from sst_ros.control.controller import Controller, ControlStopped, Measurement
from sst_ros.control.law import MODES, ControllerSettings
from sst_ros.control.reference_motions import geodesic_motion
from sst_ros.errors import InputError
from sst_ros.mechanism import continuation, kinematics, rates, virtual_work
from sst_ros.mechanism.geometry import Geometry, quaternion_of, rotation_matrix
from sst_ros.scene import scene
from sst_ros.scene.loads import Actuators, Initial, Moment
from sst_ros.simulation.simulation import Simulation

PERIOD = 0.002
ZERO = (0.0, 0.0, 0.0)
HEAVY = scene.load("example2_heavy")


def standing(desired):
    """The same for all times."""
    return ReferenceMotion(lambda _: desired, (0.0,))


def turned(model, vector=(0.1, 0.0, 0.0), duration=0.4):
    """From the initial orientation by a rotation vector in {E}."""
    geometry = Geometry.of(model)
    start = kinematics.admissible(geometry, model.initial.gamma).rotation
    end = quaternion_of(start @ Rotation.from_rotvec(vector).as_matrix())
    return geodesic_motion(geometry, tuple(quaternion_of(start)), tuple(end), duration)


def answer(sample, desired, gamma_dot=None, **given):
    """The command for the state of a sample."""
    gamma_dot = sample.gamma_dot if gamma_dot is None else gamma_dot
    acting = Controller(
        sample.scene, standing(desired), ControllerSettings(**given), PERIOD
    )
    return acting.command(
        0.0, Measurement(tuple(sample.gamma.tolist()), tuple(gamma_dot.tolist()))
    )


@pytest.fixture(params=enumerate(seeded_samples(1, 5)), ids=range(5))
def near(request):
    """A sample, another pose of its assembly in motion with its posture, and the errors
    of both.
    """
    seed, sample = request.param
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(0.1 * rng.standard_normal(3))
    q = tuple((Rotation.from_matrix(sample.rotation) * turn).as_quat().tolist())
    rate, acceleration = (tuple(rng.standard_normal(3).tolist()) for _ in range(2))
    desired = ActuatorSpaceMap(sample.geometry).of_star(q, rate, acceleration)
    errors = desired.gamma - sample.gamma, desired.gamma_dot - sample.gamma_dot
    rotation = rotation_matrix(desired.quaternion)
    at = virtual_work.posture(sample.geometry, np.array(desired.gamma), rotation)
    return sample, desired, at, *errors


def test_feedforward_is_the_papers_inverse_dynamics(near):
    sample, desired, at, *_ = near
    told = answer(sample, desired)
    assert told.torque == told.feedforward and told.feedback == ZERO
    expected = virtual_work.inverse_dynamics(
        sample.mechanism, at, desired.gamma_dot, desired.gamma_ddot
    )
    assert np.allclose(told.torque, expected, rtol=1e-9, atol=1e-9)


def test_gains_by_bandwidth_use_the_papers_inertia_in_all_modes(
    near,
):
    sample, desired, at, error, error_rate = near
    m = -np.diag(virtual_work.equation_of_motion(sample.mechanism, at, np.zeros(3))[0])
    expected = m * (20.0**2 * error + 2.0 * 0.7 * 20.0 * error_rate)
    for mode in ("pd", "gravity_pd", "feedforward_pd"):
        told = answer(sample, desired, mode=mode, bandwidth=20.0, damping_ratio=0.7)
        assert np.allclose(told.feedback, expected, rtol=1e-9, atol=1e-9)
        assert np.allclose(
            told.torque, np.add(told.feedforward, told.feedback), rtol=1e-15
        )
    told = answer(sample, desired, mode="pd", stiffness=m * 400.0, damping=m * 28.0)
    assert np.allclose(told.torque, expected, rtol=1e-9, atol=1e-9)


def test_computed_torque_makes_the_error_of_gamma_linear(near):
    sample, desired, _, error, error_rate = near
    told = answer(
        sample, desired, mode="computed_torque", bandwidth=15.0, damping_ratio=0.6
    )
    found = virtual_work.direct_dynamics(
        sample.mechanism, sample.posture, sample.gamma_dot, told.torque
    )
    expected = desired.gamma_ddot + 225.0 * error + 18.0 * error_rate
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("sample", seeded_samples(4, 5), ids=range(5))
def test_on_so3_an_error_about_one_axis_decays_in_closed_form(sample):
    """R = R_d exp(-phi n) with phi'' = -2 w phi' - w^2 phi.

    R_d turns about the same axis.
    """
    w, phi0, t, axis = 12.0, 0.3, 0.05, np.array([0.48, 0.6, 0.64])
    phi, dot, ddot = (
        phi0 * np.exp(-w * t) * factor
        for factor in (1.0 + w * t, -w * w * t, w * w * (w * t - 1.0))
    )
    here, rate, acceleration = sample.rotation, 0.7, -1.3
    there = quaternion_of(here @ Rotation.from_rotvec(phi * axis).as_matrix())
    desired = ActuatorSpaceMap(sample.geometry).of_star(
        tuple(there.tolist()), tuple(rate * axis), tuple(acceleration * axis)
    )
    motion = rates.of_star(sample.geometry, here, here @ ((rate - dot) * axis))
    settings = {"mode": "computed_torque", "space": "so3", "bandwidth": w}
    told = answer(sample, desired, motion.gamma_dot, **settings)
    gamma_ddot = virtual_work.direct_dynamics(
        sample.mechanism, sample.posture, motion.gamma_dot, told.torque
    )
    found = rates.of_actuators(sample.posture, motion.gamma_dot, gamma_ddot).omega_dot
    expected = here @ ((acceleration - ddot) * axis)
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_gravity_pd_holds_the_weight_where_the_manipulator_is():
    model = scene.load("gravity_payload")
    # At rest and without a lag of the actuators, which the torque would have to grow
    # through.
    still = Initial(gamma=model.initial.gamma)
    model = dataclasses.replace(model, initial=still, actuators=None)
    simulation, motion = Simulation(model), turned(model)
    gamma = simulation.state.joints.gamma
    holding = Controller(model, motion, ControllerSettings(mode="gravity_pd"), PERIOD)
    told = holding.command(0.0, Measurement(gamma, ZERO))
    assert told.feedback == ZERO
    for _ in range(20):
        state = simulation.step(told.torque, 10_000_000)
    assert np.abs(np.subtract(state.joints.gamma, gamma)).max() < 1e-9


def loop(model, plant, motion, settings, seconds):
    """Close the loop; largest and last error of gamma [rad]."""
    acting, simulation = Controller(model, motion, settings, PERIOD), Simulation(plant)
    errors = []
    for k in range(round(seconds / PERIOD) + 1):
        joints = simulation.state.joints
        told = acting.command(k * PERIOD, Measurement(joints.gamma, joints.gamma_dot))
        errors.append(np.abs(told.error).max())
        simulation.step(told.torque, round(PERIOD * 1e9))
    return max(errors), errors[-1]


@pytest.mark.parametrize("space", ["gamma", "so3"])
def test_computed_torque_brings_the_manipulator_to_the_motion(space):
    off = dataclasses.replace(
        HEAVY,
        initial=Initial(gamma=tuple(np.add(HEAVY.initial.gamma, (0.2, -0.15, 0.1)))),
    )
    settings = ControllerSettings(
        mode="computed_torque", space=space, feedforward_at="middle"
    )
    largest, last = loop(HEAVY, off, turned(HEAVY, (0.1, 0.1, -0.2)), settings, 0.6)
    assert largest == pytest.approx(0.2, abs=0.02)  # no overshoot: critically damped
    assert last < 1e-5


def test_the_integral_takes_out_what_the_model_does_not_know():
    pushed = dataclasses.replace(HEAVY, moment=Moment(value=(0.5, -0.4, 0.3)))
    motion = turned(HEAVY, (0.1, 0.1, -0.2), duration=0.2)
    for mode in ("feedforward_pd", "computed_torque"):
        without, with_it = (
            loop(
                HEAVY,
                pushed,
                motion,
                ControllerSettings(mode=mode, integral_rate=r),
                1.2,
            )[1]
            for r in (0.0, 12.0)
        )
        assert without > 1e-4
        assert with_it < 1e-3 * without


@pytest.mark.parametrize("mode", ["pd", "computed_torque"])
def test_an_integral_that_would_be_unstable_is_refused(mode):
    """The bound is where a root of s^3 + kd s^2 + kp s + kp r crosses the imaginary
    axis.
    """
    motion, w, zeta = turned(HEAVY), 30.0, 0.8
    for share, sound in ((0.999, True), (1.001, False)):
        r = share * 2.0 * zeta * w
        roots = np.roots([1.0, 2.0 * zeta * w, w * w, w * w * r])
        assert (roots.real.max() < 0.0) == sound
        settings = ControllerSettings(
            mode=mode, bandwidth=w, damping_ratio=zeta, integral_rate=r
        )
        if sound:
            Controller(HEAVY, motion, settings, PERIOD)
        else:
            with pytest.raises(InputError, match="integral_rate"):
                Controller(HEAVY, motion, settings, PERIOD)


@pytest.mark.parametrize("mode", ["pd", "computed_torque"])
def test_the_sum_of_errors_stands_still_at_a_torque_limit(mode):
    """A second of an error that saturates leaves nothing behind.

    Without a limit it winds up.
    """
    motion = turned(HEAVY)
    begin = motion.at(0.0)
    away = tuple(angle - 0.1 for angle in begin.gamma)
    left = []
    for limit in (1.0, 0.0):
        settings = ControllerSettings(mode=mode, integral_rate=10.0, torque_limit=limit)
        acting = Controller(HEAVY, standing(begin), settings, PERIOD)
        for _ in range(500):
            told = acting.command(0.0, Measurement(away, ZERO))
        assert told.saturated == (limit > 0.0)
        left.append(acting.command(0.0, Measurement(begin.gamma, ZERO)))
    limited, unlimited = left
    assert np.abs(limited.torque).max() < 1e-12
    assert np.abs(unlimited.torque).max() > 1.0


def test_the_limit_of_the_models_actuators_holds_too():
    model = dataclasses.replace(HEAVY, actuators=Actuators(torque_limit=0.5))
    motion = turned(model)
    away = Measurement(tuple(angle - 0.2 for angle in model.initial.gamma), ZERO)
    for limit, expected in ((0.0, 0.5), (0.2, 0.2), (0.9, 0.5)):
        settings = ControllerSettings(mode="pd", torque_limit=limit)
        told = Controller(model, motion, settings, PERIOD).command(0.0, away)
        assert told.torque == (expected,) * 3 and told.saturated
        assert min(told.feedback) > 0.5  # what was asked for is told


@pytest.mark.parametrize("mode", MODES)
def test_what_is_not_finite_is_refused_until_a_reset(mode):
    acting = Controller(HEAVY, turned(HEAVY), ControllerSettings(mode=mode), PERIOD)
    gamma = HEAVY.initial.gamma
    good = Measurement(gamma, ZERO)
    for bad in (
        Measurement((np.nan, *gamma[1:]), ZERO),
        Measurement(gamma, (0.0, np.inf, 0.0)),
    ):
        acting.command(0.0, good)
        with pytest.raises(ControlStopped, match="must be finite"):
            acting.command(0.002, bad)
        with pytest.raises(ControlStopped, match=r"t = 0\.002"):
            acting.command(0.004, good)
        acting.reset()
    assert np.isfinite(acting.command(0.0, good).torque).all()


@pytest.mark.parametrize("mode", ["computed_torque", "gravity_pd"])
def test_angles_that_no_assembly_has_end_the_control(mode):
    rng, ended = np.random.default_rng(5), 0
    for sample in seeded_samples(6, 40):
        nowhere = tuple(rng.uniform(-1.5, 1.5, 3) + sample.gamma)
        if kinematics.direct(sample.geometry, nowhere):
            continue
        begin = ActuatorSpaceMap(sample.geometry).of_star(sample.quaternion, ZERO, ZERO)
        acting = Controller(
            sample.scene, standing(begin), ControllerSettings(mode=mode), PERIOD
        )
        with pytest.raises(ControlStopped, match="parallel singularity"):
            acting.command(PERIOD, Measurement(nowhere, ZERO))
        ended += 1
    assert ended >= 2


def test_an_assembly_is_followed_as_continuation_proves():
    """Over short and long steps, of a general manipulator.

    Also back to where it began.
    """
    for sample in seeded_samples(7, 5):
        begin = tuple(quaternion_of(sample.rotation).tolist())
        space, known = (
            ActuatorSpaceMap(sample.geometry),
            (begin, tuple(sample.gamma.tolist())),
        )
        way = sample.gamma + np.outer(
            np.sin([0.01, 0.02, 0.3, 0.31, 0.05]), (0.4, -0.3, 0.5)
        )
        truth, _ = continuation.follow(
            sample.geometry, [sample.gamma, *way], sample.rotation
        )
        for gamma, rotation in zip(way, truth[1:], strict=True):
            there = tuple(gamma.tolist())
            known = space.follow(*known, there), there
            assert np.abs(rotation_matrix(known[0]) - rotation).max() < 1e-12
        back = space.follow(*known, tuple(sample.gamma))
        assert np.abs(np.abs(np.dot(back, begin)) - 1.0) < 1e-14
