# SPDX-License-Identifier: Apache-2.0
"""All 92 equations of the paper with the signs that hold, against differences to 80 digits.

The left side of each check is the equation as `docs/paper.md` prints it; the right side comes from
`paper_motion`, which knows the loop closure, differences and Lagrange's equations, but no formula of
the paper. Two mechanisms: the isotropic one and a general one, both with full inertia matrices.
"""

import mpmath as mp
import numpy as np
import pytest
from mechanism.paper_motion import (
    DIGITS,
    STEP,
    PaperMotion,
    columns,
    cross,
    dot,
    slope,
    spin,
    turn,
    unit,
)

LEGS = range(3)
BOUND = mp.mpf(10) ** -20
"""Differences of second order with a step of 1e-13 leave errors of about 1e-25 times a derivative."""


def _inertia(seed):
    """A full inertia matrix that a rigid body can have."""
    points = np.random.default_rng(seed).normal(size=(12, 3))
    total = sum(np.dot(p, p) * np.eye(3) - np.outer(p, p) for p in points) / 40
    return mp.matrix(total.tolist())


def _motions():
    with mp.workdps(DIGITS):
        third = 2 * mp.pi / 3
        isotropic = ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [third, third, third])
        general = (
            [[1, 0.1, -0.05], [0.2, 1, 0.1], [0.1, -0.1, 1]],
            [mp.mpf(110) * mp.pi / 180, mp.mpf(120) * mp.pi / 180, mp.mpf(130) * mp.pi / 180],
        )
        gamma = (
            [mp.mpf("0.8"), mp.mpf("0.75"), mp.mpf("0.7")],
            [mp.mpf("0.11"), mp.mpf("0.13"), mp.mpf("-0.09")],
            [3, 2, 4],
            [mp.mpf("0.3"), 1, mp.mpf("-0.4")],
        )
        s = unit(mp.matrix([1, 1, 1]))
        bodies = (_inertia(1), [_inertia(2 + k) for k in LEGS], [_inertia(5 + k) for k in LEGS])
        for v, alpha in (isotropic, general):
            w = unit(cross(mp.matrix(v[0]), mp.matrix(v[1])))
            first = unit(cross(s, turn(w, gamma[0][0]) * unit(mp.matrix(v[0]))))
            near = columns(cross(first, s), first, s)
            moment = [mp.mpf("0.3"), mp.mpf("-0.2"), mp.mpf("0.5")]
            yield PaperMotion(v, alpha, gamma, near, bodies, moment)


