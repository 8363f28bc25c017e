# SPDX-License-Identifier: Apache-2.0
"""The state of a run from the paper's quantities: its begin, and its derivative.

The derivative is the paper's own, Eqs. 1 to 92, in plain Python. Each evaluation solves
Eq. 90 for gamma_ddot and takes omega_dot from Eq. 40.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import Check, SingularConfiguration, refuse_unless
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.generic_math import quaternion_rate
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of, rotation_matrix
from sst_ros.scene.scene import Scene
from sst_ros.state import ZERO

SINGULAR_START = 1.5e-5
"""Least det J2 of a start with rates.

Below it rounding, over its square, leaves gamma_dot less than six digits.
"""

# Codes of runs that cannot start.
NO_ASSEMBLY = -1  # gamma has no unique admissible assembly
NO_RATE = -2  # gamma_dot is no motion there

STARTS_AT_ONCE = 2000  # starts solved at once: their arrays fit the cache


def initial_state(scene: Scene, geometry: Geometry) -> tuple[float, ...]:
    """Quaternion (x, y, z, w) and body rate [rad/s] at t = 0, seven numbers.

    Raises:
        AssemblyError: the initial gamma has no admissible assembly, or several and the
            scene selects none.
        SingularConfiguration: gamma_dot does not determine the body rate there.

    """
    gamma = np.array(scene.initial.gamma)
    gamma_dot = np.array(scene.initial.gamma_dot)
    orientation = scene.initial.orientation
    if orientation is not None:
        rotation = kinematics.admissible(
            geometry, gamma, rotation_matrix(orientation)
        ).rotation
    else:
        rotation = kinematics.admissible(geometry, gamma).rotation
    rate = np.zeros(3)
    if gamma_dot.any():  # at rest no Jacobian is needed: a singular posture has none
        posture = virtual_work.posture(geometry, gamma, rotation)
        determinant = float(np.linalg.det(posture.j2))
        if abs(determinant) < SINGULAR_START:
            message = "gamma_dot does not determine the body rate: parallel singularity"
            raise SingularConfiguration(f"{message}, det J2", determinant)
        rate = rotation.T @ posture.j @ gamma_dot
    return (*quaternion_of(rotation).tolist(), *rate.tolist())


def initial_states(
    geometries: Geometry,
    geometry_index: NDArray[np.intp],
    gamma: Array,
    gamma_dot: Array,
) -> tuple[Array, NDArray[np.int64]]:
    """Return the states at t = 0 of many runs; one that cannot start stops no other.

    Args:
        geometries: of the runs, the distinct ones.
        geometry_index: which of them each run has, shape (n,).
        gamma: initial angles of the actuators [rad], shape (n, 3).
        gamma_dot: their rates [rad/s], shape (n, 3).

    Returns:
        Quaternions and body rates [rad/s], shape (7, n), at rest where there is no
        start; and codes, shape (n,): 0, NO_ASSEMBLY or NO_RATE.

    """
    count = len(gamma)
    quaternions = np.zeros((4, count))
    quaternions[-1] = 1.0
    rates = np.zeros((3, count))
    codes = np.full(count, NO_ASSEMBLY, dtype=np.int64)
    for first in range(0, count, STARTS_AT_ONCE):
        block = slice(first, first + STARTS_AT_ONCE)
        # Equal starts, a geometry and its gamma, are solved once.
        starts = np.column_stack([geometry_index[block], gamma[block]])
        distinct, start_of_row = np.unique(starts, axis=0, return_inverse=True)
        start_of_row = start_of_row.ravel()
        own = geometries.of_rows(distinct[:, 0].astype(np.intp))
        assemblies = kinematics.direct_many(own, distinct[:, 1:])
        admissible = np.flatnonzero(assemblies.admissible)
        owner = assemblies.configuration[admissible]
        assembly_of_start = np.zeros(len(distinct), dtype=np.intp)
        assembly_of_start[owner] = admissible
        counts = np.bincount(owner, minlength=len(distinct))
        unique = np.flatnonzero(counts[start_of_row] == 1)
        rows = first + unique
        selected = assembly_of_start[start_of_row[unique]]
        quaternions[:, rows] = quaternion_of(assemblies.rotation[selected]).T
        moves = gamma_dot[rows].any(axis=1)
        singular = moves & (np.abs(assemblies.det_j2[selected]) < SINGULAR_START)
        codes[rows] = np.where(singular, NO_RATE, 0)
        moves &= ~singular
        rows = rows[moves]
        rotation = assemblies.rotation[selected[moves]]
        geometry = geometries.of_rows(geometry_index[rows])
        rates[:, rows] = _body_rates(geometry, rotation, gamma_dot[rows]).T
    return np.vstack([quaternions, rates]), codes


def _body_rates(geometry: Geometry, rotation: Array, gamma_dot: Array) -> Array:
    """Solve gamma_dot_k = g_k . W for W in {E} [rad/s], shape (n, 3).

    g_k = (w_k - a t_k) / (1 - a^2) with a = t_k . w_k, all in {E}.
    """
    w = geometry.w @ rotation
    a = np.sum(geometry.e * w, axis=-1, keepdims=True)
    g = (w - a * geometry.e) / (1.0 - a * a)
    rates = np.linalg.solve(g, gamma_dot[..., None])[..., 0]
    return np.asarray(rates, dtype=float)


@lru_cache(maxsize=64)
def start_of(scene: Scene) -> tuple[float, ...]:
    """Return `initial_state` of a scene.

    InputError is raised where gamma is outside the stroke.
    """
    geometry = Geometry.of(scene)
    gamma = np.array(scene.initial.gamma)
    in_stroke = bool(np.all((gamma >= 0) & (gamma <= geometry.arc)))
    inside = scene.stroke.at_end != "stop" or in_stroke
    ends = ", ".join(f"{arc:.6f}" for arc in geometry.arc)
    requirement = f"must lie in the stroke, 0 to ({ends}) rad"
    refuse_unless(
        scene.name, ("initial.gamma", scene.initial.gamma, inside, requirement)
    )
    return initial_state(scene, geometry)


def derive_by_paper(scene: Scene) -> Callable[..., tuple[float, ...]]:
    """Return the derivative of a scene's state by Eqs. 1 to 92, as integrators take it.

    Its inputs are time, quaternion, body rate [rad/s], work [J], torques [N m], and a
    moment on the star in {B} [N m] if it comes from a topic. In a singular posture it
    raises ArithmeticError.

    The scene may have bodies, payload, rotors, torque limits and an external moment, as
    the paper has them or in its inertias and n_ext; InputError names each other term.
    """
    requirement = (
        "the equations of the paper have no such term: use equations = quaternion"
    )
    checks: list[Check] = []
    for name in ("gravity", "friction", "springs", "own_loads"):
        term = getattr(scene, name)
        checks.append((name, term, not term, requirement))
    lag = None
    if scene.actuators is not None:
        lag = scene.actuators.time_constant
    checks.append(("actuators.time_constant", lag, not scene.lags, requirement))
    at_end = scene.stroke.at_end
    checks.append(("stroke.at_end", at_end, at_end != "elastic", requirement))
    refuse_unless(scene.name, *checks)
    mechanism = virtual_work.Mechanism.of(scene)
    constant = np.array(ZERO)
    if scene.moment is not None and scene.moment.value is not None:
        constant = np.array(scene.moment.value)

    def derivative(_time: float, *inputs: float) -> tuple[float, ...]:
        x, y, z, w, wx, wy, wz, _work, *drive = inputs
        tau_1, tau_2, tau_3, *topic_moment = drive
        torque = np.array((tau_1, tau_2, tau_3))
        moment = constant
        if topic_moment:
            moment = constant + topic_moment
        rotation = rotation_matrix((x, y, z, w))
        omega: Array = rotation @ np.array((wx, wy, wz))
        gamma, _, _ = kinematics.inverse(mechanism.geometry, rotation)
        try:
            posture = virtual_work.posture(mechanism.geometry, gamma, rotation)
        except SingularConfiguration as error:
            raise ArithmeticError(str(error)) from None
        gamma_dot = np.linalg.solve(posture.j, omega)
        gamma_ddot = virtual_work.direct_dynamics(
            mechanism, posture, gamma_dot, torque, moment
        )
        products = virtual_work.bias(posture, gamma_dot)
        omega_dot = posture.j @ gamma_ddot + products.omega_dot  # Eq. 40
        # R W_dot = omega_dot, because W x W = 0.
        acceleration = rotation.T @ omega_dot
        turning = quaternion_rate((x, y, z, w), (wx, wy, wz))
        power = float(torque @ gamma_dot + moment @ omega)
        return (*turning, *acceleration.tolist(), power)

    return derivative
