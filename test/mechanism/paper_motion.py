# SPDX-License-Identifier: Apache-2.0
"""A motion of the mechanism to 80 digits, from its loop closure and differences alone.

No formula of the paper is used: positions solve r_k . R e_k = 0 by Newton's method, every rate and
acceleration is a central difference of positions, and the actuator torque is Lagrange's.
"""

from functools import cached_property

import mpmath as mp

DIGITS = 80
STEP = mp.mpf(10) ** -13
"""Step of all differences: their truncation is 1e-26, three of them lose 39 of the 80 digits."""


def cross(a, b):
    return mp.matrix(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def dot(a, b):
    return mp.fsum(x * y for x, y in zip(a, b, strict=True))


def unit(a):
    return a / mp.sqrt(dot(a, a))


def columns(*vectors):
    return mp.matrix([[vector[row] for vector in vectors] for row in range(3)])


def turn(axis, angle):
    """Rotation about a unit axis (Rodrigues)."""
    k = mp.matrix([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return mp.eye(3) + mp.sin(angle) * k + (1 - mp.cos(angle)) * (k * k)


def spin(frame, rate):
    """Angular velocity of a rotating frame from its matrix and the derivative of that."""
    w = rate * frame.T
    return mp.matrix([w[2, 1], w[0, 2], w[1, 0]])


def slope(function, t):
    """Central difference; what is differentiated may be a number, a vector or a matrix."""
    return (function(t + STEP) - function(t - STEP)) / (2 * STEP)


class PaperMotion:
    """Positions along gamma(t) = centre + swing sin(rate t + phase), and differences of them.

    Args:
        v: corners of the base triangle, three vectors of three.
        alpha: angles of the star [rad].
        rotation: an approximate R at t = 0, to start Newton's method from.
        inertias: star in {E}, actuated links in {1k}, intermediate links in {2k} [kg m^2].
        moment: external moment on the star in {B} [N m], constant.

    """

    def __init__(self, v, alpha, gamma, rotation, inertias, moment):
        self.v = [unit(mp.matrix(one)) for one in v]
        self.w = [unit(cross(self.v[k], self.v[(k + 1) % 3])) for k in range(3)]
        angles = [mp.mpf(0), alpha[0], alpha[0] + alpha[1]]
        self.e = [mp.matrix([-mp.sin(x), mp.cos(x), 0]) for x in angles]
        self.centre, self.swing, self.rate, self.phase = gamma
        star, actuated, intermediate = inertias
        self.star = mp.matrix(star)
        self.actuated = [mp.matrix(one) for one in actuated]
        self.intermediate = [mp.matrix(one) for one in intermediate]
        self.moment = mp.matrix(moment)
        self._near = mp.matrix(rotation)
        self._near = self.orientation(self.gamma(0))

    def gamma(self, t):
        terms = zip(self.centre, self.swing, self.rate, self.phase, strict=True)
        return mp.matrix([c + s * mp.sin(w * t + p) for c, s, w, p in terms])

    def carriage(self, gamma, k):
        return turn(self.w[k], gamma[k]) * self.v[k]

    def orientation(self, gamma):
        """R by Newton's method on r_k . R e_k = 0; the residual ends below 1e-78."""
        rotation = self._near.copy()
        r = [self.carriage(gamma, k) for k in range(3)]
        for _ in range(12):
            t = [rotation * self.e[k] for k in range(3)]
            gaps = mp.matrix([dot(r[k], t[k]) for k in range(3)])
            if mp.norm(gaps) < mp.mpf(10) ** (3 - DIGITS):
                return rotation
            normals = [cross(t[k], r[k]) for k in range(3)]
            step = mp.lu_solve(columns(*normals).T, -gaps)
            angle = mp.norm(step)
            rotation = turn(step / angle, angle) * rotation
        raise AssertionError("Newton's method does not converge")

    def at(self, gamma):
        return Positions(self, gamma)

    def along(self, t):
        return self.at(self.gamma(t))

    def kinetic_energy(self, gamma, rate):
        """T [J] from differences of all seven frames along the rate."""

        def frames(x):
            return self.at(gamma + x * rate)

        here, ahead, behind = frames(0), frames(STEP), frames(-STEP)

        def energy(frame, inertia):
            d = (frame(ahead) - frame(behind)) / (2 * STEP)
            omega = frame(here).T * spin(frame(here), d)
            return dot(omega, inertia * omega) / 2

        total = energy(lambda p: p.rotation, self.star)
        for k in range(3):
            total += energy(lambda p, k=k: p.first[k], self.actuated[k])
            total += energy(lambda p, k=k: p.second[k], self.intermediate[k])
        return total

    def torque(self, t):
        """Lagrange: d/dt dT/dgamma_dot - dT/dgamma less the generalised external moment [N m]."""

        def partial(gamma, rate, k, *, of_rate):
            unit_k = mp.matrix([int(i == k) for i in range(3)]) * STEP
            more = (0 * unit_k, unit_k) if of_rate else (unit_k, 0 * unit_k)
            plus = self.kinetic_energy(gamma + more[0], rate + more[1])
            minus = self.kinetic_energy(gamma - more[0], rate - more[1])
            return (plus - minus) / (2 * STEP)

        def momentum(x):
            gamma, rate = self.gamma(x), slope(self.gamma, x)
            return mp.matrix([partial(gamma, rate, k, of_rate=True) for k in range(3)])

        gamma, rate = self.gamma(t), slope(self.gamma, t)
        force = mp.matrix([partial(gamma, rate, k, of_rate=False) for k in range(3)])
        return slope(momentum, t) - force - self.lever(gamma).T * self.moment

    def lever(self, gamma):
        """Angular velocity of the star per actuator rate, by differences, columns by actuator."""
        here = self.at(gamma).rotation
        found = []
        for k in range(3):
            step = mp.matrix([int(i == k) for i in range(3)]) * STEP
            ahead, behind = self.at(gamma + step), self.at(gamma - step)
            found.append(spin(here, (ahead.rotation - behind.rotation) / (2 * STEP)))
        return columns(*found)


class Positions:
    """All vectors, frames and passive angles at one gamma."""

    def __init__(self, motion, gamma):
        self.gamma, self._motion = gamma, motion
        self.rotation = motion.orientation(gamma)
        self.s = self.rotation[:, 2]
        self.r = [motion.carriage(gamma, k) for k in range(3)]
        self.t = [self.rotation * motion.e[k] for k in range(3)]

    @cached_property
    def first(self):
        """Frames {1k}: x along r, z along w."""
        w = self._motion.w
        return [columns(self.r[k], cross(w[k], self.r[k]), w[k]) for k in range(3)]

    @cached_property
    def second(self):
        """Frames {2k}: x along r, z along t."""
        return [columns(self.r[k], cross(self.t[k], self.r[k]), self.t[k]) for k in range(3)]

    @cached_property
    def mu(self):
        """Angle from w to t, which turns about -r."""
        w = self._motion.w
        return mp.matrix(
            [
                mp.atan2(-dot(cross(w[k], self.t[k]), self.r[k]), dot(w[k], self.t[k]))
                for k in range(3)
            ]
        )

    @cached_property
    def beta(self):
        """Angle from s to r about t."""
        return mp.matrix(
            [
                mp.atan2(dot(self.r[k], cross(self.t[k], self.s)), dot(self.r[k], self.s))
                for k in range(3)
            ]
        )
