# SPDX-License-Identifier: Apache-2.0
"""A kernel that was written without any optional term: what a plain scene may cost at most.

Seven links, three torques, nothing else; it knows of no load, no lag, no payload and has no branch
but one on the products of inertia. Per leg, with a = cos(mu), s = sin(mu) and the rate c of gamma,
the intermediate link turns in {2k} with (a' / s, -s c, a c), the actuated one about its own z axis
with c. Across its arc's axis the intermediate link turns with the star, so ixx (1 - e e^T) is added
to the star once. Lagrange's equations of the two coordinates (a, gamma) of the rest give two
forces, which work on the star through p and g in a' = p.W and c = g.W.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sst_ros.dynamics.expression import Program, trace
from sst_ros.mechanism.generic_math import sqrt

INPUTS = ("x", "y", "z", "w", "wx", "wy", "wz", "t1", "t2", "t3")


class BareLeg(NamedTuple):
    """Axis w in {B}, arc's axis (e0, e1, 0) in {E}, I_a(zz), tensor of the intermediate link."""

    w: list[float]
    e: list[float]
    drive: float
    link: list[list[float]]


def legs_of(v, alpha, actuated, intermediate) -> list[BareLeg]:
    """Constants from plain arrays; alpha in radians."""
    v = np.asarray(v, dtype=float)
    v = v / np.linalg.norm(v, axis=1)[:, None]
    angle, found = 0.0, []
    for k in range(3):
        normal = np.cross(v[k], v[(k + 1) % 3])
        normal /= np.linalg.norm(normal)
        e = [-float(np.sin(angle)), float(np.cos(angle))]
        drive = float(actuated[k][2][2])
        found.append(BareLeg(normal.tolist(), e, drive, np.asarray(intermediate[k]).tolist()))
        angle += alpha[k]
    return found


def derivative(star, legs, x, y, z, w, wx, wy, wz, *torque):
    """q' and W' as the kernel of sst_ros has them."""
    n = 2.0 / (x * x + y * y + z * z + w * w)
    nx, ny, nz = n * x, n * y, n * z
    rotation = (
        (1.0 - (ny * y + nz * z), nx * y - nz * w, nx * z + ny * w),
        (nx * y + nz * w, 1.0 - (nx * x + nz * z), ny * z - nx * w),
        (nx * z - ny * w, ny * z + nx * w, 1.0 - (nx * x + ny * y)),
    )
    star, rate = with_links(star, legs), (wx, wy, wz)
    spin = [sum(star[i][j] * rate[j] for j in range(3)) for i in range(3)]
    force = [spin[1] * wz - spin[2] * wy, spin[2] * wx - spin[0] * wz, spin[0] * wy - spin[1] * wx]
    mass = [list(row) for row in star]
    for leg, drive in zip(legs, torque, strict=True):
        add_leg(mass, force, leg, drive, rotation, rate)
    return (
        0.5 * (w * wx + y * wz - z * wy),
        0.5 * (w * wy + z * wx - x * wz),
        0.5 * (w * wz + x * wy - y * wx),
        -0.5 * (x * wx + y * wy + z * wz),
        *solved(mass, force),
    )


def with_links(star, legs):
    """The star's tensor with what of the intermediate links turns as it does."""
    total = np.array(star)
    for leg in legs:
        e = np.array([*leg.e, 0.0])
        total += leg.link[0][0] * (np.eye(3) - np.outer(e, e))
    return total.tolist()


def add_leg(mass, force, leg, drive, rotation, rate):
    (ixx, ixy, ixz), (_, iyy, iyz), (_, _, izz) = leg.link
    e0, e1 = leg.e
    axis = [sum(leg.w[i] * rotation[i][j] for i in range(3)) for j in range(3)]
    a, side = e0 * axis[0] + e1 * axis[1], e0 * axis[1] - e1 * axis[0]
    p = (e1 * axis[2], -(e0 * axis[2]), side)
    u = side * side + axis[2] * axis[2]
    g = ((axis[0] - a * e0) / u, (axis[1] - a * e1) / u, axis[2] / u)
    a_rate, c = dot(p, rate), dot(g, rate)
    # Accelerations of a and gamma that W' = 0 leaves.
    about = e0 * rate[0] + e1 * rate[1]
    a_left = dot(axis, rate) * about - a * dot(rate, rate)
    c_left = a_rate * (2.0 * a * c - about) / u
    # Energy m a' c + d c^2 / 2 and its slopes by a.
    d = (leg.drive + iyy - ixx) + (izz - iyy + ixx) * (a * a)
    d_slope = 2.0 * (izz - iyy + ixx) * a
    m = m_slope = 0.0
    if ixy or ixz or iyz:
        root = sqrt(u)
        m, m_slope = ixz * a / root - ixy, ixz / (u * root)
        d = d - 2.0 * iyz * a * root
        d_slope = d_slope - 2.0 * iyz * (1.0 - 2.0 * a * a) / root
    on_a = m * c_left - 0.5 * d_slope * c * c
    on_c = d * c_left + m * a_left + d_slope * a_rate * c + m_slope * a_rate * a_rate - drive
    for i in range(3):
        force[i] = force[i] - on_a * p[i] - on_c * g[i]
        for j in range(i, 3):
            toward = m * g[i] * p[j] + (m * p[i] + d * g[i]) * g[j]
            mass[i][j] = mass[i][j] + toward


def solved(mass, force):
    """Cholesky without roots, upper triangle."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = mass
    fx, fy, fz = force
    first, second = xy / xx, xz / xx
    pivot, mixed = yy - first * xy, yz - second * xy
    third = mixed / pivot
    y = fy - first * fx
    z = (fz - second * fx - third * y) / (zz - second * xz - third * mixed)
    y = y / pivot - third * z
    return fx / xx - first * y - second * z, y, z


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def program_of(scene) -> Program:
    """The bare kernel of a scene's seven links, traced like the real one."""
    legs = legs_of(
        scene.base.v,
        np.radians(scene.star.alpha_deg),
        [link.inertia.matrix for link in scene.actuated_links],
        [link.inertia.matrix for link in scene.intermediate_links],
    )
    star = scene.star.inertia.matrix.tolist()
    return trace(lambda *inputs: derivative(star, legs, *inputs), INPUTS)
