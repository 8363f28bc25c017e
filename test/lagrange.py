# SPDX-License-Identifier: Apache-2.0
"""An independent truth to 80 digits: loop closure, differences and Lagrange's equations
alone.

No formula of the paper is used. Positions solve r_k . R e_k = 0 by Newton's method, the
frames of all seven links are built by geometry, every rate, acceleration and slope is a
central difference, and loads come from heights, stretches and rates. Arrays hold mpmath
numbers; rows belong to legs.
"""

from __future__ import annotations

import numpy as np
from mpmath import mp, mpf
from numpy import cross

DIGITS = 80
STEP = mpf(10) ** -13
"""Step of all differences: their truncation is 1e-26, three of them lose 39 of the 80
digits.
"""

EYE = np.eye(3, dtype=object)
exact = np.frompyfunc(mpf, 1, 1)


def unit(a):
    return a / mp.sqrt(a @ a)


def turn(vector):
    """Rotation by a rotation vector (Rodrigues)."""
    angle = mp.sqrt(vector @ vector)
    if angle == 0:
        return EYE
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return EYE + k * mp.sin(angle) + (k @ k) * (1 - mp.cos(angle))


def solve(matrix, right):
    """Cramer's rule for three equations."""
    a, b, c = matrix
    bc = cross(b, c)
    return np.stack([bc, cross(c, a), cross(a, b)], axis=1) @ right / (a @ bc)


def slope(function, t=0):
    """Central difference of a number or an array."""
    return (function(t + STEP) - function(t - STEP)) / (2 * STEP)


def partials(function, at):
    """Differences by each of three numbers, which come first."""
    return np.array([slope(lambda x, d=d: function(at + x * d)) for d in EYE])


class Positions:
    """Vectors, frames (star, {11} {12} {13}, {21} {22} {23}) and joint angles at one
    gamma.
    """

    def __init__(self, truth, gamma):
        self.r = truth.carriages(gamma)
        self.rotation = truth.orientation(self.r)
        self.s, self.t = self.rotation[:, 2], truth.e @ self.rotation.T
        legs = list(zip(truth.w, self.r, self.t, strict=True))
        first = [np.stack([r, cross(w, r), w], axis=1) for w, r, _ in legs]
        second = [np.stack([r, cross(t, r), t], axis=1) for _, r, t in legs]
        self.frames = np.array([self.rotation, *first, *second])
        # mu turns w into t about -r, beta turns s into r about t.
        mu = [mp.atan2(-cross(w, t) @ r, w @ t) for w, r, t in legs]
        beta = [mp.atan2(r @ cross(t, self.s), r @ self.s) for _, r, t in legs]
        self.angles = np.array([gamma, mu, beta])

    def own(self, vectors):
        """Seven vectors in {B} as the seven frames see them."""
        return np.array(
            [frame.T @ x for frame, x in zip(self.frames, vectors, strict=True)]
        )


