# SPDX-License-Identifier: Apache-2.0
"""Lagrange's equations with loads: potentials and friction from geometry alone, at 50 digits."""

from __future__ import annotations

from lagrange import INNER, Lagrange, add, dot, times
from mpmath import mp, mpf


class LoadedLagrange(Lagrange):
    """A scene with gravity, springs and friction; its links need not have an inertia."""

    def __init__(self, scene, rotation):
        super().__init__(scene, rotation)
        self.field = [mpf(x) for x in scene.gravity.acceleration]
        links = [scene.star, *scene.actuated_links, *scene.intermediate_links]
        self.weights = [[mpf(link.mass) * mpf(x) for x in link.centre] for link in links]
        self.springs, self.friction = scene.springs, scene.friction

    def angles(self, gamma):
        """All nine joint angles by name."""
        mu, beta = self.passive(gamma)
        kinds = {"gamma": gamma, "mu": mu, "beta": beta}
        return {f"{kind}_{k + 1}": x[k] for kind, x in kinds.items() for k in range(3)}

    def potential(self, gamma):
        """Weight by height of the centres of mass, springs by stretch."""
        frames, angles = self.frames(gamma), self.angles(gamma)
        pairs = zip(frames, self.weights, strict=True)
        total = -sum(dot(self.field, times(frame, weight)) for frame, weight in pairs)
        for spring in self.springs:
            stretch = angles[spring.joint] - mpf(spring.rest)
            total += mpf(spring.stiffness) * stretch * stretch / 2
        return total

    def difference(self, function, gamma, direction):
        """Slope of a function of gamma along a direction."""
        return (
            function(add(gamma, direction, INNER)) - function(add(gamma, direction, -INNER))
        ) / (2 * INNER)

    def loads(self, gamma, gamma_dot):
        """Generalized forces of all loads at the actuators [N m]."""
        g, rate = ([mpf(float(x)) for x in a] for a in (gamma, gamma_dot))
        units = [[mpf(i == j) for j in range(3)] for i in range(3)]
        force = [-self.difference(self.potential, g, direction) for direction in units]
        for joint in self.angles(g):
            friction = getattr(self.friction, joint.split("_")[0])
            if friction is not None:

                def angle(at, joint=joint):
                    return self.angles(at)[joint]

                torque = resistance(friction, self.difference(angle, g, rate))
                for i, direction in enumerate(units):
                    force[i] -= torque * self.difference(angle, g, direction)
        return [float(x) for x in force]


def resistance(friction, v):
    """Viscous, Coulomb and Stribeck torque, as terms.Friction documents them."""
    level = mpf(friction.coulomb)
    if friction.static:
        fading = mp.exp(-((v / mpf(friction.stribeck)) ** 2))
        level += (mpf(friction.static) - mpf(friction.coulomb)) * fading
    return mpf(friction.viscous) * v + level * mp.tanh(v / mpf(friction.smoothing))
