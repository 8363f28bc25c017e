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

import numpy as np

from sst_ros.dynamics.expression import Program, trace
from sst_ros.mechanism.generic_math import (
    cross3,
    dot3,
    quaternion_rate,
    rotate_back,
    rotation_rows,
    solve_symmetric,
    sqrt,
)
from sst_ros.mechanism.geometry import Geometry

INPUTS = ("x", "y", "z", "w", "wx", "wy", "wz", "t1", "t2", "t3")


def derivative(star, legs, q, rate, torque):
    """q' and W' as the kernel of sst_ros has them; legs are (w, e, drive, tensor of the link)."""
    rotation = rotation_rows(q)
    mass = np.array(star)
    for _, e, _, link in legs:
        mass = mass + link[0][0] * (np.eye(3) - np.outer(e, e))
    mass = mass.tolist()
    force = list(cross3([dot3(row, rate) for row in mass], rate))
    for leg, drive in zip(legs, torque, strict=True):
        add_leg(mass, force, leg, drive, rotation, rate)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = mass
    return *quaternion_rate(q, rate), *solve_symmetric((xx, yy, zz, xy, xz, yz), force)


def add_leg(mass, force, leg, drive, rotation, rate):
    w, (e0, e1, _), own, ((ixx, ixy, ixz), (_, iyy, iyz), (_, _, izz)) = leg
    axis = rotate_back(rotation, w)
    a, side = e0 * axis[0] + e1 * axis[1], e0 * axis[1] - e1 * axis[0]
    p = (e1 * axis[2], -(e0 * axis[2]), side)
    u = side * side + axis[2] * axis[2]
    g = ((axis[0] - a * e0) / u, (axis[1] - a * e1) / u, axis[2] / u)
    a_rate, c = dot3(p, rate), dot3(g, rate)
    # Accelerations of a and gamma that W' = 0 leaves.
    about = e0 * rate[0] + e1 * rate[1]
    a_left = dot3(axis, rate) * about - a * dot3(rate, rate)
    c_left = a_rate * (2.0 * a * c - about) / u
    # Energy m a' c + d c^2 / 2 and its slopes by a.
    d = (own + iyy - ixx) + (izz - iyy + ixx) * (a * a)
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
            mass[i][j] = mass[i][j] + (m * g[i] * p[j] + (m * p[i] + d * g[i]) * g[j])


def program_of(scene) -> Program:
    """The bare kernel of a scene's seven links, traced like the real one."""
    geometry = Geometry.of(scene)
    drives = [float(link.inertia.zz) for link in scene.actuated_links]
    links = [link.inertia.matrix.tolist() for link in scene.intermediate_links]
    legs = list(zip(geometry.w.tolist(), geometry.e.tolist(), drives, links, strict=True))
    star = scene.star.inertia.matrix
    return trace(lambda *x: derivative(star, legs, x[:4], x[4:7], x[7:]), INPUTS)