class Paper:
    """What the equations name, at t = 0.2 s: measured by differences, or as the paper defines it."""

    def __init__(self, motion):
        self.motion, time = motion, mp.mpf("0.2")
        self.time = time
        here = self.here = motion.along(time)
        self.v, self.w, self.e = motion.v, motion.w, motion.e
        self.r, self.t, self.s, self.R = here.r, here.t, here.s, here.rotation
        # measured
        self.gd, self.gdd = self._twice(motion.gamma)
        self.mud, self.mudd = self._twice(lambda x: motion.along(x).mu)
        self.betad, self.betadd = self._twice(lambda x: motion.along(x).beta)
        self.omega = self._omega(time, lambda p: p.rotation)
        self.omegad = slope(lambda x: self._omega(x, lambda p: p.rotation), time)
        self.rd = [slope(lambda x, k=k: motion.along(x).r[k], time) for k in LEGS]
        self.td = [slope(lambda x, k=k: motion.along(x).t[k], time) for k in LEGS]
        # defined, Eqs. 11 to 49
        self.N = [cross(self.r[k], self.t[k]) for k in LEGS]
        self.c = [dot(self.N[k], self.w[k]) for k in LEGS]
        self.J1 = mp.diag(self.c)
        self.J2 = -columns(*self.N).T
        self.J = -mp.inverse(self.J2) * self.J1
        self.d = [mp.matrix([int(i == k) for i in LEGS]) for k in LEGS]
        self.a = [-self.J.T * self.r[k] for k in LEGS]
        wr = self.wr = [cross(self.w[k], self.r[k]) for k in LEGS]
        self.b = [-self.J.T * wr[k] / dot(wr[k], self.t[k]) for k in LEGS]
        self.tw = [dot(self.t[k], self.w[k]) for k in LEGS]
        omega = self.J * self.gd
        self.m = [dot(self.a[k], self.gd) * self.tw[k] for k in LEGS]
        self.n = mp.matrix([-dot(self.b[k], self.gd) * dot(self.r[k], omega) for k in LEGS])
        self.M = mp.diag(self.m)
        self.x = mp.inverse(self.J2) * (self.M * self.gd + self.n)
        self.f = [
            -dot(self.b[k], self.gd) * dot(cross(self.t[k], self.r[k]), omega)
            + dot(self.r[k], self.x)
            for k in LEGS
        ]
        self.u_vector = [self.tw[k] * self.d[k] - self.J.T * self.t[k] for k in LEGS]
        self.u = [
            dot(self.t[k], self.x - wr[k] * dot(self.d[k], self.gd) * dot(self.a[k], self.gd))
            for k in LEGS
        ]
        # frames and link Jacobians, Eqs. 50 to 62
        self.B0 = [columns(self.v[k], cross(self.w[k], self.v[k]), self.w[k]) for k in LEGS]
        z, x = mp.matrix([0, 0, 1]), mp.matrix([1, 0, 0])
        self.R01 = [turn(z, here.gamma[k]) for k in LEGS]
        self.R12 = [turn(x, -here.mu[k]) for k in LEGS]
        self.first, self.second = here.first, here.second
        self.w1 = [self.R01[k].T * self.B0[k].T * self.w[k] for k in LEGS]
        self.r2 = [self.second[k].T * self.r[k] for k in LEGS]
        self.R21 = [self.R12[k].T for k in LEGS]
        self.Ja = [self.w1[k] * self.d[k].T for k in LEGS]
        self.R2B = [self.R12[k].T * self.R01[k].T * self.B0[k].T for k in LEGS]
        self.Jp = [self.R2B[k] * (self.w[k] * self.d[k].T - self.r[k] * self.a[k].T) for k in LEGS]
        # moments, Eqs. 63 to 82
        self.Is = self.R * motion.star * self.R.T
        Is, J = self.Is, self.J
        self.Q = -Is * J
        self.q = Is * self.x - cross(omega, Is * omega) + motion.moment
        self.E = [self.w1[k] * self.d[k].T for k in LEGS]
        Ia, Ip = motion.actuated, motion.intermediate
        self.L = [-Ia[k] * self.E[k] for k in LEGS]
        ja = [self.Ja[k] * self.gd for k in LEGS]
        jp = [self.Jp[k] * self.gd for k in LEGS]
        self.ell = [-cross(ja[k], Ia[k] * ja[k]) for k in LEGS]
        self.P = [self.R21[k] * self.E[k] + self.r2[k] * (J.T * self.r[k]).T for k in LEGS]
        self.p = [
            -cross(self.R21[k] * ja[k], self.r2[k] * dot(self.a[k], self.gd))
            - self.f[k] * self.r2[k]
            for k in LEGS
        ]
        self.K = [-Ip[k] * self.P[k] for k in LEGS]
        self.kk = [-Ip[k] * self.p[k] - cross(jp[k], Ip[k] * jp[k]) for k in LEGS]
        # measured moments: n = n_ext - d/dt (I omega), in the body's own frame for links
        self.ne = motion.moment - slope(self._momentum(lambda p: p.rotation, motion.star), time)
        self.na = [
            -self.first[k].T * slope(self._momentum(lambda p, k=k: p.first[k], Ia[k]), time)
            for k in LEGS
        ]
        self.np = [
            -self.second[k].T * slope(self._momentum(lambda p, k=k: p.second[k], Ip[k]), time)
            for k in LEGS
        ]
        self.wa = [self.first[k].T * self._omega(time, lambda p, k=k: p.first[k]) for k in LEGS]
        self.wp = [self.second[k].T * self._omega(time, lambda p, k=k: p.second[k]) for k in LEGS]
        self.wad = [
            self.first[k].T * slope(lambda x, k=k: self._omega(x, lambda p: p.first[k]), time)
            for k in LEGS
        ]
        self.wpd = [
            self.second[k].T * slope(lambda x, k=k: self._omega(x, lambda p: p.second[k]), time)
            for k in LEGS
        ]
        self.tau = motion.torque(time)
        self.T1 = J.T * self.Q
        self.T2 = J.T * self.q
        for k in LEGS:
            self.T1 += self.Ja[k].T * self.L[k] + self.Jp[k].T * self.K[k]
            self.T2 += self.Ja[k].T * self.ell[k] + self.Jp[k].T * self.kk[k]
        self.virtual = mp.matrix([mp.mpf("0.7"), mp.mpf("-0.4"), mp.mpf("0.2")])

    def _twice(self, function):
        return slope(function, self.time), slope(lambda x: slope(function, x), self.time)

    def _omega(self, t, frame):
        rate = slope(lambda x: frame(self.motion.along(x)), t)
        return spin(frame(self.motion.along(t)), rate)

    def _momentum(self, frame, inertia):
        def momentum(t):
            turned = frame(self.motion.along(t))
            return turned * inertia * turned.T * self._omega(t, frame)

        return momentum

    def gap(self, gamma, rotation):
        """Loop closure r_k . R e_k of any gamma and R."""
        r = [self.motion.carriage(gamma, k) for k in LEGS]
        return mp.matrix([dot(r[k], rotation * self.e[k]) for k in LEGS])

    def zyz(self):
        R = self.R
        return mp.atan2(R[1, 2], R[0, 2]), mp.acos(R[2, 2]), mp.atan2(R[2, 1], -R[2, 0])