class Lagrange:
    """The manipulator of a scene near the assembly `rotation` (3 x 3 floats)."""

    def __init__(self, scene, rotation):
        mp.dps = DIGITS
        self.scene = scene
        self.v = np.array([unit(row) for row in exact(np.array(scene.base.v))])
        self.w = np.array(
            [unit(cross(self.v[k], self.v[(k + 1) % 3])) for k in range(3)]
        )
        alpha = exact(np.array(scene.star.alpha_deg)) * mp.pi / 180
        self.e = np.array(
            [
                [-mp.sin(x), mp.cos(x), mpf(0)]
                for x in (mpf(0), alpha[0], alpha[0] + alpha[1])
            ]
        )
        links = [scene.star, *scene.actuated_links, *scene.intermediate_links]
        self.inertias = [exact(link.inertia.matrix) for link in links]
        self.weights = [exact(np.array(link.centre)) * link.mass for link in links]
        if carried := scene.payload:
            c = exact(np.array(carried.centre))
            self.weights[0] = self.weights[0] + c * carried.mass
            shifted = (EYE * (c @ c) - np.outer(c, c)) * carried.mass
            self.inertias[0] = (
                self.inertias[0] + exact(carried.inertia.matrix) + shifted
            )
        if drive := scene.actuators:
            for actuated in self.inertias[1:4]:
                actuated[2, 2] += mpf(drive.rotor_inertia) * mpf(drive.gear_ratio) ** 2
        t, s = exact(np.asarray(rotation)).T[1:]
        t = unit(t)
        s = unit(s - t * (s @ t))
        self._near = np.stack([cross(t, s), t, s], axis=1)
        self._known = {}

    def carriages(self, gamma):
        return np.array(
            [turn(w * g) @ v for w, g, v in zip(self.w, gamma, self.v, strict=True)]
        )

    def orientation(self, r):
        """R by Newton's method on r_k . R e_k = 0; the residual ends below 1e-77."""
        rotation = self._near
        for _ in range(12):
            t = self.e @ rotation.T
            gaps = (r * t).sum(axis=1)
            if max(abs(gaps)) < mpf(10) ** (3 - DIGITS):
                self._near = rotation
                return rotation
            rows = np.array([cross(*pair) for pair in zip(t, r, strict=True)])
            rotation = turn(solve(rows, -gaps)) @ rotation
        raise ArithmeticError("loop closure did not converge")

    def at(self, gamma):
        key = tuple(gamma)
        if key not in self._known:
            self._known[key] = Positions(self, gamma)
        return self._known[key]

    def spins(self, path, t=0):
        """All frames' angular velocities in {B} along gamma = path(t), (7, 3)."""
        rate = slope(lambda x: self.at(path(x)).frames, t)
        w = rate @ self.at(path(t)).frames.transpose(0, 2, 1)
        return np.stack([w[:, 2, 1], w[:, 0, 2], w[:, 1, 0]], axis=1)

    def lever(self, gamma):
        """Angular velocity of the star per actuator rate, columns by actuator."""
        return np.stack(
            [self.spins(lambda x, d=d: gamma + x * d)[0] for d in EYE], axis=1
        )

    def inertia_matrix(self, gamma):
        """Second derivatives of the kinetic energy by the rates.

        It is a quadratic form of them.
        """
        lines = [lambda x, d=d: gamma + x * d for d in EYE]
        spins = np.array([self.at(gamma).own(self.spins(line)) for line in lines])
        return sum(spins[:, i] @ m @ spins[:, i].T for i, m in enumerate(self.inertias))

    def resistance(self, gamma, rate, moment):
        """d/dt dT/dgamma_dot - dT/dgamma at gamma_ddot = 0, less the external moment's
        part.
        """
        slopes = partials(self.inertia_matrix, gamma)
        turning = np.tensordot(rate, slopes, 1) @ rate
        return turning - (slopes @ rate) @ rate / 2 - self.lever(gamma).T @ moment

    def acceleration(self, gamma, rate, torque, moment=(0.0, 0.0, 0.0)):
        """gamma_ddot of torques and of a moment on the star in {B}."""
        gamma, rate, torque, moment = map(
            exact, map(np.asarray, (gamma, rate, torque, moment))
        )
        return solve(
            self.inertia_matrix(gamma), torque - self.resistance(gamma, rate, moment)
        )

    def potential(self, gamma):
        """Weight by height of the centres of mass, springs by stretch."""
        here, field = self.at(gamma), exact(np.array(self.scene.gravity.acceleration))
        pairs = zip(here.frames, self.weights, strict=True)
        total = -sum(field @ frame @ weight for frame, weight in pairs)
        for spring in self.scene.springs:
            kind, leg = spring.joint.split("_")
            angle = here.angles[("gamma", "mu", "beta").index(kind), int(leg) - 1]
            total += mpf(spring.stiffness) * (angle - mpf(spring.rest)) ** 2 / 2
        return total

    def loads(self, gamma, rate):
        """Generalized forces of weight, springs and friction at the actuators [N m]."""
        gamma, rate = exact(gamma), exact(rate)
        force = -partials(self.potential, gamma)
        by_joint = partials(lambda x: self.at(x).angles, gamma)  # (actuator, kind, leg)
        for kind, name in enumerate(("gamma", "mu", "beta")):
            if friction := getattr(self.scene.friction, name):
                rub = np.array(
                    [friction_torque(friction, v) for v in rate @ by_joint[:, kind]]
                )
                force = force - by_joint[:, kind] @ rub
        return force.astype(float)


def friction_torque(friction, v):
    """Viscous, Coulomb and Stribeck torque, as terms.Friction documents them."""
    level = mpf(friction.coulomb)
    if friction.static:
        fading = mp.exp(-((v / mpf(friction.stribeck)) ** 2))
        level += (mpf(friction.static) - mpf(friction.coulomb)) * fading
    return mpf(friction.viscous) * v + level * mp.tanh(v / mpf(friction.smoothing))


class Motion:
    """gamma(t) = gamma + rate t + acceleration t^2 / 2, and what differences say of it
    at t = 0.

    Attributes:
        here: positions.
        rates, accelerations: of the joints gamma, mu, beta by leg, shape (3, 3).
        omega, omega_dot: of the star and all links, in {B}, shape (7, 3).
    """

    def __init__(self, truth, gamma, rate, acceleration):
        gamma, rate, acceleration = map(exact, (gamma, rate, acceleration))

        def path(t):
            return gamma + rate * t + acceleration * (t * t / 2)

        self.truth, self.path, self.gamma = truth, path, gamma
        self.here = truth.at(gamma)
        self.rates = self.slope(lambda here: here.angles)
        self.accelerations = slope(
            lambda t: slope(lambda x: truth.at(path(x)).angles, t)
        )
        self.omega = truth.spins(path)
        self.omega_dot = slope(lambda t: truth.spins(path, t))

    def slope(self, function):
        """Rate of a function of the positions."""
        return slope(lambda t: function(self.truth.at(self.path(t))))

    def momentum_rates(self):
        """d/dt (I omega) of the star and all links, in {B}, shape (7, 3)."""

        def momenta(t):
            here, omega = self.truth.at(self.path(t)), self.truth.spins(self.path, t)
            rows = zip(here.frames, self.truth.inertias, omega, strict=True)
            return np.array([f @ m @ f.T @ w for f, m, w in rows])

        return slope(momenta)
