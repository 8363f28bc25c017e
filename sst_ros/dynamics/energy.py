# SPDX-License-Identifier: Apache-2.0
"""Energies and powers of a state: what a run's balance is kept with."""

from __future__ import annotations

from sst_ros.dynamics import loads
from sst_ros.dynamics.kernel import Model, State, field_of, leg_motion
from sst_ros.mechanism.generic_math import Scalar, Triple, dot, rotation_rows, sqrt


def kinetic(model: Model, state: State) -> Scalar:
    """Kinetic energy of all seven links, payload and rotors [J]."""
    x, y, z, w, wx, wy, wz = state[:7]
    ixx, iyy, izz, ixy, ixz, iyz = model.star
    total = ixx * wx * wx + iyy * wy * wy + izz * wz * wz
    total = total + 2.0 * (ixy * wx * wy + ixz * wx * wz + iyz * wy * wz)
    rows = rotation_rows((x, y, z, w))
    for leg in model.legs:
        at = leg_motion(leg, rows, (wx, wy, wz))
        total = total + (leg.a0 + leg.a2 * (at.a * at.a)) * at.gamma_dot * at.gamma_dot
        if leg.ixy or leg.ixz or leg.iyz:
            root = sqrt(at.u)
            mixed = (leg.ixz * at.a / root - leg.ixy) * at.a_dot
            mixed = mixed - leg.iyz * at.a * root * at.gamma_dot
            total = total + 2.0 * mixed * at.gamma_dot
    return 0.5 * total


def potential(model: Model, state: State) -> Scalar:
    """Potential energy [J]: weight, springs and elastic ends."""
    x, y, z, w, wx, wy, wz = state[:7]
    rows = rotation_rows((x, y, z, w))
    field = field_of(model, rows)
    total: Scalar = 0.0 if model.gravity is None else -dot(model.weight, field)
    for leg in model.legs:
        if leg.loads is not None:
            at = leg_motion(leg, rows, (wx, wy, wz))
            total = total + loads.potential_energy(leg.loads, at, leg.across, leg.v, field)
    return total


def power(model: Model, state: State, torque: Triple, moment: Triple | None = None) -> Scalar:
    """Power [W] that actuators and external moments put in, less what friction takes out.

    It is the rate of kinetic plus potential energy. With lag the torques are the state's own.
    """
    x, y, z, w, wx, wy, wz, *given = state
    rows = rotation_rows((x, y, z, w))
    acting = torque if model.time_constant is None else given
    total: Scalar = 0.0
    for leg, drive in zip(model.legs, acting, strict=True):
        at = leg_motion(leg, rows, (wx, wy, wz))
        total = total + drive * at.gamma_dot
        if leg.loads is not None:
            total = total - loads.dissipation(leg.loads, at, leg.across, leg.v)
    for external in (model.moment, moment):
        if external is not None:
            omega = tuple(dot(row, (wx, wy, wz)) for row in rows)
            total = total + dot(external, (omega[0], omega[1], omega[2]))
    return total
