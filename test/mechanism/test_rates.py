# SPDX-License-Identifier: Apache-2.0
"""Every Jacobian, rate and acceleration against differentiation in 60 digits.

R(t) is prescribed, so that gamma, mu, beta and all link frames follow in closed form in mpmath.
"""

import mpmath as mp
import numpy as np
import pytest
from mechanism.closed_chains import ISOTROPIC, random_geometry, random_pose

from sst_ros.errors import SingularConfiguration
from sst_ros.mechanism import rates, virtual_work

RELATIVE = 1e-12
STEP = mp.mpf(10) ** -14


def vector(values):
    return [mp.mpf(float(x)) for x in values]


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def times(matrix, v):
    return [dot(row, v) for row in matrix]


def rodrigues(phi):
    """Exp of a rotation vector."""
    angle = mp.sqrt(dot(phi, phi))
    x, y, z = (p / angle for p in phi) if angle else (0, 0, 0)
    k = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    sine, versine = mp.sin(angle), 1 - mp.cos(angle)
    square = [[dot(row, [k[i][j] for i in range(3)]) for j in range(3)] for row in k]
    return [
        [(i == j) + sine * k[i][j] + versine * square[i][j] for j in range(3)] for i in range(3)
    ]


class Motion:
    """R(t) = Exp(first t + second t^2 / 2) R_0 and all that it moves, in {B}, exactly."""

    def __init__(self, geometry, rotation, first, second, signs):
        self.start = [vector(row) for row in rotation]
        self.first, self.second, self.signs = vector(first), vector(second), signs
        self.v, self.w, self.e = (
            [vector(x) for x in y] for y in (geometry.v, geometry.w, geometry.e)
        )

    def rotation(self, t):
        turn = rodrigues(
            [a * t + b * t * t / 2 for a, b in zip(self.first, self.second, strict=True)]
        )
        columns = [[row[j] for row in self.start] for j in range(3)]
        turned = [times(turn, column) for column in columns]
        return [[turned[j][i] for j in range(3)] for i in range(3)]

    def leg(self, t, k):
        """gamma, mu, beta and the frames {1k}, {2k} as lists of columns."""
        matrix = self.rotation(t)
        axis, s, w = times(matrix, self.e[k]), [row[2] for row in matrix], self.w[k]
        p = [self.signs[k] * x for x in cross(axis, w)]
        length = mp.sqrt(dot(p, p))
        r = [x / length for x in p]
        gamma = mp.atan2(dot(r, cross(w, self.v[k])), dot(r, self.v[k]))
        mu = mp.atan2(dot(cross(axis, w), r), dot(axis, w))
        beta = mp.atan2(dot(r, cross(axis, s)), dot(r, s))
        return gamma, mu, beta, [r, cross(w, r), w], [r, cross(axis, r), axis]


def derivative(f, order, h=STEP):
    """Sixth-order central differences in 60 digits: good for 1e-30 and better."""
    values = [f(i * h) for i in range(-3, 4)]
    weights = {1: [-1, 9, -45, 0, 45, -9, 1], 2: [2, -27, 270, -490, 270, -27, 2]}[order]
    scale = {1: 60 * h, 2: 180 * h * h}[order]
    return [sum(c * x[i] for c, x in zip(weights, values, strict=True)) / scale
            for i in range(len(values[0]))]  # fmt: skip


def spin(frame, order):
    """Angular velocity (order 1) or acceleration (2), in {B}, of t -> list of three columns."""

    def omega(t):
        here = frame(t)
        moved = [derivative(lambda x, i=i: frame(t + x)[i], 1) for i in range(3)]
        total = [cross(c, d) for c, d in zip(here, moved, strict=True)]
        return [sum(parts) / 2 for parts in zip(*total, strict=True)]

    if order == 1:
        return omega(0)
    return derivative(omega, 1)


def relative(found, expected):
    expected = np.array([float(x) for x in expected])
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


