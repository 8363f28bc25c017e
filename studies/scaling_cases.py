# SPDX-License-Identifier: Apache-2.0
"""Extreme cases whose truth is a scaling law, a state of rest, or a closed form.

Without friction and springs a motion under torques tau from rates v takes place s times slower
under tau / s^2 from v / s, and is the same for inertias and torques times a. Gravity is absent.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from sst_ros.scene.bodies import Inertia, Link
from sst_ros.scene.loads import Friction, Initial, JointFriction, Spring, Stroke
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import Simulation
from studies import extreme_scenes as extremes
from studies.extreme_cases import Case
from studies.extreme_scenes import REST, Triple
from studies.model_errors import scaled

RIGHT = math.pi / 2
MS = 1_000_000


def pushed(scale: float) -> Triple:
    """Return the torques of the reference motion times `scale` [N m]."""
    a, b, c = extremes.PUSH
    return (a * scale, b * scale, c * scale)


def scaled_times() -> Iterator[Case]:
    """Yield motions at another speed."""
    for scale in (1e-6, 1e-4, 1e-3, 1e-2, 1e-1, 1e1, 1e2, 1e3, 1e4):
        yield Case(
            f"time x {scale:g}",
            "the end of the same motion at its own speed, by the scaling law",
            partial(extremes.spun, 2.0 / scale), pushed(scale**-2), 20, round(10 * MS * scale),
            extremes.from_reference, 1e-9,
        )  # fmt: skip


def scaled_inertias() -> Iterator[Case]:
    """Yield motions with other inertias."""
    for scale in (1e-12, 1e-6, 1e6, 1e9):
        yield Case(
            f"inertia x {scale:g}", "the same motion, under torques scaled alike",
            partial(extremes.with_inertias, scale, scale), pushed(scale), 20, 10 * MS,
            extremes.from_reference, 1e-12,
        )  # fmt: skip
    for scale in (1e-9, 1e9):
        yield Case(
            f"star's inertia x {scale:g} beside the same links", "energy is kept",
            partial(extremes.with_inertias, scale, 1.0), REST, 10, 10 * MS,
            extremes.energy_drift, 1e-9,
        )  # fmt: skip


def ratios() -> Iterator[Case]:
    """Yield extreme ratios of inertias."""
    for star, links in ((1e9, 1e-9), (1e-9, 1e9)):
        yield Case(
            f"star x {star:g} with links x {links:g}",
            "energy is constant",
            partial(extremes.with_inertias, star, links),
            REST, 10, 10_000_000, extremes.energy_drift, 1e-8,
            difficulty="inertias 1e18 apart in one mass matrix",
        )  # fmt: skip
    for scale in (1.0, 1e-12):

        def bare(a: float = scale) -> Scene:
            scene, links = extremes.spun(2.0), (Link(), Link(), Link())
            inertia = scaled(Inertia(xx=0.39, yy=0.39, zz=0.26), a)
            return replace(scene, star=replace(scene.star, inertia=inertia),
                           actuated_links=links, intermediate_links=links)  # fmt: skip

        yield Case(
            f"star x {scale:g} beside massless links",
            "energy is constant",
            bare, REST, 20, 10_000_000, extremes.energy_drift, 1e-9,
            difficulty="the star is all that has inertia",
        )  # fmt: skip


def violent() -> Iterator[Case]:
    """Yield torques and spins beyond all measure."""
    for name, scene, refusal in (
        ("against an end of the stroke", extremes.base, "StrokeExceeded"),
        ("into a serial singularity", extremes.free, "SingularityReached"),
    ):
        yield Case(
            f"torque of 1e8 N m {name}", "the same end, sqrt(1e8) times earlier than under 1 N m",
            scene, (1e8, 0.0, 0.0), 10, 100_000, refusal=refusal,
            stop_time=lambda s=scene: 1e-4 * extremes.stop_time(s(), (1.0, 0.0, 0.0)),  # type: ignore[misc]
        )  # fmt: skip
    for rate in (1e4, 1e6):
        yield Case(
            f"spin of {rate:g} rad/s", "without torque the path does not depend on the rate",
            partial(extremes.spun, rate), REST, 10, round(0.4e8 / rate),
            lambda simulation: extremes.apart(simulation, extremes.turned()), 1e-7,
        )  # fmt: skip


def starts() -> Iterator[Case]:
    """Yield starts at limits of the joints."""

    def at(gamma: Triple) -> Scene:
        return replace(extremes.base(), initial=Initial(gamma=gamma))

    for gamma in (REST, (0.0, 0.5, 0.5), (RIGHT, RIGHT, RIGHT), (0.7, 0.7, 0.0)):
        yield Case(
            f"start at a corner of the strokes, {gamma[0]:.3g} {gamma[1]:.3g} {gamma[2]:.3g}",
            "rest stays rest", partial(at, gamma), REST, 10, MS,
            lambda simulation, g=gamma: math.dist(simulation.state.joints.gamma, g),  # type: ignore[misc]
            1e-12,
        )  # fmt: skip
    yield Case(
        "pushed outwards at an end of the stroke", "the run ends where it starts",
        partial(at, (0.0, 0.5, 0.5)), (-1.0, 0.0, 0.0), 1, MS, refusal="StrokeExceeded",
        stop_time=lambda: 0.0,
    )  # fmt: skip
    yield Case(
        "start at a corner that cannot be assembled", "refused by name",
        partial(at, (0.0, RIGHT, 0.7)), REST, 1, MS, refusal="NoAdmissibleAssembly",
    )  # fmt: skip


def stiff() -> Iterator[Case]:
    """Yield stiff loads."""
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
        partial(sprung, 500.0, 1e5), REST, 10, 100 * MS, creeping, 1e-8,
    )  # fmt: skip
    for damping in (1e3, 1e4):
        yield Case(
            f"PD gains of 1e6 N m/rad and {damping:g} N m s/rad",
            "at its set point after more than 25 time constants",
            partial(sprung, 1e6, damping), REST, 3, 100 * MS,
            lambda simulation: math.dist(simulation.state.joints.gamma, rests), 1e-10,
        )  # fmt: skip
    yield Case(
        "elastic stops of 1e8 N m/rad",
        "as at 1e9 N m/rad, but for the contact of pi sqrt(m / k) = 2e-4 s; energy kept",
        partial(extremes.bouncing, Stroke(at_end="elastic", stiffness=1e8)), REST, 30, 10 * MS,
        extremes.from_stiffer_bounce, 1e-6,
    )  # fmt: skip
