# SPDX-License-Identifier: Apache-2.0
"""All 92 equations of the paper with the signs that hold, against differences to 80
digits.

The left side of each check is the equation as `docs/paper.md` prints it; the right side
comes from `lagrange`, which knows the loop closure, differences and Lagrange's
equations, but no formula of the paper. Two mechanisms: an isotropic one and a general
one, both with full inertia matrices.
"""

import numpy as np
import pytest
from lagrange import EYE, Lagrange, Motion, cross, exact, partials, solve, turn, unit
from models import seeded_samples
from mpmath import mp

LEGS = range(3)
BOUND = mp.mpf(10) ** -20
"""Differences of second order with a step of 1e-13 leave errors of about 1e-25 times a
derivative.
"""
X, Y, Z = EYE


class Leg:
    """What the equations name for leg k: its row of what they name for all legs."""

    def __init__(self, paper, k):
        self._paper, self._k = paper, k

    def __getattr__(self, name):
        return getattr(self._paper, name)[self._k]


class Paper:
    """What the equations name: measured by differences, or as the paper defines it."""

    def __init__(self, sample, gamma_ddot=(1.3, -2.1, 0.7), virtual=(0.7, -0.4, 0.2)):
        truth = self.truth = Lagrange(sample.scene, sample.rotation)
        self.moment, self.virtual = exact(sample.moment), exact(np.array(virtual))
        motion = Motion(truth, sample.gamma, sample.gamma_dot, np.array(gamma_ddot))
        here = self.here = motion.here
        self.legs = [Leg(self, k) for k in LEGS]
        self.v, self.w, self.e, self.v_next = (
            truth.v,
            truth.w,
            truth.e,
            np.roll(truth.v, -1, 0),
        )
        self.r, self.t, self.s, self.R = here.r, here.t, here.s, here.rotation
        # measured
        self.gamma, self.mu, self.beta = here.angles
        self.gd, self.mud, self.betad = motion.rates
        self.gdd, self.mudd, self.betadd = motion.accelerations
        self.omega, self.omegad = motion.omega[0], motion.omega_dot[0]
        self.rd, self.td = motion.slope(lambda at: at.r), motion.slope(lambda at: at.t)
        self.wd = motion.slope(lambda at: at.frames[1:4, :, 2])
        self.first, self.second = here.frames[1:4], here.frames[4:]
        self.lever = truth.lever(motion.gamma)
        own, own_dot = here.own(motion.omega), here.own(motion.omega_dot)
        self.wa, self.wp, self.wad, self.wpd = (
            own[1:4],
            own[4:],
            own_dot[1:4],
            own_dot[4:],
        )
        # moments n = n_ext - d/dt (I omega), in the body's own frame for links
        changes = motion.momentum_rates()
        self.ne, of_links = self.moment - changes[0], here.own(-changes)[1:]
        self.na, self.np = of_links[:3], of_links[3:]
        spins = truth.spins(lambda x: motion.gamma + x * self.virtual)
        self.turn_e, own = spins[0], here.own(spins)
        self.turn_a, self.turn_p = own[1:4], own[4:]
        self.inertia = truth.inertia_matrix(motion.gamma)
        self.tau = self.inertia @ self.gdd + truth.resistance(
            motion.gamma, self.gd, self.moment
        )
        self._define()

    def _define(self):
        star, *links = self.truth.inertias
        self.Ia, self.Ip = links[:3], links[3:]
        # Eqs. 11 to 49
        self.d = EYE
        self.N = self.each(lambda k: cross(k.r, k.t))
        self.c = self.each(lambda k: k.N @ k.w)
        self.J1, self.J2 = np.diag(self.c), -self.N
        self.J = J = -solve(self.J2, self.J1)
        self.a = -self.r @ J
        self.wr = self.each(lambda k: cross(k.w, k.r))
        self.b = self.each(lambda k: -J.T @ k.wr / (k.wr @ k.t))
        self.tw = self.each(lambda k: k.t @ k.w)
        omega, gd = J @ self.gd, self.gd
        self.m = self.each(lambda k: (k.a @ gd) * k.tw)
        self.n = self.each(lambda k: -(k.b @ gd) * (k.r @ omega))
        self.M = np.diag(self.m)
        self.x = x = solve(self.J2, self.M @ gd + self.n)
        self.f = self.each(lambda k: -(k.b @ gd) * (cross(k.t, k.r) @ omega) + k.r @ x)
        self.u_vector = self.each(lambda k: k.tw * k.d - J.T @ k.t)
        self.u = self.each(lambda k: k.t @ (x - k.wr * (k.d @ gd) * (k.a @ gd)))
        # frames and link Jacobians, Eqs. 50 to 62
        self.B0 = self.each(lambda k: np.stack([k.v, cross(k.w, k.v), k.w], axis=1))
        self.R01 = self.each(lambda k: turn(Z * k.gamma))
        self.R21 = self.each(lambda k: turn(X * -k.mu).T)
        self.w1 = self.each(lambda k: k.R01.T @ k.B0.T @ k.w)
        self.r2 = self.each(lambda k: k.second.T @ k.r)
        self.Ja = self.E = self.each(lambda k: np.outer(k.w1, k.d))
        self.R2B = self.each(lambda k: k.R21 @ k.R01.T @ k.B0.T)
        self.Jp = self.each(lambda k: k.R2B @ (np.outer(k.w, k.d) - np.outer(k.r, k.a)))
        # moments, Eqs. 63 to 82
        self.Is = self.R @ star @ self.R.T
        self.Q = -self.Is @ J
        self.q = self.Is @ x - cross(omega, self.Is @ omega) + self.moment
        self.L = self.each(lambda k: -k.Ia @ k.E)
        self.ell = self.each(lambda k: -cross(k.Ja @ gd, k.Ia @ (k.Ja @ gd)))
        self.P = self.each(lambda k: k.R21 @ k.E + np.outer(k.r2, J.T @ k.r))
        self.p = self.each(
            lambda k: -cross(k.R21 @ (k.Ja @ gd), k.r2 * (k.a @ gd)) - k.f * k.r2
        )
        self.K = self.each(lambda k: -k.Ip @ k.P)
        self.kk = self.each(
            lambda k: -k.Ip @ k.p - cross(k.Jp @ gd, k.Ip @ (k.Jp @ gd))
        )
        self.T1 = J.T @ self.Q + sum(k.Ja.T @ k.L + k.Jp.T @ k.K for k in self.legs)
        self.T2 = J.T @ self.q + sum(k.Ja.T @ k.ell + k.Jp.T @ k.kk for k in self.legs)

    def each(self, function):
        return np.array([function(k) for k in self.legs])

    def gaps(self, gamma, rotation):
        """Loop closure r_k . R e_k of any gamma and R."""
        return (self.truth.carriages(gamma) * (self.e @ rotation.T)).sum(axis=1)

    @property
    def zyz(self):
        R = self.R
        return mp.atan2(R[1, 2], R[0, 2]), mp.acos(R[2, 2]), mp.atan2(R[2, 1], -R[2, 0])

    def balance(self, ne, na, np_):
        """Generalized forces of all moments, Eq. 88."""
        links = (
            k.Ja.T @ a + k.Jp.T @ p for k, a, p in zip(self.legs, na, np_, strict=True)
        )
        return self.tau + self.J.T @ ne + sum(links)