def samples():
    rng = np.random.default_rng(11)
    for index in range(6):
        geometry = ISOTROPIC if index == 0 else random_geometry(rng)
        signs = [1, 1, 1] if index < 4 else [1, -1, -1]
        gamma, rotation = random_pose(rng, geometry)
        gamma = gamma + np.pi * (np.array(signs) < 0)
        yield geometry, gamma, rotation, rng.normal(size=3), rng.normal(size=3), signs


@pytest.mark.parametrize("sample", list(samples()), ids=range(6))
def test_rates_and_accelerations_of_every_joint_and_link(sample):
    geometry, gamma, rotation, first, second, signs = sample
    with mp.workdps(60):
        exact = Motion(geometry, rotation, first, second, signs)
        legs = [exact.leg(mp.mpf(0), k) for k in range(3)]
        joints = {}
        for order in (1, 2):
            values = [derivative(lambda t, k=k: exact.leg(t, k)[:3], order) for k in range(3)]
            joints[order] = [[leg[i] for leg in values] for i in range(3)]
        star = [spin(lambda t: [list(c) for c in zip(*exact.rotation(t), strict=True)], order)
                for order in (1, 2)]  # fmt: skip
        links = {}
        for order in (1, 2):
            for frame in (3, 4):
                seen = [spin(lambda t, k=k, frame=frame: exact.leg(t, k)[frame], order)
                        for k in range(3)]  # fmt: skip
                links[order, frame] = np.array(
                    [[float(dot(axis, seen[k])) for axis in legs[k][frame]] for k in range(3)]
                )
        joints = {o: np.array([[float(x) for x in row] for row in v]) for o, v in joints.items()}
    star = np.array([[float(x) for x in row] for row in star])
    at = virtual_work.posture(geometry, gamma, rotation)
    from_star = rates.of_star(geometry, rotation, star[0], star[1], gamma)
    from_actuators = rates.of_actuators(at, joints[1][0], joints[2][0])
    assert not from_actuators.omega.flags.writeable
    for motion in (from_star, from_actuators):
        pairs = [
            (motion.omega, star[0]),
            (motion.omega_dot, star[1]),
            (motion.gamma_dot, joints[1][0]),
            (motion.mu_dot, joints[1][1]),
            (motion.beta_dot, joints[1][2]),
            (motion.gamma_ddot, joints[2][0]),
            (motion.mu_ddot, joints[2][1]),
            (motion.beta_ddot, joints[2][2]),
            (motion.omega_a, links[1, 3]),
            (motion.omega_a_dot, links[2, 3]),
            (motion.omega_ipl, links[1, 4]),
            (motion.omega_ipl_dot, links[2, 4]),
        ]
        assert max(relative(f.ravel(), e.ravel()) for f, e in pairs) <= RELATIVE
    # The paper's rows, one by one.
    bias = virtual_work.bias(at, joints[1][0])
    ja, jipl = virtual_work.link_jacobians(at)
    rate, acceleration = joints[1][0], joints[2][0]
    pairs = [
        (at.j @ rate, star[0]),
        (at.a @ rate, joints[1][1]),
        (at.b @ rate, joints[1][2]),
        (bias.omega, star[0]),
        (at.j @ acceleration + bias.omega_dot, star[1]),
        (at.a @ acceleration + bias.mu_ddot, joints[2][1]),
        (at.b @ acceleration + bias.beta_ddot, joints[2][2]),
        (at.u @ acceleration + bias.beta_ddot, joints[2][2]),
        (ja @ rate, links[1, 3]),
        (jipl @ rate, links[1, 4]),
    ]
    assert max(relative(f.ravel(), e.ravel()) for f, e in pairs) <= RELATIVE


def test_a_serial_singularity_is_refused():
    axis = ISOTROPIC.w[0]  # t_1 = R e_1 = w_1
    s = np.cross(axis, [1.0, 1.0, 0.0]) / np.linalg.norm(np.cross(axis, [1.0, 1.0, 0.0]))
    rotation = np.stack([np.cross(axis, s), axis, s], axis=1)
    with pytest.raises(SingularConfiguration, match="serial"):
        rates.of_star(ISOTROPIC, rotation, [1.0, 0.0, 0.0])
