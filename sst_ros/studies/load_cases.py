# SPDX-License-Identifier: Apache-2.0
"""Extreme cases of loads: sharp friction, lag, hard stops, torques that jump, long swinging."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from dataclasses import replace

from sst_ros.scene.bodies import Inertia, Link
from sst_ros.scene.loads import (
    Actuators,
    Friction,
    Initial,
    JointFriction,
    Stroke,
    Workspace,
)
from sst_ros.scene.scene import Scene, load
from sst_ros.simulation.simulation import Simulation
from sst_ros.studies import extreme_scenes as extremes
from sst_ros.studies.extreme_cases import Case, Triple

REST = extremes.REST
QUARTER = math.pi / 4


def load_cases() -> Iterator[Case]:
    """Yield the cases."""
    for group, found in (
        ("Friction and actuators", _friction()),
        ("Compliant stops", _contacts()),
        ("Torques that jump", _jumps()),
        ("Extreme ratios of inertia", _ratios()),
        ("Long runs", _long()),
    ):
        for case in found:
            yield replace(case, group=group)


def _friction() -> Iterator[Case]:
    push, breakaway = (0.3, 0.4, 0.2), 2.0

    def stuck(smoothing: float) -> Scene:
        rub = Friction(coulomb=1.0, static=breakaway, smoothing=smoothing, stribeck=0.1)
        return replace(extremes.base(), friction=JointFriction(gamma=rub))

    for smoothing in (1e-4, 1e-6, 1e-8):

        def crept(simulation: Simulation, v: float = smoothing) -> float:
            """Compare with gamma + smoothing artanh(tau / static) t."""
            t = simulation.time_ns * 1e-9
            path = [QUARTER + v * math.atanh(tau / breakaway) * t for tau in push]
            return math.dist(simulation.state.joints.gamma, path) / (v * t)

        yield Case(
            f"Stribeck friction, smoothing {smoothing:g} rad/s",
            "each joint creeps at smoothing artanh(tau / static), a part in 100 of that path",
            lambda v=smoothing: stuck(v),  # type: ignore[misc]
            push, 20, 1_000_000, crept, 1e-2,
            difficulty=f"the friction torque changes sign within {smoothing:g} rad/s: rates decay "
            f"at some {5.0 / smoothing:.0e} 1/s",
        )  # fmt: skip
    for lag in (1e-3, 1e-6, 1e-9):

        def unlagged(simulation: Simulation) -> float:
            return extremes.apart(simulation, extremes.reference())

        yield Case(
            f"actuator lag of {lag:g} s",
            "the motion without lag, its torque late by the lag",
            lambda a=lag: replace(extremes.spun(2.0), actuators=Actuators(time_constant=a)),  # type: ignore[misc]
            extremes.PUSH, 20, 10_000_000, unlagged, max(lag, 1e-8),
            difficulty=f"a decay of {1.0 / lag:.0e} 1/s in the state",
        )  # fmt: skip


def _contacts() -> Iterator[Case]:
    def bounce(stiffness: float, rate: float) -> Scene:
        initial = Initial(gamma=(QUARTER, QUARTER, QUARTER), gamma_dot=(rate, rate, rate))
        stroke = Stroke(at_end="elastic", stiffness=stiffness)
        return replace(extremes.base(), initial=initial, stroke=stroke,
                       workspace=Workspace(at_edge="ignore"))  # fmt: skip

    for stiffness in (1e3, 1e5, 1e9):
        yield Case(
            f"stops of {stiffness:g} N m/rad",
            "energy is constant",
            lambda k=stiffness: extremes.bouncing(Stroke(at_end="elastic", stiffness=k)),  # type: ignore[misc]
            REST, 30, 10_000_000, extremes.energy_drift, 1e-8,
            difficulty="the torque has a kink; contact takes pi sqrt(m / k)",
        )  # fmt: skip

    def symmetric(simulation: Simulation) -> float:
        gamma, rate = simulation.state.joints.gamma, simulation.state.joints.gamma_dot
        spread = max(max(gamma) - min(gamma), (max(rate) - min(rate)) / abs(rate[0]))
        return max(spread, extremes.energy_drift(simulation))

    yield Case(
        "three simultaneous contacts", "all legs stay alike, energy is constant",
        lambda: bounce(1e5, 1.0), REST, 100, 10_000_000, symmetric, 1e-8,
        difficulty="rounding must not decide the order of contacts",
    )  # fmt: skip
    yield Case(
        "forty contacts in a second", "energy is constant",
        lambda: bounce(1e4, 20.0), REST, 10, 100_000_000, extremes.energy_drift, 1e-9,
        difficulty="each contact is located; their errors add up",
    )  # fmt: skip


def _like_tight(torque: Callable[[int], Triple], steps: int, period_ns: int) -> Case:
    """Return a case whose truth is DOP853 at a tolerance of 1e-14 under the same torques."""

    def apart(simulation: Simulation) -> float:
        tight = Simulation(simulation.scene, "dop853", tolerance=1e-14)
        for k in range(steps):
            tight.step(torque(k), period_ns)
        return extremes.apart(simulation, tight)

    return Case(
        "", "the motion at a tolerance of 1e-14", lambda: extremes.spun(0.5), torque, steps,
        period_ns, apart, 1e-9,
    )  # fmt: skip


def noise(k: int) -> Triple:
    """Return reproducible noise of 1 N m for period k."""
    generator = random.Random(k)
    return (generator.gauss(0.0, 1.0), generator.gauss(0.0, 1.0), generator.gauss(0.0, 1.0))


def _jumps() -> Iterator[Case]:
    def square(k: int) -> Triple:
        sign = 1.0 if k % 4 < 2 else -1.0
        return (2.0 * sign, -1.5 * sign, 1.0 * sign)

    yield replace(
        _like_tight(noise, 1000, 100_000), name="noise of 1 N m at 10 kHz",
        difficulty="a jump of the torque at every step",
    )  # fmt: skip
    yield replace(
        _like_tight(square, 60, 5_000_000), name="square wave of 2 N m",
        difficulty="jumps of twice the amplitude",
    )  # fmt: skip
    for period_ns in (333_333, 7_919_317):
        yield replace(
            _like_tight(lambda _: extremes.PUSH, 37, period_ns),
            name=f"control period of {period_ns} ns",
            difficulty="a period that no step size divides; time is whole nanoseconds",
        )  # fmt: skip


def _ratios() -> Iterator[Case]:
    def far(star: float, links: float) -> Scene:
        scene = extremes.heavier(links)
        inertia = extremes.times(extremes.base().star.inertia, star)
        return replace(scene, star=replace(scene.star, inertia=inertia))

    for star, links in ((1e9, 1e-9), (1e-9, 1e9)):
        yield Case(
            f"star x {star:g} with links x {links:g}",
            "energy is constant",
            lambda a=star, b=links: far(a, b),  # type: ignore[misc]
            REST, 10, 10_000_000, extremes.energy_drift, 1e-8,
            difficulty="inertias 1e18 apart in one mass matrix",
        )  # fmt: skip
    for scale in (1.0, 1e-12):

        def bare(a: float = scale) -> Scene:
            scene, links = extremes.spun(2.0), (Link(), Link(), Link())
            inertia = extremes.times(Inertia(xx=0.39, yy=0.39, zz=0.26), a)
            return replace(scene, star=replace(scene.star, inertia=inertia),
                           actuated_links=links, intermediate_links=links)  # fmt: skip

        yield Case(
            f"star x {scale:g} beside massless links",
            "energy is constant",
            bare, REST, 20, 10_000_000, extremes.energy_drift, 1e-9,
            difficulty="the star is all that has inertia",
        )  # fmt: skip


def _long() -> Iterator[Case]:
    yield Case(
        "100 s of swinging under gravity", "energy is constant",
        lambda: load("swing"), REST, 1000, 100_000_000,
        lambda simulation: abs(simulation.energy_residual), 1e-5,
        difficulty="errors grow with time; the quaternion must keep its length",
    )  # fmt: skip
