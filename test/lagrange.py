# SPDX-License-Identifier: Apache-2.0
"""An independent truth: Lagrange's equations at 50 digits, without any formula of the paper.

Loop closure r_k . R e_k = 0 is solved by Newton's method; the frames of all seven links are built
by geometry; angular velocities, the inertia matrix's slopes and all second derivatives are
central differences. Differences of step h at d digits err by about h^2 and 10^-d / h: the inner
step 1e-16 leaves 1e-32, the outer step 1e-10 on top of it leaves 1e-20, far below 1e-12.
"""

from __future__ import annotations

from mpmath import mp, mpf

DIGITS = 50
INNER = mpf(10) ** -16
OUTER = mpf(10) ** -10
NEWTON = mpf(10) ** -30


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def add(a, b, factor=1):
    return [x + factor * y for x, y in zip(a, b, strict=True)]


def unit(a):
    length = mp.sqrt(dot(a, a))
    return [x / length for x in a]


def solve(rows, right):
    """Cramer's rule for three equations."""
    a, b, c = rows
    bc, ca, ab = cross(b, c), cross(c, a), cross(a, b)
    determinant = dot(a, bc)
    return [
        (right[0] * bc[i] + right[1] * ca[i] + right[2] * ab[i]) / determinant for i in range(3)
    ]


def times(m, a):
    return [dot(row, a) for row in m]


def columns(*vectors):
    return [list(row) for row in zip(*vectors, strict=True)]


def turned(rotation, turn):
    """Exponential of a rotation vector in {B} times R."""
    angle = mp.sqrt(dot(turn, turn))
    if angle == 0:
        return rotation
    axis, sine, cosine = [x / angle for x in turn], mp.sin(angle), mp.cos(angle)
    result = []
    for column in zip(*rotation, strict=True):
        along = dot(axis, column) * (1 - cosine)
        across = cross(axis, column)
        result.append(
            [
                cosine * c + sine * x + along * n
                for c, x, n in zip(column, across, axis, strict=True)
            ]
        )
    return columns(*result)


def spin(before, after, middle, h):
    """Angular velocity in {B} of a frame from its values h before and after."""
    rate = [
        [(y - x) / (2 * h) for x, y in zip(*rows, strict=True)]
        for rows in zip(before, after, strict=True)
    ]
    w = [[dot(rate[i], middle[j]) for j in range(3)] for i in range(3)]
    return [(w[2][1] - w[1][2]) / 2, (w[0][2] - w[2][0]) / 2, (w[1][0] - w[0][1]) / 2]