def legs(function):
    """Stack one residual of each leg."""
    return lambda p: [function(p, k) for k in LEGS]


def _virtual_power(p):
    """Virtual work of Eq. 83 with the virtual rotations of Eqs. 84 to 86."""
    links = mp.fsum(
        dot(p.Ja[k] * p.virtual, p.na[k]) + dot(p.Jp[k] * p.virtual, p.np[k]) for k in LEGS
    )
    return dot(p.virtual, p.tau) + dot(p.J * p.virtual, p.ne) + links


def _balance(p, ne, na, np_):
    total = p.tau + p.J.T * ne
    for k in LEGS:
        total += p.Ja[k].T * na[k] + p.Jp[k].T * np_[k]
    return total


def _partial(p, *, of_gamma):
    """Difference of the loop closure by each actuator, or by a rotation about each axis of {B}."""
    found = []
    for k in LEGS:
        step = p.d[k] * STEP
        if of_gamma:
            ahead, behind = p.gap(p.here.gamma + step, p.R), p.gap(p.here.gamma - step, p.R)
        else:
            ahead = p.gap(p.here.gamma, turn(p.d[k], STEP) * p.R)
            behind = p.gap(p.here.gamma, turn(p.d[k], -STEP) * p.R)
        found.append((ahead - behind) / (2 * STEP))
    return columns(*found)


def _virtual_rotation(p, frame, *, own):
    """Rotation of a frame per small motion `virtual` of the actuators, by differences."""
    here, motion = p.here, p.motion
    ahead = frame(motion.at(here.gamma + STEP * p.virtual))
    behind = frame(motion.at(here.gamma - STEP * p.virtual))
    turned = spin(frame(here), (ahead - behind) / (2 * STEP))
    return frame(here).T * turned if own else turned


Z, Y = mp.matrix([0, 0, 1]), mp.matrix([0, 1, 0])

