# SPDX-License-Identifier: Apache-2.0
"""Extreme cases of loads: sharp friction, lag, hard stops, torques that jump, long swinging."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from sst_ros.scene.loads import Actuators, Friction, Initial, JointFriction, Stroke, Workspace
from sst_ros.scene.scene import Scene, load
from sst_ros.simulation.simulation import Simulation
from studies import extreme_scenes as extremes
from studies.extreme_cases import LOOSE, Case
from studies.extreme_scenes import REST, Triple
from studies.sampled_data import pole

QUARTER = math.pi / 4


def friction() -> Iterator[Case]:
    """Yield sharp friction, and actuators that lag."""
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
            partial(stuck, smoothing),
            push, 20, 1_000_000, crept, 1e-2,
            difficulty=f"the friction torque changes sign within {smoothing:g} rad/s: rates decay "
            f"at some {5.0 / smoothing:.0e} 1/s",
        )  # fmt: skip
    for lag in (1e-3, 1e-6, 1e-9):
        yield Case(
            f"actuator lag of {lag:g} s",
            "the motion without lag, its torque late by the lag",
            partial(replace, extremes.spun(2.0), actuators=Actuators(time_constant=lag)),
            extremes.PUSH, 20, 10_000_000, extremes.from_reference, max(lag, 1e-8),
            difficulty=f"a decay of {1.0 / lag:.0e} 1/s in the state",
        )  # fmt: skip


FINER = 1e-7
"""Tolerance at which the error estimate is checked where LOOSE does not resolve the contacts."""

SHORT_CONTACT = (
    "a contact of 6e-5 s is a few steps at a tolerance of 1e-6, at which the estimate is 0.06 of "
    "the true error: the coarse solution meets the stop half a step apart"
)

SHARP_FRICTION = (
    "three steps are the whole motion at a tolerance of 1e-6, at which the estimate is 17 times "
    "the true error: friction brings neighbouring motions together, which so few steps do not see"
)

UNSTABLE = (
    "three joints that bounce together are an unstable motion, in which 1e-14 rad at the start "
    "become 5e-3 rad after forty contacts: the error is that of rounding at any tolerance"
)


def bounce(stiffness: float, rate: float) -> Scene:
    """Send all three actuators against their stops at once."""
    initial = Initial(gamma=(QUARTER, QUARTER, QUARTER), gamma_dot=(rate, rate, rate))
    stroke = Stroke(at_end="elastic", stiffness=stiffness)
    return replace(extremes.base(), initial=initial, stroke=stroke,
                   workspace=Workspace(at_edge="ignore"))  # fmt: skip


def contacts() -> Iterator[Case]:
    """Yield compliant stops."""
    for stiffness in (1e3, 1e5, 1e9):
        yield Case(
            f"stops of {stiffness:g} N m/rad",
            "energy is constant",
            partial(extremes.bouncing, Stroke(at_end="elastic", stiffness=stiffness)),
            REST, 30, 10_000_000, extremes.energy_drift, 1e-8,
            difficulty="the torque has a kink; contact takes pi sqrt(m / k)",
            loose=FINER if stiffness > 1e8 else LOOSE,
            estimate=SHORT_CONTACT if stiffness > 1e8 else "",
        )  # fmt: skip

    def symmetric(simulation: Simulation) -> float:
        gamma, rate = simulation.state.joints.gamma, simulation.state.joints.gamma_dot
        spread = max(max(gamma) - min(gamma), (max(rate) - min(rate)) / abs(rate[0]))
        return max(spread, extremes.energy_drift(simulation))

    yield Case(
        "three simultaneous contacts", "all legs stay alike, energy is constant",
        partial(bounce, 1e5, 1.0), REST, 100, 10_000_000, symmetric, 1e-8,
        difficulty="rounding must not decide the order of contacts",
    )  # fmt: skip
    yield Case(
        "forty contacts in a second", "energy is constant",
        partial(bounce, 1e4, 20.0), REST, 10, 100_000_000, extremes.energy_drift, 1e-9,
        difficulty="each contact is located; their errors add up", loose=None, estimate=UNSTABLE,
    )  # fmt: skip

    def rubbing() -> Scene:
        rub = JointFriction(gamma=Friction(coulomb=2.0, smoothing=0.01))
        return replace(bounce(1e5, 3.0), friction=rub)

    def tight(simulation: Simulation) -> float:
        return extremes.apart(simulation, extremes.ended(rubbing(), REST, 30, 10_000_000))

    yield Case(
        "sharp Coulomb friction and three contacts", "the motion at a tolerance of 1e-14",
        rubbing, REST, 30, 10_000_000, tight, 1e-8,
        difficulty="friction of 2 N m changes its sign within 0.01 rad/s, at each contact",
        loose=FINER, estimate=SHARP_FRICTION,
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


PD_RATE = 100.0
"""Bandwidth of the sampled PD control [rad/s]; its damping ratio is 1."""


def _sampled_pd(product: float) -> Case:
    """Return PD control with bandwidth x period = `product` [rad], held over each period.

    Its gains are the mass matrix at the pose times bandwidth^2 and 2 x bandwidth, so that theory is
    the sampled double integrator: errors grow by `sampled_data.pole` a period.
    """
    period_ns = round(product / PD_RATE * 1e9)
    pose, steps = np.array((0.7, 0.8, 0.75)), 120
    initial = Initial(gamma=(0.7 + 1e-7, 0.8 - 1e-7, 0.75 + 2e-7))
    scene = replace(extremes.free(), initial=initial)
    inertia = extremes.mass_matrix(scene)
    sizes: list[float] = []

    def torque(k: int, simulation: Simulation) -> Triple:
        joints = simulation.state.joints
        off, rate = joints.gamma - pose, np.array(joints.gamma_dot)
        if k == 0:
            sizes.clear()
        sizes.append(math.hypot(*off, *(rate / PD_RATE)))
        first, second, third = (-inertia @ (PD_RATE**2 * off + 2.0 * PD_RATE * rate)).tolist()
        return (first, second, third)

    def grown(_: Simulation) -> float:
        half = len(sizes) // 2
        found: float = (sizes[-1] / sizes[-1 - half]) ** (1.0 / half)
        return abs(found - pole(product, 1.0, 0))

    return Case(
        f"sampled PD control at {product:g} of the limit of its bandwidth",
        f"errors grow by {pole(product, 1.0, 0):.4f} a period, the pole of the sampled loop",
        lambda: scene, torque, steps, period_ns, grown, 1e-3, feedback=True,
        difficulty="a step more of delay or a gain 1 % higher turns decay into growth",
    )  # fmt: skip


def noise(k: int) -> Triple:
    """Return reproducible noise of 1 N m for period k."""
    generator = random.Random(k)
    return (generator.gauss(0.0, 1.0), generator.gauss(0.0, 1.0), generator.gauss(0.0, 1.0))


def jumps() -> Iterator[Case]:
    """Yield torques that jump."""

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
    yield from map(_sampled_pd, (0.98, 1.02))
    for period_ns in (333_333, 7_919_317):
        yield replace(
            _like_tight(lambda _: extremes.PUSH, 37, period_ns),
            name=f"control period of {period_ns} ns",
            difficulty="a period that no step size divides; time is whole nanoseconds",
        )  # fmt: skip


def long_runs() -> Iterator[Case]:
    """Yield long runs."""

    def residual(simulation: Simulation) -> float:
        return max(abs(simulation.energy_residual), simulation.closure_residual)

    swing = partial(load, "swing")
    yield Case(
        "20 s of swinging under gravity", "energy is constant [J]",
        swing, REST, 200, 100_000_000, residual, 1e-9,
        difficulty="errors grow with time; the quaternion must keep its length",
    )  # fmt: skip
    for method, bound in (("dop853", 1e-10), ("rk4", 1e-3)):
        yield Case(
            f"1e5 s of swinging, {method}, steps of 10 ms", "energy is constant [J], of 1.14 J",
            swing, REST, 10_000_000, 10_000_000, residual, bound, integrator=method,
            difficulty="ten million steps: rounding adds up, truncation of RK4 drifts",
            compiled_only=True, loose=None, estimate="one run of ten million fixed steps",
        )  # fmt: skip
    yield Case(
        "a thousand contacts", "energy is constant", partial(bounce, 1e4, 20.0), REST, 250,
        100_000_000, extremes.energy_drift, 1e-7, compiled_only=True, loose=None, estimate=UNSTABLE,
        difficulty="each contact is located; their errors add up",
    )  # fmt: skip
