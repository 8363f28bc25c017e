# SPDX-License-Identifier: Apache-2.0
"""The catalogue of stiff and extreme cases, as data.

A case has a scene, what acts on it, and the truth. Truths are scaling laws, closed
forms, energy, rest, refusals by name, or the motion at the tightest tolerance:

- Without friction and springs a motion under torques tau from rates v takes place s
  times slower under tau / s^2 from v / s, and is the same for inertias and torques
  times a. Gravity is absent.
- At a parallel singularity (det J2 = 0) gamma does not determine the pose, but the
  motion is regular in orientation and body rate: the energy residual shows whether it
  is passed correctly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

from sst_ros.errors import RunStopped
from sst_ros.integration.stepper import WHOLE_MOTION_BUDGET
from sst_ros.mechanism.geometry import angle_between
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import Vector3
from studies import extreme_scenes as make
from studies.extreme_scenes import (
    FREE,
    MS,
    PUSH,
    QUARTER,
    REST,
    RIGHT,
    Changes,
    changed,
)

Torque = Vector3 | Callable[[int, Any], Vector3]

LOOSE = 1e-6
"""Tolerance of the run whose error estimate is checked."""


@dataclass(frozen=True, eq=False)
class Case:
    """One case: a scene, what acts on it, and what must come out."""

    name: str
    # of `base` by key, or a function that finds them
    changes: Changes | Callable[[], Changes]
    torque: Torque  # [N m]: constant, or a function of period and simulation
    steps: int  # control periods
    period_ns: int
    expected: str = ""  # the truth and its reason, in words
    # of the end from the truth
    deviation: Callable[[Case, Simulation], float] | None = None
    bound: float = 0.0  # largest deviation that passes
    difficulty: str = ""  # why it is hard; empty for what its group says
    refusal: str = ""  # name of the error that must end the run; empty where none may
    # when it must come [s]; None if not known
    stop_time: Callable[[], float] | None = None
    group: str = ""  # heading on the page
    base: str = "example2_heavy"
    integrator: str = "auto"
    feedback: bool = False  # the torque reads the simulation
    long: bool = False  # takes minutes; run by `studies.extreme --long` alone
    loose: float | None = LOOSE  # tolerance of the check of the estimate; None for none
    estimate: str = ""  # why `loose` is not LOOSE

    def scene(self) -> Scene:
        """Make the scene."""
        return changed(
            self.changes() if callable(self.changes) else self.changes, self.base
        )

    def torque_at(self, simulation: Simulation) -> Vector3:
        """Return the torques of the control period that begins now [N m]."""
        if not callable(self.torque):
            return self.torque
        return self.torque(simulation.time_ns // self.period_ns, simulation)


REFERENCE = Case("reference", make.spun(2.0), PUSH, 20, 10 * MS)
TURNED = Case("without torque", make.spun(10.0), REST, 10, 4 * MS)
STIFFER = Case("stops ten times as stiff", make.bouncing(1e9), REST, 30, 10 * MS)


@cache
def tight_end(case: Case) -> Simulation:
    """Run a case by DOP853 at the tightest tolerance, under the same torques."""
    simulation = Simulation(
        case.scene(), "dop853", tolerance=1e-14, step_budget=WHOLE_MOTION_BUDGET
    )
    for _ in range(case.steps):
        simulation.step(case.torque_at(simulation), case.period_ns)
    return simulation


def apart(one: Simulation, other: Simulation) -> float:
    """Angle between two orientations [rad]."""
    return float(angle_between(one.state.quaternion, other.state.quaternion))


def from_tight(case: Case, simulation: Simulation) -> float:
    """Angle from the end of the same motion at the tightest tolerance [rad]."""
    return apart(simulation, tight_end(case))


def from_end(other: Case, _: Case, simulation: Simulation) -> float:
    """Angle from the end of another case at the tightest tolerance [rad]."""
    return apart(simulation, tight_end(other))


def from_stiffer_bounce(case: Case, simulation: Simulation) -> float:
    """Energy lost, or a thousandth of the angle from the bounce off stiffer stops."""
    return max(
        apart(simulation, tight_end(STIFFER)) / 1e3, energy_drift(case, simulation)
    )


def energy_drift(_: Case, simulation: Simulation) -> float:
    """Energy residual relative to the energy."""
    return abs(simulation.energy_residual) / simulation.dynamics.total_energy(
        simulation.sample[0]
    )


def residuals(_: Case, simulation: Simulation) -> float:
    """Energy residual [J], or closure residual."""
    return max(abs(simulation.energy_residual), simulation.closure_residual)


def crossing(case: Case, simulation: Simulation) -> float:
    """Energy drift; infinite where the parallel singularity was not crossed."""
    began = Simulation(simulation.scene).conditioning["det_j2"]
    crossed = began * simulation.conditioning["det_j2"] < 0.0
    return energy_drift(case, simulation) if crossed else math.inf


def body_rate(_: Case, simulation: Simulation) -> float:
    """Body rate left [rad/s]."""
    return math.hypot(*simulation.state.body_rate)


def from_start(_: Case, simulation: Simulation) -> float:
    """Distance from the angles of the start [rad]."""
    return math.dist(simulation.state.joints.gamma, simulation.scene.initial.gamma)


def from_set_point(_: Case, simulation: Simulation) -> float:
    """Distance from RESTS [rad]."""
    return math.dist(simulation.state.joints.gamma, make.RESTS)


def from_decay(_: Case, simulation: Simulation) -> float:
    """Distance from angles that decay towards RESTS by exp(-k t / c) [rad]."""
    decay = math.exp(-500.0 / 1e5)
    path = [rest + (QUARTER - rest) * decay for rest in make.RESTS]
    return math.dist(simulation.state.joints.gamma, path)


def from_creep(_: Case, simulation: Simulation) -> float:
    """Distance from gamma + smoothing artanh(tau / static) t, relative to that path."""
    t, friction = simulation.time_ns * 1e-9, simulation.scene.friction
    assert friction is not None and friction.gamma is not None
    v = friction.gamma.smoothing
    path = [
        QUARTER + v * math.atanh(tau / make.BREAKAWAY) * t for tau in make.CREEP_PUSH
    ]
    return math.dist(simulation.state.joints.gamma, path) / (v * t)


def asymmetry(case: Case, simulation: Simulation) -> float:
    """Spread of the three legs, or energy drift."""
    gamma, rate = simulation.state.joints.gamma, simulation.state.joints.gamma_dot
    spread = max(max(gamma) - min(gamma), (max(rate) - min(rate)) / abs(rate[0]))
    return max(spread, energy_drift(case, simulation))


def from_unturned(case: Case, simulation: Simulation) -> float:
    """Distance from the angles with the base as it is [rad]."""
    initial = simulation.scene.initial
    unturned = {**FREE, **make.start(initial.gamma, initial.gamma_dot)}
    other = tight_end(replace(case, changes=unturned))
    return math.dist(simulation.state.joints.gamma, other.state.joints.gamma)


def from_beta(beta: float, _: Case, simulation: Simulation) -> float:
    """Relative distance of beta_1 from a value [rad]."""
    return abs(simulation.state.joints.beta[0] / beta - 1.0)


def stop_time(changes: Changes) -> float:
    """Return when a torque of 1e8 N m on gamma_1 must end a run [s].

    The motion is 1e4 times faster than under 1 N m.
    """
    try:
        tight_end(Case("pushed by 1 N m", changes, (1.0, 0.0, 0.0), 10_000, 10 * MS))
    except RunStopped as error:
        return 1e-4 * error.time
    raise ValueError("the run does not end")


ENERGY = ("energy is constant", energy_drift)
RESTING = ("rest stays rest", body_rate)
from_reference, from_turned = partial(from_end, REFERENCE), partial(from_end, TURNED)
TIGHT = ("the motion at a tolerance of 1e-14", from_tight)

UNSTABLE = (
    "three joints that bounce together are an unstable motion, in which 1e-14 rad at"
    " the start become 5e-3 rad after forty contacts: the error is that of rounding at"
    " any tolerance"
)
ONE_RUN = "one run of ten million fixed steps or more"


@cache
def catalogue() -> tuple[Case, ...]:
    """Return all cases."""
    return tuple(
        replace(case, group=group, difficulty=case.difficulty or difficulty)
        for group, difficulty, cases in _groups()
        for case in cases
    )


# fmt: off
def _groups() -> Iterator[tuple[str, str, Iterable[Case]]]:
    """Yield heading, difficulty where a case names none, and the cases."""
    yield "Time scales", "rates over twelve decades", [
        Case(f"time x {s:g}", make.spun(2.0 / s), make.pushed(s**-2), 20,
             round(10 * MS * s),
             "the end of the same motion at its own speed, by the scaling law",
             from_reference, 1e-9)
        for s in (1e-6, 1e-4, 1e-3, 1e-2, 1e-1, 1e1, 1e2, 1e3, 1e4)
    ]
    yield "Inertia scales", "numbers far from 1, or from each other", [
        *(Case(f"inertia x {a:g}", {**make.spun(2.0), **make.inertias(a, a)},
               make.pushed(a), 20, 10 * MS,
               "the same motion, under torques scaled alike", from_reference, 1e-12)
          for a in (1e-12, 1e-6, 1e6, 1e9)),
        *(Case(f"star's inertia x {a:g} beside the same links",
               {**make.spun(2.0), **make.inertias(a, 1.0)}, REST, 10, 10 * MS,
               "energy is kept", energy_drift, 1e-9)
          for a in (1e-9, 1e9)),
    ]
    yield "Violent motion", "accelerations of 1e8 rad/s^2, rates of 1e6 rad/s", [
        *(Case(f"torque of 1e8 N m {where}", changes, (1e8, 0.0, 0.0), 10, 100_000,
               "the same end, sqrt(1e8) times earlier than under 1 N m",
               refusal=refusal, stop_time=partial(stop_time, changes))
          for where, changes, refusal in (
              ("against an end of the stroke", {}, "StrokeExceeded"),
              ("into a serial singularity", FREE, "SingularityReached"))),
        *(Case(f"spin of {rate:g} rad/s", make.spun(rate), REST, 10,
               round(0.4e8 / rate),
               "without torque the path does not depend on the rate", from_turned, 1e-7)
          for rate in (1e4, 1e6)),
    ]
    yield "Starts at limits", "a joint at its limit, where a sign decides", [
        *(Case("start at a corner of the strokes, {:.3g} {:.3g} {:.3g}".format(*gamma),
               make.start(gamma), REST, 10, MS, "rest stays rest", from_start, 1e-12)
          for gamma in (REST, (0.0, 0.5, 0.5), (RIGHT, RIGHT, RIGHT), (0.7, 0.7, 0.0))),
        Case("pushed outwards at an end of the stroke", make.start((0.0, 0.5, 0.5)),
             (-1.0, 0.0, 0.0), 1, MS, "the run ends where it starts",
             refusal="StrokeExceeded", stop_time=lambda: 0.0),
        Case("start at a corner that cannot be assembled",
             make.start((0.0, RIGHT, 0.7)), REST, 1, MS, "refused by name",
             refusal="NoAdmissibleAssembly"),
    ]
    yield "Stiff loads", "decay rates far above those of the motion", [
        Case("viscous friction of 1e5 N m s/rad", make.sprung(500.0, 1e5), REST, 10,
             100 * MS,
             "springs creep: angles decay by exp(-k t / c), inertia counts by M k / c^2"
             " = 1e-8 of it", from_decay, 1e-8),
        *(Case(f"PD gains of 1e6 N m/rad and {damping:g} N m s/rad",
               make.sprung(1e6, damping), REST, 3, 100 * MS,
               "at its set point after more than 25 time constants", from_set_point,
               1e-10)
          for damping in (1e3, 1e4)),
        Case("elastic stops of 1e8 N m/rad", make.bouncing(1e8), REST, 30, 10 * MS,
             "as at 1e9 N m/rad, but for the contact of pi sqrt(m / k) = 2e-4 s; "
             "energy kept",
             from_stiffer_bounce, 1e-6),
    ]
    yield "Parallel singularities", "", [
        *(Case(f"crossed at {spin:g} rad/s",
               partial(make.near_singularity, math.copysign(0.08, -spin), spin), REST,
               80, round(2e6 / abs(spin)),
               "det J2 changes its sign and the energy stays", crossing, 1e-10,
               "J is infinite at the crossing; gamma alone does not determine the "
               "motion")
          for spin in (0.5, -0.5, 2.0, -2.0, 20.0, -20.0)),
        Case("rest 0.1 rad beside one", partial(make.near_singularity, 1e-1, 0.0), REST,
             10, MS, *RESTING, 1e-12, "a second assembly mode lies close by"),
        Case("rest 0.01 rad beside one", partial(make.near_singularity, 1e-2, 0.0),
             REST, 1, MS, "refused by name: gamma has two admissible assemblies there",
             difficulty="two assembly modes meet at a parallel singularity",
             refusal="AmbiguousAssembly"),
    ]
    yield "Edges of the workspace", "", [
        *(case for beta in (1e-3, 1e-6, 1e-9) for case in (
            Case(f"start at beta_1 = {beta:g} rad, inside", partial(make.at_edge, beta),
                 REST, 5, MS, "rest stays rest, at that beta_1",
                 partial(from_beta, beta), 1e-5, "det J1 tends to 0 with beta"),
            Case(f"start at beta_1 = {-beta:g} rad, outside",
                 partial(make.at_edge, -beta), REST, 1, MS, "refused by name",
                 difficulty="the same pose as inside, to nine digits",
                 refusal="NoAdmissibleAssembly"))),
        Case("start 1e-09 rad inside the largest beta",
             partial(make.at_largest_beta, 1e-9), REST, 5, MS, *RESTING, 1e-12,
             "rounding must not decide on which side a pose lies"),
        Case("start 1e-09 rad outside the largest beta",
             partial(make.at_largest_beta, -1e-9), REST, 5, MS, "refused by name",
             refusal="NoAdmissibleAssembly",
             difficulty="rounding must not decide on which side a pose lies"),
    ]
    yield "Poles and unusual shapes", "", [
        *(Case(f"{how} the Euler pole phi = 0", make.at_the_pole(rate), REST, 20,
               10 * MS,
               "gamma as with the base in another orientation: without gravity it does "
               "not matter",
               from_unturned, 1e-9,
               "ZYZ angles are not unique there; the state is a quaternion")
          for how, rate in (
              ("turning at", (1.0, 1.0, 1.0)), ("moving through", (1.0, -0.5, 0.25)))),
        *(Case(f"base triangle of {spread:g} rad", make.small_triangle(spread), REST,
               20, 10 * MS, *ENERGY, 1e-9,
               "the axes of the actuators are nearly parallel planes")
          for spread in (1e-1, 1e-2, 1e-3)),
        Case("base triangle of 1e-06 rad", partial(make.small_triangle, 1e-6), REST, 1,
             MS, "refused: triangle too small", refusal="InputError",
             difficulty="rounding of the corners is a part in 1e10 of it"),
        Case("three arcs of which one is 1 deg", make.short_arc(1.0), REST, 20, 10 * MS,
             *ENERGY, 1e-9, "two actuators nearly share an axis"),
        *(Case(f"needle star, inertia ({thin:g}, 1, 1)",
               {**make.spun(2.0), "star.inertia": {"xx": thin, "yy": 1.0, "zz": 1.0}},
               REST, 20, 10 * MS, *ENERGY, 1e-9,
               "one principal inertia is next to nothing")
          for thin in (1e-3, 1e-6, 1e-9)),
    ]
    yield "Friction and actuators", "", [
        *(Case(f"Stribeck friction, smoothing {v:g} rad/s",
               {"friction.gamma": {"coulomb": 1.0, "static": make.BREAKAWAY,
                                   "smoothing": v,
                                   "stribeck": 0.1}},
               make.CREEP_PUSH, 20, MS,
               "each joint creeps at smoothing artanh(tau / static), a part in 100 of "
               "that path",
               from_creep, 1e-2,
               f"the friction torque changes sign within {v:g} rad/s: rates decay at "
               f"some {5.0 / v:.0e} 1/s")
          for v in (1e-4, 1e-6, 1e-8)),
        *(Case(f"actuator lag of {lag:g} s",
               {**make.spun(2.0), "actuators": {"time_constant": lag}}, PUSH, 20,
               10 * MS, "the motion without lag, its torque late by the lag",
               from_reference, max(lag, 1e-8),
               f"a decay of {1.0 / lag:.0e} 1/s in the state")
          for lag in (1e-3, 1e-6, 1e-9)),
    ]
    yield "Elastic stops", "", [
        *(Case(f"stops of {stiffness:g} N m/rad", make.bouncing(stiffness), REST, 30,
               10 * MS, *ENERGY, 1e-8,
               "the torque has a kink; contact takes pi sqrt(m / k)")
          for stiffness in (1e3, 1e5, 1e9)),
        Case("three simultaneous contacts", make.bouncing_thrice(1e5, 1.0), REST, 100,
             10 * MS, "all legs stay alike, energy is constant", asymmetry, 1e-8,
             "rounding must not decide the order of contacts"),
        Case("forty contacts in a second", make.bouncing_thrice(1e4, 20.0), REST, 10,
             100 * MS, *ENERGY, 1e-9, "each contact is located; their errors add up",
             loose=None, estimate=UNSTABLE),
        Case("sharp Coulomb friction and three contacts",
             {**make.bouncing_thrice(1e5, 5.0),
              "friction.gamma": {"coulomb": 2.0, "smoothing": 0.01}}, REST, 30, 10 * MS,
              *TIGHT,
             1e-8,
             "friction of 2 N m changes its sign within 0.01 rad/s, at each contact"),
    ]
    yield "Torques that jump", "", [
        Case("noise of 1 N m at 10 kHz", make.spun(0.5), make.noise, 1000, 100_000,
             *TIGHT, 1e-9, "a jump of the torque at every step"),
        Case("square wave of 2 N m", make.spun(0.5), make.square_wave, 60, 5 * MS,
             *TIGHT, 1e-9, "jumps of twice the amplitude"),
        *(Case(f"sampled PD control at {product:g} of the limit of its bandwidth",
               make.OFF_POSE, control, 120, control.period_ns,
               f"errors grow by {control.pole:.4f} a period, the pole of the sampled "
               "loop",
               control.from_pole, 1e-3,
               "a step more of delay or a gain 1 % higher turns decay into growth",
               feedback=True)
          for product in (0.98, 1.02) for control in [make.SampledPd(product)]),
        *(Case(f"control period of {period_ns} ns", make.spun(0.5), lambda *_: PUSH, 37,
               period_ns, *TIGHT, 1e-9,
               "a period that no step size divides; time is whole nanoseconds")
          for period_ns in (333_333, 7_919_317)),
    ]
    yield "Extreme ratios of inertia", "", [
        *(Case(f"star x {star:g} with links x {links:g}",
               {**make.spun(2.0), **make.inertias(star, links)}, REST, 10, 10 * MS,
               *ENERGY, 1e-8, "inertias 1e18 apart in one mass matrix")
          for star, links in ((1e9, 1e-9), (1e-9, 1e9))),
        *(Case(f"star x {a:g} beside massless links",
               {**make.spun(2.0), **make.massless_links(a)}, REST, 20, 10 * MS, *ENERGY,
               1e-9, "the star is all that has inertia")
          for a in (1.0, 1e-12)),
    ]
    yield "Long runs", "", [
        Case("20 s of swinging under gravity", {}, REST, 200, 100 * MS,
             "energy is constant [J]", residuals, 1e-9,
             "errors grow with time; the quaternion must keep its length",
             base="swing"),
        *(Case(f"1e5 s of swinging, {method}, steps of {ms} ms", {}, REST, 10**8 // ms,
               ms * MS, "energy is constant [J], of 1.14 J", residuals, bound,
               "millions of steps: rounding adds up, truncation of RK4 drifts",
               base="swing", integrator=method, long=True, loose=None, estimate=ONE_RUN)
          for method, ms, bound in (("dop853", 10, 1e-10), ("rk4", 5, 1e-3))),
        Case("a thousand contacts", make.bouncing_thrice(1e4, 20.0), REST, 250,
             100 * MS, *ENERGY, 1e-7, "each contact is located; their errors add up",
             long=True, loose=None, estimate=UNSTABLE),
    ]
# fmt: on
