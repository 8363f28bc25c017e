# SPDX-License-Identifier: Apache-2.0
"""The state of a run from the paper's quantities: its begin, and its derivative by Eqs. 1 to 92.

The derivative is the paper's own, in plain Python. Each evaluation solves Eq. 90 for
gamma_ddot and takes omega_dot from Eq. 40.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import SingularConfiguration, refuse_unless
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.generic_math import quaternion_rate, triple
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of, rotation_matrix
from sst_ros.scene.scene import Scene
from sst_ros.state import ZERO

SINGULAR = 1.5e-5
"""det J2 below which rounding, over its square, leaves a rate of gamma less than six digits."""

NO_ASSEMBLY, NO_RATE = -1, -2
"""Codes of runs that cannot start: no unique admissible assembly.

gamma_dot is no motion there.
"""

_BLOCK = 2000  # starts solved at once: their arrays fit the cache


def initial_state(scene: Scene, geometry: Geometry) -> tuple[float, ...]:
    """Quaternion (x, y, z, w) and body rate [rad/s] at t = 0, seven numbers.

    Raises:
        AssemblyError: the initial gamma has no admissible assembly, or several and the
            scene selects none.
        SingularConfiguration: gamma_dot does not determine the body rate there.

    """
    initial, gamma = scene.initial, np.array(scene.initial.gamma)
    meant = (
        None if initial.orientation is None else rotation_matrix(initial.orientation)
    )
    assembly = kinematics.admissible(geometry, gamma, meant)
    rate, gamma_dot = np.zeros(3), np.array(initial.gamma_dot)
    if gamma_dot.any():  # rest needs no Jacobian, which a singular posture has not
        at = virtual_work.posture(geometry, gamma, assembly.rotation)
        determinant = float(np.linalg.det(at.j2))
        if abs(determinant) < SINGULAR:
            message = (
                "gamma_dot does not determine the body rate: parallel singularity,"
                " det J2"
            )
            raise SingularConfiguration(message, determinant)
        rate = assembly.rotation.T @ at.j @ gamma_dot
    return (*quaternion_of(assembly.rotation).tolist(), *rate.tolist())


def initial_states(
    geometries: Geometry, which: NDArray[np.intp], gamma: Array, gamma_dot: Array
) -> tuple[Array, NDArray[np.int64]]:
    """States at t = 0 of many runs, of which one that cannot start stops no other.

    They have gamma [rad] and gamma_dot [rad/s], shape (n, 3), and the geometries of
    index `which`, shape (n,). Returns quaternions and body rates [rad/s], shape (7, n),
    at rest where there is no start, and codes, shape (n,): 0, NO_ASSEMBLY or NO_RATE.
    """
    y, code = (
        np.zeros((7, len(gamma))),
        np.full(len(gamma), NO_ASSEMBLY, dtype=np.int64),
    )
    y[3] = 1.0
    for first in range(0, len(gamma), _BLOCK):
        part = slice(first, first + _BLOCK)
        starts = np.column_stack([which[part], gamma[part]])
        different, same = np.unique(starts, axis=0, return_inverse=True)
        own = geometries.of_rows(different[:, 0].astype(np.intp))
        found = kinematics.direct_many(own, different[:, 1:])
        valid = np.flatnonzero(found.admissible)
        owner = found.configuration[valid]
        one = np.zeros(len(different), dtype=np.intp)
        one[owner] = valid
        same = same.ravel()
        here = np.flatnonzero(np.bincount(owner, minlength=len(different))[same] == 1)
        rows, chosen = first + here, one[same[here]]
        y[:4, rows] = quaternion_of(found.rotation[chosen]).T
        moves = gamma_dot[rows].any(axis=1)
        singular = moves & (np.abs(found.det_j2[chosen]) < SINGULAR)
        code[rows] = np.where(singular, NO_RATE, 0)
        moves &= ~singular
        rows, rotation = rows[moves], found.rotation[chosen[moves]]
        geometry = geometries.of_rows(which[rows])
        # gamma_dot_k = g_k . W, g_k = (w_k - a t_k) / (1 - a^2), a = t_k . w_k, all in
        # {E}
        w = geometry.w @ rotation
        a = np.sum(geometry.e * w, axis=-1, keepdims=True)
        g = (w - a * geometry.e) / (1.0 - a * a)
        y[4:7, rows] = np.linalg.solve(g, gamma_dot[rows][..., None])[..., 0].T
    return y, code


@lru_cache(maxsize=64)
def start_of(scene: Scene) -> tuple[float, ...]:
    """Return `initial_state` of a scene.

    InputError where gamma lies outside the stroke.
    """
    gamma, geometry = np.array(scene.initial.gamma), Geometry.of(scene)
    inside = scene.stroke.at_end != "stop" or bool(
        np.all((gamma >= 0) & (gamma <= geometry.arc))
    )
    ends = ", ".join(f"{arc:.6f}" for arc in geometry.arc)
    allowed = f"must lie in the stroke, 0 to ({ends}) rad"
    refuse_unless(scene.name, ("initial.gamma", scene.initial.gamma, inside, allowed))
    return initial_state(scene, geometry)


def derive_by_paper(scene: Scene) -> Callable[..., tuple[float, ...]]:
    """Return the derivative of a scene's state by Eqs. 1 to 92, as integrators take it.

    Its inputs are time, quaternion, body rate [rad/s], work [J], torques [N m], and a
    moment on the star in {B} [N m] if it comes from a topic. In a singular posture it
    raises ArithmeticError.

    The scene may have bodies, payload, rotors, torque limits and an external moment, as
    the paper has them or in its inertias and n_ext; InputError names each other term.
    """
    lag = scene.actuators and scene.actuators.time_constant
    end, terms = scene.stroke.at_end, ("gravity", "friction", "springs", "own_loads")
    refused = "the equations of the paper have no such term: use equations = quaternion"
    refuse_unless(
        scene.name,
        *(
            (name, getattr(scene, name), not getattr(scene, name), refused)
            for name in terms
        ),
        ("actuators.time_constant", lag, not scene.lags, refused),
        ("stroke.at_end", end, end != "elastic", refused),
    )
    mechanism = virtual_work.Mechanism.of(scene)
    constant = np.array((scene.moment and scene.moment.value) or ZERO)

    def derivative(_: float, *inputs: float) -> tuple[float, ...]:
        (x, y, z, w, *rate), torque = inputs[:7], np.array(inputs[8:11])
        moment = constant + inputs[11:14] if len(inputs) > 11 else constant
        rotation = rotation_matrix(inputs[:4])
        gamma, omega = (
            kinematics.inverse(mechanism.geometry, rotation)[0],
            rotation @ rate,
        )
        try:
            at = virtual_work.posture(mechanism.geometry, gamma, rotation)
        except SingularConfiguration as error:
            raise ArithmeticError(str(error)) from None
        gamma_dot = np.linalg.solve(at.j, omega)
        gamma_ddot = virtual_work.direct_dynamics(
            mechanism, at, gamma_dot, torque, moment
        )
        # Eq. 40; R W_dot = omega_dot, because W x W = 0.
        omega_dot = at.j @ gamma_ddot + virtual_work.bias(at, gamma_dot).omega_dot
        acceleration, turning = (
            rotation.T @ omega_dot,
            quaternion_rate((x, y, z, w), triple(rate)),
        )
        return (
            *turning,
            *acceleration.tolist(),
            float(torque @ gamma_dot + moment @ omega),
        )

    return derivative
