# SPDX-License-Identifier: Apache-2.0
"""Extreme cases of geometry: singularities, edges of the workspace, poles, small triangles.

At a parallel singularity (det J2 = 0) gamma does not determine the pose, but the motion is regular
in orientation and body rate: the energy residual shows whether it is passed correctly. Where a
case has no loads, its energy is constant.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.mechanism import kinematics, singularities, workspace
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.bodies import Inertia
from sst_ros.scene.loads import Initial, Workspace
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import Simulation
from studies import extreme_scenes as extremes
from studies.extreme_cases import Case

REST = extremes.REST
POSE = (0.7, 0.8, 0.75)


def singular_scene() -> Scene:
    """Return a scene with parallel singularities inside its workspace, limits ignored."""
    scene = extremes.free()
    return replace(scene, star=replace(scene.star, alpha_deg=(210, 75, 75)))


@lru_cache(maxsize=1)
def singular_pose() -> Array:
    """Return a rotation R with det J2 = 0, shape (3, 3)."""
    geometry = Geometry.of(singular_scene())
    chart = workspace.over_orientations(geometry, workspace.triangle_directions(geometry, 12)[0])
    poses = singularities.parallel(chart)
    return np.asarray(poses.rotation[len(poses) // 2])


def near_singularity(angle: float, spin: float) -> Scene:
    """Start `angle` [rad] about OE from a singular pose, with that spin about OE [rad/s]."""
    scene, (c, s) = singular_scene(), (math.cos(angle), math.sin(angle))
    rotation = singular_pose() @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    gamma, _, _ = kinematics.inverse(Geometry.of(scene), rotation)
    x, y, z, w = quaternion_of(rotation).tolist()
    rates = kernel.joints(kernel.model_of(scene), (x, y, z, w, 0.0, 0.0, spin)).gamma_dot
    a, b, c = gamma.tolist()
    p, q, r = (float(rate) for rate in rates)
    initial = Initial(gamma=(a, b, c), gamma_dot=(p, q, r), orientation=(x, y, z, w))
    return replace(scene, initial=initial)


def parallel_singularities() -> Iterator[Case]:
    """Yield passages of a parallel singularity, and rest beside one."""

    def crossed(simulation: Simulation) -> float:
        start = Simulation(simulation.scene).conditioning["det_j2"]
        if start * simulation.conditioning["det_j2"] >= 0.0:
            return math.inf  # it was not crossed
        return extremes.energy_drift(simulation)

    for spin in (0.5, -0.5, 2.0, -2.0, 20.0, -20.0):
        angle = math.copysign(0.08, -spin)
        yield Case(
            f"crossed at {spin:g} rad/s",
            "det J2 changes its sign and the energy stays",
            partial(near_singularity, angle, spin),
            REST, 80, round(2e6 / abs(spin)), crossed, 1e-10,
            difficulty="J is infinite at the crossing; gamma alone does not determine the motion",
        )  # fmt: skip
    yield Case(
        "rest 0.1 rad beside one",
        "rest stays rest",
        partial(near_singularity, 1e-1, 0.0),
        REST, 10, 1_000_000, lambda simulation: math.hypot(*simulation.state.body_rate), 1e-12,
        difficulty="a second assembly mode lies close by",
    )  # fmt: skip
    yield Case(
        "rest 0.01 rad beside one",
        "refused by name: gamma has two admissible assemblies there",
        partial(near_singularity, 1e-2, 0.0),
        REST, 1, 1_000_000, refusal="AmbiguousAssembly",
        difficulty="two assembly modes meet at a parallel singularity",
    )  # fmt: skip


def _edge_pose(beta: float) -> Scene:
    """Start where E has the angular distance beta [rad] from the arc P1 P2, to first order."""
    geometry = Geometry.of(extremes.base())
    chart = workspace.over_orientations(geometry, [[1.0, 0.9, 1e-3]], turns=60)
    psi = chart.psi[np.flatnonzero(chart.measures.admissible[0])[0]]

    def gamma_beta(height: float) -> tuple[Array, float]:
        s = np.array([1.0, 0.9, height])
        rotation = workspace.orientations(s[None] / np.linalg.norm(s), np.array([psi]))[0]
        gamma, _, found = kinematics.inverse(geometry, rotation)
        return gamma, float(found[0])

    slope = gamma_beta(1e-6)[1] / 1e-6
    a, b, c = gamma_beta(beta / slope)[0].tolist()
    return replace(extremes.base(), initial=Initial(gamma=(a, b, c)))


def edges() -> Iterator[Case]:
    """Yield starts at edges of the workspace."""
    for beta in (1e-3, 1e-6, 1e-9):
        yield Case(
            f"start at beta_1 = {beta:g} rad, inside",
            "rest stays rest, at that beta_1",
            partial(_edge_pose, beta),
            REST, 5, 1_000_000,
            lambda simulation, b=beta: abs(simulation.state.joints.beta[0] / b - 1.0),  # type: ignore[misc]
            1e-5, difficulty="det J1 tends to 0 with beta",
        )  # fmt: skip
        yield Case(
            f"start at beta_1 = {-beta:g} rad, outside",
            "refused by name",
            partial(_edge_pose, -beta),
            REST, 1, 1_000_000, refusal="NoAdmissibleAssembly",
            difficulty="the same pose as inside, to nine digits",
        )  # fmt: skip
    beta = max(Simulation(replace(extremes.base(), initial=Initial(gamma=POSE))).state.joints.beta)
    for off in (1e-9, -1e-9):
        limit = Workspace(beta_max_deg=math.degrees(beta + off))
        inside = off > 0.0
        yield Case(
            f"start {abs(off):g} rad {'inside' if inside else 'outside'} the largest beta",
            "rest stays rest" if inside else "refused by name",
            partial(replace, extremes.base(), initial=Initial(gamma=POSE), workspace=limit),
            REST, 5, 1_000_000,
            (lambda simulation: math.hypot(*simulation.state.body_rate)) if inside else None,
            1e-12 if inside else 0.0, "" if inside else "NoAdmissibleAssembly",
            difficulty="rounding must not decide on which side a pose lies",
        )  # fmt: skip


def _at_the_pole(rate: tuple[float, float, float]) -> Scene:
    """Rotate the base so that its centre, where E starts, is the z axis of {B}: phi = 0."""
    scene, third = extremes.free(), math.sqrt(1.0 / 3.0)
    x = np.array([1.0, -1.0, 0.0]) / math.sqrt(2.0)
    z = np.full(3, third)
    turn = np.stack([x, np.cross(z, x), z])
    v = tuple((float(a), float(b), float(c)) for a, b, c in (turn @ np.array(scene.base.v).T).T)
    quarter = math.pi / 4
    initial = Initial(gamma=(quarter, quarter, quarter), gamma_dot=rate)
    return replace(scene, base=replace(scene.base, v=(v[0], v[1], v[2])), initial=initial)


def _small(spread: float) -> Scene:
    """Return a base triangle whose corners are `spread` [rad] from its centre."""
    scene, centre = extremes.free(), np.full(3, math.sqrt(1.0 / 3.0))
    v = []
    for corner in np.eye(3):
        away = corner - centre * (centre @ corner)
        p = centre * math.cos(spread) + away / np.linalg.norm(away) * math.sin(spread)
        v.append((float(p[0]), float(p[1]), float(p[2])))
    scene = replace(scene, base=replace(scene.base, v=(v[0], v[1], v[2])), initial=Initial(
        gamma=(0.5 * spread, 0.5 * spread, 0.5 * spread)))  # fmt: skip
    a = 0.5 * float(Geometry.of(scene).arc[0])
    initial = Initial(gamma=(a, a, a), gamma_dot=(0.1 * a, 0.2 * a, -0.1 * a))
    return replace(scene, initial=initial)


def _one_short_arc(degrees: float) -> Scene:
    """Return a base of whose three arcs one is that short; the others are a right angle."""
    angle = math.radians(degrees)
    v = ((1.0, 0.0, 0.0), (math.cos(angle), math.sin(angle), 0.0), (0.0, 0.0, 1.0))
    scene = extremes.free()
    arcs = [float(a) for a in Geometry.of(replace(scene, base=replace(scene.base, v=v))).arc]
    a, b, c = (0.5 * arc for arc in arcs)
    initial = Initial(gamma=(a, b, c), gamma_dot=(0.1 * a, 0.2 * b, -0.1 * c))
    return replace(scene, base=replace(scene.base, v=v), initial=initial)


def _with_star(inertia: Inertia) -> Scene:
    scene = extremes.spun(2.0)
    return replace(scene, star=replace(scene.star, inertia=inertia))


def shapes() -> Iterator[Case]:
    """Yield poles and unusual shapes."""
    for rate in ((1.0, 1.0, 1.0), (1.0, -0.5, 0.25)):

        def unturned(simulation: Simulation, rate: tuple[float, float, float] = rate) -> float:
            quarter = math.pi / 4
            initial = Initial(gamma=(quarter, quarter, quarter), gamma_dot=rate)
            other = Simulation(replace(extremes.free(), initial=initial), tolerance=1e-13)
            for _ in range(20):
                other.step(REST, 10_000_000)
            return math.dist(simulation.state.joints.gamma, other.state.joints.gamma)

        at = "turning at" if rate[0] == rate[1] else "moving through"
        yield Case(
            f"{at} the Euler pole phi = 0",
            "gamma as with the base in another orientation: without gravity it does not matter",
            partial(_at_the_pole, rate),
            REST, 20, 10_000_000, unturned, 1e-9,
            difficulty="ZYZ angles are not unique there; the state is a quaternion",
        )  # fmt: skip
    for spread in (1e-1, 1e-2, 1e-3):
        yield Case(
            f"base triangle of {spread:g} rad",
            "energy is constant",
            partial(_small, spread),
            REST, 20, 10_000_000, extremes.energy_drift, 1e-9,
            difficulty="the axes of the actuators are nearly parallel planes",
        )  # fmt: skip
    yield Case(
        "base triangle of 1e-06 rad", "refused: triangle too small",
        partial(_small, 1e-6), REST, 1, 1_000_000, refusal="InputError",
        difficulty="rounding of the corners is a part in 1e10 of it",
    )  # fmt: skip
    yield Case(
        "three arcs of which one is 1 deg", "energy is constant",
        partial(_one_short_arc, 1.0), REST, 20, 10_000_000, extremes.energy_drift, 1e-9,
        difficulty="two actuators nearly share an axis",
    )  # fmt: skip
    for needle in (1e-3, 1e-6, 1e-9):
        yield Case(
            f"needle star, inertia ({needle:g}, 1, 1)",
            "energy is constant",
            partial(_with_star, Inertia(xx=needle, yy=1.0, zz=1.0)),
            REST, 20, 10_000_000, extremes.energy_drift, 1e-9,
            difficulty="one principal inertia is next to nothing",
        )  # fmt: skip
