# SPDX-License-Identifier: Apache-2.0
"""A design study: arcs, star angles and size.

Designs are compared by workspace, dexterity, torque and accuracy. What no other design
betters in workspace, torque and accuracy at once is the Pareto front.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache

import numpy as np
from matplotlib.figure import Figure
from pandas import DataFrame
from scipy.constants import g as G_0
from scipy.stats import qmc

from sst_ros.control.plan import check_motion, examine_reactions
from sst_ros.control.reference_motions import reference_motion
from sst_ros.dynamics import kernel
from sst_ros.errors import SstError
from sst_ros.figures import BLUE, GREY, VERMILION, styled
from sst_ros.mechanism import kinematics, rates, workspace
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of, rotation_matrix
from sst_ros.report.results import publish, render
from sst_ros.scene.bodies import Inertia, Link, arc_inertia
from sst_ros.scene.scene import Scene, load
from sst_ros.state import ZERO
from studies import DOCS, PAGES, run

COUNT = 1024  # a power of two
LOW = (70.0, 70.0, 70.0, 100.0, 100.0, 0.7)
HIGH = (110.0, 110.0, 110.0, 140.0, 140.0, 1.4)
"""Arcs [deg], first two star angles [deg], and size over that of the shipped scene."""
SHIPPED = load("gravity_payload")
ORIENTATIONS = 2**16  # evenly over all, for integrals over the workspace
MOTION = {"spiral": {"phi": 0.25, "theta": 6.0, "psi": 0.2, "duration": 1.0}}  # rad, s
PAYLOAD = 0.8  # kg, at E
PART_ERROR = 5e-5  # standard deviation of places of parts on the spheres [m]
ENCODER_ERROR = np.radians(0.005)  # standard deviation [rad]
PERCENTILE = 95.0  # of torques at rest, which grow without bound in the corners
SHOWN = 10  # designs of the front on the page


@dataclass(frozen=True)
class Design:
    """Numbers of a design."""

    arc_12: float  # deg
    arc_23: float
    arc_31: float
    alpha_1: float  # deg
    alpha_2: float
    size: float  # of the radii over those of the shipped scene

    def scene(self) -> Scene:
        """Make the manipulator of thin arcs whose mass grows with their length."""
        arcs = [self.arc_12, self.arc_23, self.arc_31]
        alpha = [self.alpha_1, self.alpha_2, 360.0 - self.alpha_1 - self.alpha_2]
        radius = self.size * SHIPPED.star.radius
        turns = np.cumsum([0.0, *np.radians(alpha[:2])])
        ends = np.stack([np.cos(turns), np.sin(turns), np.zeros(3)], axis=1)
        middles = 2.0 * radius / np.pi * np.add(ends, [0.0, 0.0, 1.0])
        mass = self.size * SHIPPED.star.mass
        inertias = [arc_inertia(mass / 3.0, radius, [0, 0, 1], end) for end in ends]
        base = {"arcs_deg": arcs, "radius": self.size * SHIPPED.base.radius}
        shape = SHIPPED.with_values({"base": base})
        axis = Geometry.of(shape).v.sum(axis=0)  # of the base triangle
        down = -G_0 * axis / np.linalg.norm(axis)
        actuated_link = SHIPPED.actuated_links[0]
        intermediate_link = SHIPPED.intermediate_links[0]
        return shape.with_values(
            {
                "star.alpha_deg": alpha,
                "star.radius": radius,
                "star.mass": mass,
                "star.centre": middles.mean(axis=0).tolist(),
                "star.inertia": add_inertias(inertias),
                "actuated_links": [scale_link(actuated_link, self.size, self.size)],
                "intermediate_links": [scale_link(intermediate_link, self.size, 1.0)],
                "payload": {"mass": PAYLOAD, "centre": [0.0, 0.0, radius]},
                "gravity.acceleration": down.tolist(),
                "springs": None,
                "initial": {"gamma": (np.radians(arcs) / 2.0).tolist()},
                "motion": MOTION,
            }
        )


@dataclass(frozen=True)
class Indices:
    """What a design achieves."""

    workspace: float  # share of all orientations [%]
    conditioning: float  # global conditioning index
    static_torque: float  # N m
    peak_torque: float  # N m
    peak_bending: float  # N m, in the joints of the star
    error: float  # root mean square of the orientation error [mrad]


def add_inertias(parts: Sequence[Inertia]) -> dict[str, float]:
    """Return the entries of the sum of inertias [kg m^2]."""
    return {name: sum(getattr(x, name) for x in parts) for name in Inertia.SPECS}


def scale_link(link: Link, size: float, mass: float) -> dict[str, object]:
    """Return a link of `size` times the lengths and `mass` times the mass."""
    inertia = {
        name: mass * size**2 * getattr(link.inertia, name) for name in Inertia.SPECS
    }
    centre = [size * place for place in link.centre]
    return {"inertia": inertia, "mass": mass * link.mass, "centre": centre}


def draw_designs(count: int = COUNT) -> list[Design]:
    """Draw designs: first the isotropic one, then Sobol points of the range."""
    sampler = qmc.Sobol(len(LOW), seed=np.random.default_rng(1))
    points = qmc.scale(sampler.random(count), LOW, HIGH)
    isotropic = Design(90.0, 90.0, 90.0, 120.0, 120.0, 1.0)
    return [isotropic, *(Design(*point) for point in points.tolist())]


@cache
def all_orientations() -> Array:
    """Return rotations evenly over all (Shoemake 1992), shape (n, 3, 3)."""
    height, first, second = qmc.Sobol(3, seed=2).random(ORIENTATIONS).T
    inner = np.sqrt(1.0 - height) * np.exp(2j * np.pi * first)
    outer = np.sqrt(height) * np.exp(2j * np.pi * second)
    quaternions = np.stack([inner.real, inner.imag, outer.real, outer.imag], axis=1)
    return rotation_matrix(quaternions)


def evaluate(design: Design) -> Indices | None:
    """Measure a design; None where it cannot do the motion."""
    try:
        scene = design.scene()
        plan = check_motion(reference_motion(scene), scene)
    except SstError:
        return None
    peak_torque = max(abs(peak.value) for peak in plan.peaks["torque"])
    bending = examine_reactions(plan)["prismatic"]["bending_moment"].peak.max()
    geometry = Geometry.of(scene)
    rotation = all_orientations()
    # An admissible E lies on the base triangle.
    rotation = rotation[np.all(rotation[:, :, 2] @ geometry.w.T > 0.0, axis=1)]
    gamma = kinematics.inverse(geometry, rotation)[0]
    measured = workspace.measures(geometry, gamma, rotation)
    poses = rotation[measured.admissible]
    quaternion = tuple(quaternion_of(poses).T)
    model = kernel.model_of(scene)
    with np.errstate(all="ignore"):
        weight_torque, _ = kernel.actuator_torque(model, quaternion, ZERO, ZERO)
    error = orientation_error(design, geometry, poses)
    static_torque = np.percentile(np.abs(weight_torque).max(axis=0), PERCENTILE)
    return Indices(
        workspace=100.0 * len(poses) / ORIENTATIONS,
        conditioning=float((1.0 / measured.cond_j[measured.admissible]).mean()),
        static_torque=float(static_torque),
        peak_torque=peak_torque,
        peak_bending=float(bending),
        error=1e3 * float(np.sqrt(np.mean(error**2))),
    )


def orientation_error(design: Design, geometry: Geometry, poses: Array) -> Array:
    """Return the standard deviation [rad] of orientations by tolerances.

    Orientations have the shape (n, 3, 3), the result (n,).
    """
    by = rates.orientation_sensitivity(geometry, poses)
    on_base = PART_ERROR / (SHIPPED.base.radius * design.size)
    on_star = PART_ERROR / (SHIPPED.star.radius * design.size)
    variance = ENCODER_ERROR**2 * np.sum(by.gamma**2, axis=(1, 2))
    # v moves across itself: what is along it changes no direction.
    variance += on_base**2 * np.sum(by.v**2, axis=(1, 2, 3))
    variance += on_star**2 * np.sum(by.alpha[..., :2] ** 2, axis=(1, 2))
    return np.asarray(np.sqrt(variance))


def find_front(costs: Array) -> Array:
    """Rows, shape (n,), that no other row betters in every cost, of costs (n, k)."""
    better = np.all(costs[:, None] <= costs[None], axis=2)
    better &= np.any(costs[:, None] < costs[None], axis=2)
    return np.asarray(~better.any(axis=0))


def isotropy() -> dict[float, float]:
    """Return 1/cond(J) in the middle of symmetric designs, by their arcs [deg]."""
    indices = {}
    for arc in np.arange(60.0, 115.0, 5.0).tolist():
        geometry = Geometry.of(Design(arc, arc, arc, 120.0, 120.0, 1.0).scene())
        gamma = geometry.arc / 2.0
        rotation = kinematics.admissible(geometry, gamma).rotation
        indices[arc] = 1.0 / float(workspace.measures(geometry, gamma, rotation).cond_j)
    return indices


@styled
def draw(frame: DataFrame) -> Figure:
    """Draw error and workspace of the designs over the peak torque."""
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    looks = (
        ("design", frame, ".", GREY, 4),
        ("on the front", frame[frame["front"]], "o", BLUE, 4),
        ("isotropic, shipped size", frame[:1], "*", VERMILION, 14),
    )
    for axes, name in (left, "error"), (right, "workspace"):
        for label, rows, marker, colour, size in looks:
            axes.plot(
                "peak_torque", name, marker, data=rows, c=colour, ms=size, label=label
            )
        axes.set_xlabel("peak torque of the motion [N m]")
        axes.legend(fontsize=8)
    left.set_ylabel("orientation error (RMS) [mrad]")
    right.set_ylabel("orientations reached [%]")
    return figure


def report(options: argparse.Namespace) -> bool:
    """Write page, table and picture; true where front and isotropy are found."""
    rows = []
    for design in draw_designs():
        indices = evaluate(design)
        if indices is not None:
            rows.append(asdict(design) | asdict(indices))
    frame = DataFrame(rows)
    costs = [-frame["workspace"], frame["peak_torque"], frame["error"]]
    frame["front"] = find_front(np.stack(costs, axis=1))
    front = frame[frame["front"]].sort_values("peak_torque")
    chosen = np.unique(np.linspace(0, len(front) - 1, SHOWN).astype(int))
    symmetric = isotropy()
    page = render(
        PAGES / "design.md",
        frame=frame,
        front=front,
        shown=front.iloc[chosen].drop(columns="front").map("{:.3g}".format),
        symmetric=symmetric,
        study=globals(),
    )
    publish(options.out, "design", {".csv": frame, ".md": page, ".png": draw(frame)})
    return len(front) > 0 and max(symmetric, key=symmetric.__getitem__) == 90.0


if __name__ == "__main__":
    raise SystemExit(run(report, "design", DOCS, None))