class Lagrange:
    """The manipulator of a scene near the assembly `rotation` (3 x 3 floats)."""

    def __init__(self, scene, rotation):
        mp.dps = DIGITS
        self.v = [unit([mpf(x) for x in row]) for row in scene.base.v]
        self.w = [unit(cross(self.v[k], self.v[(k + 1) % 3])) for k in range(3)]
        alpha = [mpf(angle) * mp.pi / 180 for angle in scene.star.alpha_deg]
        turns = [mpf(0), alpha[0], alpha[0] + alpha[1]]
        self.e = [[-mp.sin(f), mp.cos(f), mpf(0)] for f in turns]
        links = [scene.star, *scene.actuated_links, *scene.intermediate_links]
        self.inertias = [
            [[mpf(x) for x in row] for row in link.inertia.matrix.tolist()] for link in links
        ]
        guess = [[mpf(float(x)) for x in row] for row in rotation]
        t, s = unit([row[1] for row in guess]), [row[2] for row in guess]
        s = unit(add(s, t, -dot(s, t)))
        self._guess = columns(cross(t, s), t, s)

    def carriages(self, gamma):
        return [
            add([mp.cos(g) * x for x in v], cross(w, v), mp.sin(g))
            for g, v, w in zip(gamma, self.v, self.w, strict=True)
        ]

    def rotation(self, gamma):
        """R that closes the loops."""
        r, rotation = self.carriages(gamma), self._guess
        for _ in range(12):
            t = [times(rotation, e) for e in self.e]
            misfit = [-dot(*pair) for pair in zip(r, t, strict=True)]
            turn = solve([cross(*pair) for pair in zip(t, r, strict=True)], misfit)
            rotation = turned(rotation, turn)
            if max(map(abs, turn)) < NEWTON:  # converges quadratically: now exact
                self._guess = rotation
                return rotation
        raise ArithmeticError("loop closure did not converge")

    def frames(self, gamma):
        """Star, {11} {12} {13}, {21} {22} {23}: rotations in {B}."""
        star, first, second = self.rotation(gamma), [], []
        for r, w, e in zip(self.carriages(gamma), self.w, self.e, strict=True):
            t = times(star, e)
            first.append(columns(r, cross(w, r), w))
            second.append(columns(r, cross(t, r), t))
        return [star, *first, *second]

    def spins(self, gamma, gamma_dot):
        """Angular velocities of all links, each in its own frame."""
        middle = self.frames(gamma)
        before = self.frames(add(gamma, gamma_dot, -INNER))
        after = self.frames(add(gamma, gamma_dot, INNER))
        spins = [spin(*frames, INNER) for frames in zip(before, after, middle, strict=True)]
        return [times(columns(*frame), omega) for frame, omega in zip(middle, spins, strict=True)]

    def inertia_matrix(self, gamma):
        """Second derivatives of T by the rates; T is a quadratic form of them."""
        units = [[mpf(i == j) for j in range(3)] for i in range(3)]
        partial = [self.spins(gamma, direction) for direction in units]
        return [
            [
                sum(
                    dot(a, times(m, b)) for m, a, b in zip(self.inertias, first, other, strict=True)
                )
                for other in partial
            ]
            for first in partial
        ]

    def acceleration(self, gamma, gamma_dot, torque, moment=None):
        """gamma_ddot from d/dt dT/dgamma_dot - dT/dgamma = torque + moment . domega/dgamma_dot."""
        g, rate, force = ([mpf(float(x)) for x in a] for a in (gamma, gamma_dot, torque))
        slopes = []
        for k in range(3):
            step = [OUTER * (j == k) for j in range(3)]
            after, before = self.inertia_matrix(add(g, step)), self.inertia_matrix(add(g, step, -1))
            slopes.append(
                [
                    [(y - x) / (2 * OUTER) for x, y in zip(*rows, strict=True)]
                    for rows in zip(before, after, strict=True)
                ]
            )
        for i in range(3):
            force[i] -= sum(rate[k] * dot(slopes[k][i], rate) for k in range(3))
            force[i] += dot(rate, times(slopes[i], rate)) / 2
            if moment is not None:
                direction = [mpf(i == j) for j in range(3)]
                omega = times(self.rotation(g), self.spins(g, direction)[0])
                force[i] += dot([mpf(float(x)) for x in moment], omega)
        return solve(self.inertia_matrix(g), force)

    def motion(self, gamma, gamma_dot, gamma_ddot):
        """Return gamma(t) with these values at t = 0."""
        g, rate, second = ([mpf(x) for x in a] for a in (gamma, gamma_dot, gamma_ddot))
        return lambda t: [
            a + b * t + c * t * t / 2 for a, b, c in zip(g, rate, second, strict=True)
        ]

    def passive(self, gamma):
        """mu_k and beta_k as plain angles between w and t, and between s and r."""
        star = self.rotation(gamma)
        s = [row[2] for row in star]
        mu = [mp.acos(dot(w, times(star, e))) for w, e in zip(self.w, self.e, strict=True)]
        return mu, [mp.acos(dot(s, r)) for r in self.carriages(gamma)]

    def star_rate(self, path, t):
        """Angular velocity of the star in {B} along gamma = path(t)."""
        before, middle, after = (self.rotation(path(x)) for x in (t - INNER, t, t + INNER))
        return spin(before, after, middle, INNER)