RESIDUALS = {
    1: legs(lambda p, k: unit(cross(p.v[k], p.r[k])) - unit(cross(p.v[k], p.v[(k + 1) % 3]))),
    2: legs(lambda p, k: p.t[k] - unit(cross(p.s, p.r[k]))),
    3: lambda p: [p.R - turn(Z, p.zyz()[0]) * turn(Y, p.zyz()[1]) * turn(Z, p.zyz()[2])],
    4: legs(lambda p, k: min(dot(p.w[k], p.s), mp.mpf(0))),
    5: lambda p: [p.R - columns(cross(p.t[0], p.s), p.t[0], p.s)],
    6: lambda p: [mp.cos(p.zyz()[1]) - dot(p.s, Z)],
    7: lambda p: [mp.sin(p.zyz()[1]) * mp.expj(p.zyz()[0]) - mp.mpc(p.s[0], p.s[1])],
    8: lambda p: [mp.sin(p.zyz()[1]) * mp.expj(p.zyz()[2]) - mp.mpc(-p.R[2, 0], p.R[2, 1])],
    9: lambda p: [p.J1 * p.gd + p.J2 * p.omega],
    10: legs(lambda p, k: p.w[k] * p.gd[k] - p.r[k] * p.mud[k] - p.t[k] * p.betad[k] - p.omega),
    11: legs(lambda p, k: dot(p.N[k], p.w[k]) * p.gd[k] - dot(p.N[k], p.omega)),
    12: lambda p: [p.J1 - _partial(p, of_gamma=True)],
    13: lambda p: [p.J2 - _partial(p, of_gamma=False)],
    14: legs(lambda p, k: p.c[k] - mp.sin(p.here.mu[k])),
    15: lambda p: [p.J - p.motion.lever(p.here.gamma), p.J * p.gd - p.omega],
    16: legs(lambda p, k: dot(p.d[k], p.gd) - p.gd[k]),
    17: lambda p: [columns(*p.d) - mp.eye(3)],
    18: legs(lambda p, k: p.mud[k] + dot(p.r[k], p.omega)),
    19: legs(lambda p, k: p.mud[k] - dot(p.a[k], p.gd)),
    20: legs(lambda p, k: p.a[k] + p.motion.lever(p.here.gamma).T * p.r[k]),
    21: legs(lambda p, k: p.betad[k] + dot(p.wr[k], p.omega) / dot(p.wr[k], p.t[k])),
    22: legs(lambda p, k: p.betad[k] - dot(p.b[k], p.gd)),
    23: legs(lambda p, k: p.b[k] * dot(p.wr[k], p.t[k]) + p.motion.lever(p.here.gamma).T * p.wr[k]),
    24: legs(
        lambda p, k: (
            p.w[k] * p.gdd[k]
            - p.r[k] * p.mudd[k]
            - p.rd[k] * p.mud[k]
            - p.t[k] * p.betadd[k]
            - p.td[k] * p.betad[k]
            - p.omegad
        )
    ),
    25: legs(lambda p, k: slope(lambda x: p.motion.along(x).first[k][:, 2], p.time)),
    26: legs(lambda p, k: p.rd[k] - p.gd[k] * p.wr[k]),
    27: legs(lambda p, k: p.td[k] - cross(p.omega, p.t[k])),
    28: legs(
        lambda p, k: (
            p.w[k] * p.gdd[k]
            - p.r[k] * p.mudd[k]
            - p.gd[k] * p.mud[k] * p.wr[k]
            - p.t[k] * p.betadd[k]
            - p.betad[k] * cross(p.omega, p.t[k])
            - p.omegad
        )
    ),
    29: legs(
        lambda p, k: dot(
            p.N[k],
            p.w[k] * p.gdd[k]
            - p.omegad
            - p.gd[k] * p.mud[k] * p.wr[k]
            - p.betad[k] * cross(p.omega, p.t[k]),
        )
    ),
    30: legs(
        lambda p, k: dot(
            p.N[k],
            p.w[k] * p.gdd[k]
            - p.omegad
            - p.gd[k] * dot(p.a[k], p.gd) * p.wr[k]
            - dot(p.b[k], p.gd) * cross(p.omega, p.t[k]),
        )
    ),
    31: legs(lambda p, k: dot(p.N[k], p.td[k]) - dot(p.r[k], p.omega)),
    32: legs(lambda p, k: dot(p.N[k], p.rd[k]) + p.gd[k] * dot(p.t[k], p.w[k])),
    33: legs(
        lambda p, k: (
            p.c[k] * p.gdd[k]
            - dot(p.N[k], p.omegad)
            + p.gd[k] * dot(p.a[k], p.gd) * p.tw[k]
            - dot(p.b[k], p.gd) * dot(p.r[k], p.omega)
        )
    ),
    34: legs(
        lambda p, k: (
            p.c[k] * p.gdd[k]
            - dot(p.N[k], p.omegad)
            + p.gd[k] * dot(p.a[k], p.gd) * p.tw[k]
            - dot(p.b[k], p.gd) * dot(p.r[k], p.J * p.gd)
        )
    ),
    35: lambda p: [p.J1 * p.gdd + p.J2 * p.omegad + p.M * p.gd + p.n],
    36: lambda p: [p.M - mp.diag([p.mud[k] * p.tw[k] for k in LEGS])],
    37: lambda p: [p.n + mp.matrix([p.betad[k] * dot(p.r[k], p.omega) for k in LEGS])],
    38: legs(lambda p, k: p.m[k] - p.mud[k] * mp.cos(p.here.mu[k])),
    39: legs(lambda p, k: p.n[k] - p.betad[k] * p.mud[k]),
    40: lambda p: [p.omegad - p.J * p.gdd + p.x],
    41: legs(lambda p, k: dot(p.d[k], p.gdd) - p.gdd[k]),
    42: legs(
        lambda p, k: (
            p.mudd[k] + p.betad[k] * dot(p.r[k], cross(p.omega, p.t[k])) + dot(p.r[k], p.omegad)
        )
    ),
    43: legs(
        lambda p, k: (
            p.mudd[k] + p.betad[k] * dot(cross(p.t[k], p.r[k]), p.omega) + dot(p.r[k], p.omegad)
        )
    ),
    44: legs(lambda p, k: p.mudd[k] + dot(p.J.T * p.r[k], p.gdd) - p.f[k]),
    45: legs(lambda p, k: p.f[k] - p.mudd[k] - dot(p.motion.lever(p.here.gamma).T * p.r[k], p.gdd)),
    46: legs(
        lambda p, k: (
            p.betadd[k]
            - p.tw[k] * p.gdd[k]
            + p.gd[k] * p.mud[k] * dot(p.t[k], p.wr[k])
            + dot(p.t[k], p.omegad)
        )
    ),
    47: legs(lambda p, k: p.betadd[k] - dot(p.u_vector[k], p.gdd) - p.u[k]),
    48: legs(
        lambda p, k: p.u_vector[k] - p.tw[k] * p.d[k] + p.motion.lever(p.here.gamma).T * p.t[k]
    ),
    49: legs(
        lambda p, k: (
            p.u[k]
            - p.betadd[k]
            + p.tw[k] * p.gdd[k]
            - dot(p.motion.lever(p.here.gamma).T * p.t[k], p.gdd)
        )
    ),
    50: legs(lambda p, k: p.B0[k] * turn(Z, p.here.gamma[k]) - p.first[k]),
    51: legs(lambda p, k: p.B0[k] * p.R01[k] - p.first[k]),
    52: legs(lambda p, k: p.first[k] * p.R12[k] - p.second[k]),
    53: legs(lambda p, k: p.wa[k] - p.gd[k] * p.first[k].T * p.w[k]),
    54: legs(lambda p, k: p.wa[k] - p.w1[k] * dot(p.d[k], p.gd)),
    55: legs(lambda p, k: p.w1[k] - p.first[k].T * p.w[k]),
    56: legs(lambda p, k: p.wa[k] - p.Ja[k] * p.gd),
    57: legs(
        lambda p, k: p.Ja[k] * p.virtual - _virtual_rotation(p, lambda q: q.first[k], own=True)
    ),
    58: legs(lambda p, k: p.wp[k] - p.R21[k] * p.wa[k] + p.mud[k] * p.r2[k]),
    59: legs(lambda p, k: p.wp[k] - (p.R21[k] * p.Ja[k] - p.r2[k] * p.a[k].T) * p.gd),
    60: legs(lambda p, k: p.wp[k] - p.Jp[k] * p.gd),
    61: legs(
        lambda p, k: p.Jp[k] * p.virtual - _virtual_rotation(p, lambda q: q.second[k], own=True)
    ),
    62: legs(lambda p, k: p.R2B[k] - p.second[k].T),
    63: lambda p: [p.ne - p.motion.moment + p.Is * p.omegad + cross(p.omega, p.Is * p.omega)],
    64: lambda p: [
        dot(p.omega, p.Is * p.omega) - dot(p.R.T * p.omega, p.motion.star * (p.R.T * p.omega))
    ],
    65: lambda p: [p.ne - p.Q * p.gdd - p.q],
    66: lambda p: [p.Q + p.Is * p.motion.lever(p.here.gamma)],
    67: lambda p: [p.q - p.ne - p.Is * p.motion.lever(p.here.gamma) * p.gdd],
    68: legs(
        lambda p, k: (
            p.na[k]
            + p.motion.actuated[k] * p.wad[k]
            + cross(p.wa[k], p.motion.actuated[k] * p.wa[k])
        )
    ),
    69: legs(lambda p, k: p.wad[k] - p.gdd[k] * p.w1[k]),
    70: legs(lambda p, k: p.wad[k] - p.E[k] * p.gdd),
    71: legs(lambda p, k: p.E[k] - (p.first[k].T * p.w[k]) * p.d[k].T),
    72: legs(lambda p, k: p.na[k] - p.L[k] * p.gdd - p.ell[k]),
    73: legs(lambda p, k: p.L[k] * p.gdd + p.motion.actuated[k] * p.wad[k]),
    74: legs(lambda p, k: p.ell[k] + cross(p.wa[k], p.motion.actuated[k] * p.wa[k])),
    75: legs(
        lambda p, k: (
            p.np[k]
            + p.motion.intermediate[k] * p.wpd[k]
            + cross(p.wp[k], p.motion.intermediate[k] * p.wp[k])
        )
    ),
    76: legs(
        lambda p, k: (
            p.wpd[k]
            - p.R21[k] * p.wad[k]
            + cross(p.R21[k] * p.wa[k], p.mud[k] * p.r2[k])
            + p.mudd[k] * p.r2[k]
        )
    ),
    77: legs(lambda p, k: p.wpd[k] - p.P[k] * p.gdd - p.p[k]),
    78: legs(lambda p, k: p.P[k] - p.Jp[k]),
    79: legs(lambda p, k: p.p[k] - p.wpd[k] + p.Jp[k] * p.gdd),
    80: legs(lambda p, k: p.np[k] - p.K[k] * p.gdd - p.kk[k]),
    81: legs(lambda p, k: p.K[k] + p.motion.intermediate[k] * p.Jp[k]),
    82: legs(lambda p, k: p.kk[k] - p.np[k] - p.motion.intermediate[k] * (p.Jp[k] * p.gdd)),
    83: lambda p: [_virtual_power(p)],
    84: lambda p: [p.J * p.virtual - _virtual_rotation(p, lambda q: q.rotation, own=False)],
    85: legs(
        lambda p, k: p.Ja[k] * p.virtual - _virtual_rotation(p, lambda q: q.first[k], own=True)
    ),
    86: legs(
        lambda p, k: p.Jp[k] * p.virtual - _virtual_rotation(p, lambda q: q.second[k], own=True)
    ),
    87: lambda p: [dot(p.virtual, _balance(p, p.ne, p.na, p.np))],
    88: lambda p: [_balance(p, p.ne, p.na, p.np)],
    89: lambda p: [
        _balance(
            p,
            p.Q * p.gdd + p.q,
            [p.L[k] * p.gdd + p.ell[k] for k in LEGS],
            [p.K[k] * p.gdd + p.kk[k] for k in LEGS],
        )
    ],
    90: lambda p: [p.T1 * p.gdd + p.T2 + p.tau],
    91: lambda p: [
        dot(p.gd, p.T1 * p.gd) + 2 * p.motion.kinetic_energy(p.here.gamma, p.gd),
        p.T1 - p.T1.T,
    ],
    92: lambda p: [p.T2 + p.tau + p.T1 * p.gdd],
}


@pytest.fixture(scope="module", params=["isotropic", "general"])
def paper(request):
    with mp.workdps(DIGITS):
        first, second = _motions()
        yield Paper(first if request.param == "isotropic" else second)


def test_every_equation_of_the_paper_is_here():
    assert list(RESIDUALS) == list(range(1, 93))


@pytest.mark.parametrize("number", RESIDUALS, ids=str)
def test_equation(paper, number):
    with mp.workdps(DIGITS):
        for residual in RESIDUALS[number](paper):
            size = mp.norm(residual) if isinstance(residual, mp.matrix) else abs(residual)
            assert size < BOUND, f"Eq. {number}: {mp.nstr(size, 3)}"