def legs(function):
    """One residual of each leg."""
    return lambda p: p.each(lambda k: function(p, k))


RESIDUALS = {
    1: legs(lambda p, k: unit(cross(k.v, k.r)) - unit(cross(k.v, k.v_next))),
    2: legs(lambda p, k: k.t - unit(cross(p.s, k.r))),
    3: lambda p: p.R - turn(Z * p.zyz[0]) @ turn(Y * p.zyz[1]) @ turn(Z * p.zyz[2]),
    4: legs(lambda p, k: min(k.w @ p.s, mp.mpf(0))),
    5: lambda p: p.R - np.stack([cross(p.t[0], p.s), p.t[0], p.s], axis=1),
    6: lambda p: mp.cos(p.zyz[1]) - p.s @ Z,
    7: lambda p: mp.sin(p.zyz[1]) * mp.expj(p.zyz[0]) - mp.mpc(p.s[0], p.s[1]),
    8: lambda p: mp.sin(p.zyz[1]) * mp.expj(p.zyz[2]) - mp.mpc(-p.R[2, 0], p.R[2, 1]),
    9: lambda p: p.J1 @ p.gd + p.J2 @ p.omega,
    10: legs(lambda p, k: k.w * k.gd - k.r * k.mud - k.t * k.betad - p.omega),
    11: legs(lambda p, k: (k.N @ k.w) * k.gd - k.N @ p.omega),
    12: lambda p: p.J1 - partials(lambda g: p.gaps(g, p.R), p.gamma).T,
    13: lambda p: (
        p.J2 - partials(lambda x: p.gaps(p.gamma, turn(x) @ p.R), 0 * p.gamma).T
    ),
    14: legs(lambda p, k: k.c - mp.sin(k.mu)),
    15: lambda p: [p.J - p.lever, p.J @ p.gd - p.omega],
    16: legs(lambda p, k: k.d @ p.gd - k.gd),
    17: lambda p: np.stack(p.d, axis=1) - np.eye(3),
    18: legs(lambda p, k: k.mud + k.r @ p.omega),
    19: legs(lambda p, k: k.mud - k.a @ p.gd),
    20: legs(lambda p, k: k.a + p.lever.T @ k.r),
    21: legs(lambda p, k: k.betad + k.wr @ p.omega / (k.wr @ k.t)),
    22: legs(lambda p, k: k.betad - k.b @ p.gd),
    23: legs(lambda p, k: k.b * (k.wr @ k.t) + p.lever.T @ k.wr),
    24: legs(
        lambda p, k: (
            k.w * k.gdd
            + k.wd * k.gd
            - k.r * k.mudd
            - k.rd * k.mud
            - k.t * k.betadd
            - k.td * k.betad
            - p.omegad
        )
    ),
    25: legs(lambda p, k: k.wd),
    26: legs(lambda p, k: k.rd - k.gd * k.wr),
    27: legs(lambda p, k: k.td - cross(p.omega, k.t)),
    28: legs(
        lambda p, k: (
            k.w * k.gdd
            - k.r * k.mudd
            - k.gd * k.mud * k.wr
            - k.t * k.betadd
            - k.betad * cross(p.omega, k.t)
            - p.omegad
        )
    ),
    29: legs(
        lambda p, k: (
            k.N
            @ (
                k.w * k.gdd
                - p.omegad
                - k.gd * k.mud * k.wr
                - k.betad * cross(p.omega, k.t)
            )
        )
    ),
    30: legs(
        lambda p, k: (
            k.N @ (k.w * k.gdd - p.omegad - k.gd * (k.a @ p.gd) * k.wr)
            - k.N @ ((k.b @ p.gd) * cross(p.omega, k.t))
        )
    ),
    31: legs(lambda p, k: k.N @ k.td - k.r @ p.omega),
    32: legs(lambda p, k: k.N @ k.rd + k.gd * (k.t @ k.w)),
    33: legs(
        lambda p, k: (
            k.c * k.gdd
            - k.N @ p.omegad
            + k.gd * (k.a @ p.gd) * k.tw
            - (k.b @ p.gd) * (k.r @ p.omega)
        )
    ),
    34: legs(
        lambda p, k: (
            k.c * k.gdd
            - k.N @ p.omegad
            + k.gd * (k.a @ p.gd) * k.tw
            - (k.b @ p.gd) * (k.r @ (p.J @ p.gd))
        )
    ),
    35: lambda p: p.J1 @ p.gdd + p.J2 @ p.omegad + p.M @ p.gd + p.n,
    36: lambda p: p.M - np.diag(p.mud * p.tw),
    37: legs(lambda p, k: k.n + k.betad * (k.r @ p.omega)),
    38: legs(lambda p, k: k.m - k.mud * mp.cos(k.mu)),
    39: legs(lambda p, k: k.n - k.betad * k.mud),
    40: lambda p: p.omegad - p.J @ p.gdd + p.x,
    41: legs(lambda p, k: k.d @ p.gdd - k.gdd),
    42: legs(
        lambda p, k: k.mudd + k.betad * (k.r @ cross(p.omega, k.t)) + k.r @ p.omegad
    ),
    43: legs(
        lambda p, k: k.mudd + k.betad * (cross(k.t, k.r) @ p.omega) + k.r @ p.omegad
    ),
    44: legs(lambda p, k: k.mudd + p.J.T @ k.r @ p.gdd - k.f),
    45: legs(lambda p, k: k.f - k.mudd - p.lever.T @ k.r @ p.gdd),
    46: legs(
        lambda p, k: (
            k.betadd - k.tw * k.gdd + k.gd * k.mud * (k.t @ k.wr) + k.t @ p.omegad
        )
    ),
    47: legs(lambda p, k: k.betadd - k.u_vector @ p.gdd - k.u),
    48: legs(lambda p, k: k.u_vector - k.tw * k.d + p.lever.T @ k.t),
    49: legs(lambda p, k: k.u - k.betadd + k.tw * k.gdd - p.lever.T @ k.t @ p.gdd),
    50: legs(lambda p, k: k.B0 @ turn(Z * k.gamma) - k.first),
    51: legs(lambda p, k: k.B0 @ k.R01 - k.first),
    52: legs(lambda p, k: k.first @ k.R21.T - k.second),
    53: legs(lambda p, k: k.wa - k.gd * (k.first.T @ k.w)),
    54: legs(lambda p, k: k.wa - k.w1 * (k.d @ p.gd)),
    55: legs(lambda p, k: k.w1 - k.first.T @ k.w),
    56: legs(lambda p, k: k.wa - k.Ja @ p.gd),
    57: legs(lambda p, k: k.Ja @ p.virtual - k.turn_a),
    58: legs(lambda p, k: k.wp - k.R21 @ k.wa + k.mud * k.r2),
    59: legs(lambda p, k: k.wp - (k.R21 @ k.Ja - np.outer(k.r2, k.a)) @ p.gd),
    60: legs(lambda p, k: k.wp - k.Jp @ p.gd),
    61: legs(lambda p, k: k.Jp @ p.virtual - k.turn_p),
    62: legs(lambda p, k: k.R2B - k.second.T),
    63: lambda p: p.ne - p.moment + p.Is @ p.omegad + cross(p.omega, p.Is @ p.omega),
    64: lambda p: (
        p.omega @ p.Is @ p.omega
        - (p.R.T @ p.omega) @ p.truth.inertias[0] @ (p.R.T @ p.omega)
    ),
    65: lambda p: p.ne - p.Q @ p.gdd - p.q,
    66: lambda p: p.Q + p.Is @ p.lever,
    67: lambda p: p.q - p.ne - p.Is @ p.lever @ p.gdd,
    68: legs(lambda p, k: k.na + k.Ia @ k.wad + cross(k.wa, k.Ia @ k.wa)),
    69: legs(lambda p, k: k.wad - k.gdd * k.w1),
    70: legs(lambda p, k: k.wad - k.E @ p.gdd),
    71: legs(lambda p, k: k.E - np.outer(k.first.T @ k.w, k.d)),
    72: legs(lambda p, k: k.na - k.L @ p.gdd - k.ell),
    73: legs(lambda p, k: k.L @ p.gdd + k.Ia @ k.wad),
    74: legs(lambda p, k: k.ell + cross(k.wa, k.Ia @ k.wa)),
    75: legs(lambda p, k: k.np + k.Ip @ k.wpd + cross(k.wp, k.Ip @ k.wp)),
    76: legs(
        lambda p, k: (
            k.wpd - k.R21 @ k.wad + cross(k.R21 @ k.wa, k.mud * k.r2) + k.mudd * k.r2
        )
    ),
    77: legs(lambda p, k: k.wpd - k.P @ p.gdd - k.p),
    78: legs(lambda p, k: k.P - k.Jp),
    79: legs(lambda p, k: k.p - k.wpd + k.Jp @ p.gdd),
    80: legs(lambda p, k: k.np - k.K @ p.gdd - k.kk),
    81: legs(lambda p, k: k.K + k.Ip @ k.Jp),
    82: legs(lambda p, k: k.kk - k.np - k.Ip @ (k.Jp @ p.gdd)),
    83: lambda p: (
        p.virtual @ p.tau
        + (p.J @ p.virtual) @ p.ne
        + sum((k.Ja @ p.virtual) @ k.na + (k.Jp @ p.virtual) @ k.np for k in p.legs)
    ),
    84: lambda p: p.J @ p.virtual - p.turn_e,
    85: legs(lambda p, k: k.Ja @ p.virtual - k.turn_a),
    86: legs(lambda p, k: k.Jp @ p.virtual - k.turn_p),
    87: lambda p: p.virtual @ p.balance(p.ne, p.na, p.np),
    88: lambda p: p.balance(p.ne, p.na, p.np),
    89: lambda p: p.balance(p.Q @ p.gdd + p.q, p.L @ p.gdd + p.ell, p.K @ p.gdd + p.kk),
    90: lambda p: p.T1 @ p.gdd + p.T2 + p.tau,
    91: lambda p: [p.T1 + p.inertia, p.T1 - p.T1.T],
    92: lambda p: p.T2 + p.tau + p.T1 @ p.gdd,
}


@pytest.fixture(scope="module", params=[True, False], ids=["isotropic", "general"])
def paper(request):
    return Paper(*seeded_samples(1, 1, isotropic=request.param))


def test_every_equation_of_the_paper_is_here():
    assert list(RESIDUALS) == list(range(1, 93))


@pytest.mark.parametrize("number", RESIDUALS, ids=str)
def test_equation(paper, number):
    found = RESIDUALS[number](paper)
    for residual in found if isinstance(found, list) else [found]:
        size = mp.sqrt(sum(abs(x) ** 2 for x in np.ravel(residual)))
        assert size < BOUND, f"Eq. {number}: {mp.nstr(size, 3)}"
