# SPDX-License-Identifier: Apache-2.0
"""Extreme cases whose truth is a scaling law, a state of rest, or a closed form.

Without friction and springs a motion under torques tau from rates v takes place s times slower
under tau / s^2 from v / s, and is the same for inertias and torques times a. Gravity is absent.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from sst_ros.scene.loads import Friction, Initial, JointFriction, Spring, Stroke
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import Simulation
from sst_ros.studies import extreme_scenes as extremes
from sst_ros.studies.extreme_cases import Case

REST = extremes.REST


def scaling_cases() -> Iterator[Case]:
    """Yield the cases by group."""
    for group, difficulty, found in (
        ("Time scales", "rates over twelve decades", _scaled_times()),
        ("Inertia scales", "numbers far from 1, or far from each other", _scaled_inertias()),
        ("Violent motion", "accelerations of 1e8 rad/s^2, rates of 1e6 rad/s", _violent()),
        ("Starts at limits", "a joint at its limit, where a sign decides", _starts()),
        ("Stiff loads", "decay rates far above those of the motion", _stiff()),
    ):
        for case in found:
            yield replace(case, group=group, difficulty=case.difficulty or difficulty)


def _scaled_times() -> Iterator[Case]:
    for scale in (1e-6, 1e-4, 1e-3, 1e-2, 1e-1, 1e1, 1e2, 1e3, 1e4):
        yield Case(
            f"time x {scale:g}",
            "the end of the same motion at its own speed, by the scaling law",
            lambda s=scale: extremes.spun(2.0 / s),  # type: ignore[misc]
            (extremes.PUSH[0] / scale**2, extremes.PUSH[1] / scale**2, extremes.PUSH[2] / scale**2),
            20,
            round(10_000_000 * scale),
            lambda simulation: extremes.apart(simulation, extremes.reference()),
            1e-9,
        )


def _scaled_inertias() -> Iterator[Case]:
    for scale in (1e-12, 1e-6, 1e6, 1e9):
        yield Case(
            f"inertia x {scale:g}",
            "the same motion, under torques scaled alike",
            lambda a=scale: extremes.heavier(a),  # type: ignore[misc]
            (extremes.PUSH[0] * scale, extremes.PUSH[1] * scale, extremes.PUSH[2] * scale),
            20,
            10_000_000,
            lambda simulation: extremes.apart(simulation, extremes.reference()),
            1e-12,
        )
    for scale in (1e-9, 1e9):
        yield Case(
            f"star's inertia x {scale:g} beside the same links",
            "energy is kept",
            lambda a=scale: extremes.odd_star(a),  # type: ignore[misc]
            REST,
            10,
            10_000_000,
            extremes.energy_drift,
            1e-9,
        )


def _violent() -> Iterator[Case]:
    push = (1e8, 0.0, 0.0)
    expected = "the same end, sqrt(1e8) times sooner than under 1 N m"
    yield Case(
        "torque of 1e8 N m against an end of the stroke",
        expected,
        extremes.base,
        push,
        10,
        100_000,
        refusal="StrokeExceeded",
        stop_time=lambda: extremes.stop_time(extremes.base(), (1.0, 0.0, 0.0)) * 1e-4,
    )
    yield Case(
        "torque of 1e8 N m into a serial singularity",
        expected,
        extremes.free,
        push,
        10,
        100_000,
        refusal="SingularityReached",
        stop_time=lambda: (
            extremes.stop_time(replace(extremes.base(), **extremes.FREE), (1.0, 0.0, 0.0)) * 1e-4
        ),
    )
    for rate in (1e4, 1e6):
        yield Case(
            f"spin of {rate:g} rad/s",
            "without torque the path does not depend on the rate",
            lambda v=rate: extremes.spun(v),  # type: ignore[misc]
            REST,
            10,
            round(0.4e8 / rate),
            lambda simulation: extremes.apart(simulation, extremes.turned()),
            1e-7,
        )


def _starts() -> Iterator[Case]:
    right = math.pi / 2
    for gamma in (REST, (0.0, 0.5, 0.5), (right, right, right), (0.7, 0.7, 0.0)):
        yield Case(
            f"start at a corner of the strokes, {gamma[0]:.3g} {gamma[1]:.3g} {gamma[2]:.3g}",
            "rest stays rest",
            lambda g=gamma: replace(extremes.base(), initial=Initial(gamma=g)),  # type: ignore[misc]
            REST,
            10,
            1_000_000,
            lambda simulation, g=gamma: math.dist(simulation.state.joints.gamma, g),  # type: ignore[misc]
            1e-12,
        )
    yield Case(
        "pushed outwards at an end of the stroke",
        "the run ends where it starts",
        lambda: replace(extremes.base(), initial=Initial(gamma=(0.0, 0.5, 0.5))),
        (-1.0, 0.0, 0.0),
        1,
        1_000_000,
        refusal="StrokeExceeded",
        stop_time=lambda: 0.0,
    )
    yield Case(
        "start at a corner that cannot be assembled",
        "refused by name",
        lambda: replace(extremes.base(), initial=Initial(gamma=(0.0, right, 0.7))),
        REST,
        1,
        1_000_000,
        refusal="NoAdmissibleAssembly",
    )


def _stiff() -> Iterator[Case]:
    rests = (0.9, 0.7, 0.8)
    start = math.pi / 4

    def sprung(stiffness: float, damping: float) -> Scene:
        springs = [
            Spring(joint=f"gamma_{k + 1}", stiffness=stiffness, rest=rest)
            for k, rest in enumerate(rests)
        ]
        friction = JointFriction(gamma=Friction(viscous=damping))
        return replace(extremes.base(), friction=friction, springs=tuple(springs))

    def creeping(simulation: Simulation) -> float:
        decay = math.exp(-500.0 / 1e5)
        wanted = [rest + (start - rest) * decay for rest in rests]
        return math.dist(simulation.state.joints.gamma, wanted)

    yield Case(
        "viscous friction of 1e5 N m s/rad",
        "springs creep: angles decay by exp(-k t / c), inertia counts by M k / c^2 = 1e-8 of it",
        lambda: sprung(500.0, 1e5),
        REST,
        10,
        100_000_000,
        creeping,
        1e-8,
    )
    for damping in (1e3, 1e4):
        yield Case(
            f"PD gains of 1e6 N m/rad and {damping:g} N m s/rad",
            "at its set point after more than 25 time constants",
            lambda d=damping: sprung(1e6, d),  # type: ignore[misc]
            REST,
            3,
            100_000_000,
            lambda simulation: math.dist(simulation.state.joints.gamma, rests),
            1e-10,
        )
    yield Case(
        "elastic stops of 1e8 N m/rad",
        "as at 1e9 N m/rad, but for the contact of pi sqrt(m / k) = 2e-4 s; energy kept",
        lambda: extremes.bouncing(Stroke(at_end="elastic", stiffness=1e8)),
        REST,
        30,
        10_000_000,
        extremes.from_stiffer_bounce,
        1e-6,
    )
