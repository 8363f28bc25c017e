# SPDX-License-Identifier: Apache-2.0
"""Random manipulators and states for the tests, from plain numbers in [-1, 1].

Hypothesis and seeded generators draw the same 64 numbers; all zeros is the isotropic
design at home with plain inertias, so counterexamples shrink towards it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from hypothesis import HealthCheck, assume, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sst_ros.dynamics import kernel
from sst_ros.mechanism import kinematics, virtual_work, workspace
from sst_ros.mechanism.geometry import Geometry, quaternion_of
from sst_ros.scene.bodies import Base, Inertia, Link, Star
from sst_ros.scene.loads import Initial
from sst_ros.scene.scene import Scene, load
from sst_ros.state import Assembly

COUNT = 64
FAST = settings(
    max_examples=60,
    derandomize=True,
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],
)


@dataclass(frozen=True)
class Sample:
    """A manipulator in a regular admissible state, with torques and moment in {B}."""

    scene: Scene
    geometry: Geometry
    rotation: np.ndarray
    gamma: np.ndarray
    gamma_dot: np.ndarray
    torque: np.ndarray
    moment: np.ndarray

    @property
    def posture(self) -> virtual_work.Posture:
        return virtual_work.posture(self.geometry, self.gamma, self.rotation)

    @property
    def mechanism(self) -> virtual_work.Mechanism:
        return virtual_work.Mechanism.of(self.scene)

    @property
    def model(self) -> kernel.Model:
        return kernel.model_of(self.scene)

    @property
    def quaternion(self) -> tuple[float, ...]:
        return tuple(quaternion_of(self.rotation).tolist())

    @property
    def body_rate(self) -> tuple[float, ...]:
        """W in {E}, through the paper's J (Eq. 15)."""
        return tuple((self.rotation.T @ self.posture.j @ self.gamma_dot).tolist())

    @property
    def state(self) -> tuple[float, ...]:
        return (*self.quaternion, *self.body_rate)

    def gamma_ddot_of(self, body_acceleration) -> np.ndarray:
        """Go back from W_dot by the paper: gamma_ddot = J^-1 (omega_dot - its bias)."""
        at = self.posture
        omega_dot = self.rotation @ np.array(body_acceleration)
        bias = virtual_work.bias(at, self.gamma_dot).omega_dot
        return np.linalg.solve(at.j, omega_dot - bias)


def scene_of(v, alpha_deg, star, actuated, intermediate, **rest) -> Scene:
    """Build a scene from plain arrays."""
    rest.setdefault("initial", Initial(gamma=(np.pi / 4,) * 3))
    return Scene(
        name="random",
        description="made by a test",
        base=Base(v=v, radius=0.35),
        star=Star(alpha_deg=alpha_deg, radius=0.4, inertia=inertia_of(star)),
        actuated_links=tuple(Link(inertia=inertia_of(matrix)) for matrix in actuated),
        intermediate_links=tuple(
            Link(inertia=inertia_of(matrix)) for matrix in intermediate
        ),
        **rest,
    )


def inertia_of(matrix) -> Inertia:
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = np.asarray(matrix).tolist()
    return Inertia(xx=xx, yy=yy, zz=zz, xy=xy, xz=xz, yz=yz)


def rigid_body(numbers, size: float) -> np.ndarray:
    """Inertia of a body with positive second moments of mass: positive definite,
    triangle kept.
    """
    x, y, z = size * (1.1 + np.asarray(numbers[:3]))
    turn = Rotation.from_rotvec(2.0 * np.asarray(numbers[3:])).as_matrix()
    tensor = turn @ np.diag([y + z, x + z, x + y]) @ turn.T
    return (tensor + tensor.T) / 2.0


def assembly_of(geometry: Geometry, gamma, rotation) -> Assembly:
    """Describe the assembly R at actuator angles gamma; R closes the loops."""
    r = kinematics.carriage_directions(geometry, gamma)
    mu, beta, det_j2, admissible = kinematics.describe_assemblies(
        geometry, r, np.asarray(rotation)
    )
    return Assembly(rotation, mu, beta, float(det_j2), bool(admissible))


def star_orientation(geometry: Geometry, numbers) -> np.ndarray:
    """R with E inside the base triangle.

    At zeros E is at the centre and mu_1 = 90 deg.
    """
    s = (1.2 + np.asarray(numbers[:3])) @ geometry.v
    s /= np.linalg.norm(s)
    t = np.cross(geometry.w[0], s)
    t /= np.linalg.norm(t)
    turn = Rotation.from_rotvec(0.9 * numbers[3] * s).as_matrix()
    t = turn @ t
    return np.stack([np.cross(t, s), t, s], axis=1)


def sample_of(numbers, isotropic: bool = False) -> Sample | None:
    """Turn 64 numbers in [-1, 1] into a sample.

    None where the state is near a singularity.
    """
    x = np.asarray(numbers, dtype=float)
    v, alpha = np.eye(3), np.full(3, 120.0)
    if not isotropic:
        v = v + 0.35 * x[:9].reshape(3, 3)
        alpha[:2] += 40.0 * x[9:11]
        alpha[2] = 360.0 - alpha[0] - alpha[1]
        lengths = np.linalg.norm(v, axis=1)
        if np.linalg.det(v / lengths[:, None]) < 0.1:
            return None
    bodies = [rigid_body(x[i:j], 0.1) for i, j in pairwise(range(11, 54, 6))]
    scene = scene_of(v, alpha, bodies[0], bodies[1:4], bodies[4:7])
    geometry = Geometry.of(scene)
    rotation = star_orientation(geometry, x[53:57])
    gamma, mu, beta = kinematics.inverse(geometry, rotation)
    assembly = assembly_of(geometry, gamma, rotation)
    regular = (
        np.sin(mu).min() > 0.2 and abs(assembly.det_j2) > 0.05 and beta.max() < 1.5
    )
    if not (regular and assembly.admissible):
        return None
    return Sample(
        scene, geometry, rotation, gamma, 4 * x[57:60], 5 * x[58:61], 2 * x[61:64]
    )


def seeded_samples(seed: int, count: int, isotropic: bool = False) -> list[Sample]:
    """The first `count` samples of a generator."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        sample = sample_of(rng.uniform(-1.0, 1.0, COUNT), isotropic)
        if sample is not None:
            found.append(sample)
    return found


def agree(ours, truth, scale=None):
    """Agree to 1e-12 of the largest part of the truth, or of a scale."""
    truth = np.array(truth, dtype=float)
    scale = np.abs(truth).max() if scale is None else scale
    assert np.abs(np.asarray(ours) - truth).max() <= 1e-12 * scale


@st.composite
def samples(draw) -> Sample:
    """Regular admissible states of general and isotropic manipulators."""
    numbers = draw(st.lists(st.floats(-1.0, 1.0), min_size=COUNT, max_size=COUNT))
    sample = sample_of(numbers, isotropic=draw(st.booleans()))
    assume(sample is not None)
    return sample


def folding_star() -> tuple[Scene, np.ndarray]:
    """Example 1 with a star that folds, and R at its parallel singularities, shape (n,
    3, 3).
    """
    scene = load("example1")
    scene = replace(scene, star=replace(scene.star, alpha_deg=(210.0, 75.0, 75.0)))
    geometry = Geometry.of(scene)
    s, _ = workspace.triangle_directions(geometry, 6)
    grid = workspace.over_orientations(geometry, s, 36)
    return scene, workspace.parallel_singularities(grid).rotation
