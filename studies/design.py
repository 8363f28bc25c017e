# SPDX-License-Identifier: Apache-2.0
"""A design study: arcs, star angles and size.

Designs are compared by workspace, dexterity, torque and accuracy. What no other design
betters in workspace, torque and accuracy at once is the Pareto front.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import qmc

from sst_ros.control.reference_motions import reference_motion
from sst_ros.dynamics import kernel
from sst_ros.dynamics.reactions import reactions_of
from sst_ros.errors import SstError
from sst_ros.figures import BLUE, GREY, VERMILION, styled
from sst_ros.mechanism import kinematics, rates, workspace
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of, rotation_matrix
from sst_ros.report.results import data_frame, publish, render
from sst_ros.scene.bodies import Inertia, arc_inertia
from sst_ros.scene.scene import Scene, load
from sst_ros.state import ZERO
from studies import DOCS, PAGES, run

if TYPE_CHECKING:
    from pandas import DataFrame

COUNT = 1024  # a power of two
LOW = (70.0, 70.0, 70.0, 100.0, 100.0, 0.7)
HIGH = (110.0, 110.0, 110.0, 140.0, 140.0, 1.4)
"""Arcs [deg], first two star angles [deg], and size over that of the shipped scene."""
DIVISIONS, TURNS = 14, 48  # of the map of a workspace
SAMPLES = 201  # of the motion
# kg/m: the printed mass on three arcs of 90 deg
STAR_DENSITY = 2.6 / (3 * 0.4 * np.pi / 2)
LINK_DENSITY = 0.3 / (0.35 * np.pi / 2)
SLIDER, PAYLOAD = 0.06, 0.8  # kg
MOTION = {"spiral": {"phi": 0.25, "theta": 6.0, "psi": 0.2, "duration": 1.0}}  # rad, s
# standard deviation of places on the spheres, of parts and assembly [m]
PART_ERROR = 5e-5
ENCODER_ERROR = np.radians(0.005)  # standard deviation [rad]
# of torques at rest: in the corners of the workspace they grow without bound
PERCENTILE = 95.0


@dataclass(frozen=True)
class Design:
    """Numbers of a design."""

    arc_12: float  # deg
    arc_23: float
    arc_31: float
    alpha_1: float  # deg
    alpha_2: float
    size: float  # of the radii over 0.35 m and 0.4 m

    def scene(self) -> Scene:
        """Make the manipulator of thin arcs whose mass grows with their length."""
        base, star = 0.35 * self.size, 0.4 * self.size
        turns = np.radians([0.0, self.alpha_1, self.alpha_1 + self.alpha_2])
        ends = np.stack([np.cos(turns), np.sin(turns), np.zeros(3)], axis=1)
        mass = STAR_DENSITY * star * np.pi / 2
        tensor = np.sum(
            [arc_inertia(mass, star, [0, 0, 1], end).matrix for end in ends], axis=0
        )
        middle = np.add(ends, [0.0, 0.0, 1.0]).mean(axis=0) * 2.0 * star / np.pi
        link = LINK_DENSITY * base * np.pi / 2
        centre = 2.0 * base / np.pi
        slider, own = SLIDER * star**2, 9e-6 * self.size**2
        arcs = [self.arc_12, self.arc_23, self.arc_31]
        alpha = [self.alpha_1, self.alpha_2, 360.0 - self.alpha_1 - self.alpha_2]
        shape = load("gravity_payload").with_values(
            {"base": {"arcs_deg": arcs, "radius": base}}
        )
        middle_of_base = Geometry.of(shape).v.sum(axis=0)
        down = -9.80665 * middle_of_base / np.linalg.norm(middle_of_base)
        return shape.with_values(
            {
                "name": "design",
                "gravity.acceleration": down.tolist(),
                "star": {
                    "alpha_deg": alpha,
                    "radius": star,
                    "inertia": _inertia(tensor),
                    "mass": 3.0 * mass,
                    "centre": middle.tolist(),
                },
                "actuated_links": [
                    {
                        "inertia": _inertia(
                            arc_inertia(link, base, [1, 0, 0], [0, 0, 1]).matrix
                        ),
                        "mass": link,
                        "centre": [centre, 0.0, centre],
                    }
                ],
                "intermediate_links": [
                    {
                        "inertia": {"xx": own, "yy": slider + own, "zz": slider + own},
                        "mass": SLIDER,
                        "centre": [star, 0.0, 0.0],
                    }
                ],
                "payload": {"mass": PAYLOAD, "centre": [0.0, 0.0, star]},
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


def _inertia(tensor: Array) -> dict[str, float]:
    places = {
        "xx": (0, 0),
        "yy": (1, 1),
        "zz": (2, 2),
        "xy": (0, 1),
        "xz": (0, 2),
        "yz": (1, 2),
    }
    return {
        name: float(tensor[place])
        for name, place in places.items()
        if name in Inertia.SPECS
    }


def draw_designs(count: int = COUNT) -> list[Design]:
    """Draw designs: first the isotropic one, then Sobol points of the range."""
    points = qmc.scale(
        qmc.Sobol(6, seed=np.random.default_rng(1)).random(count), LOW, HIGH
    )
    return [
        Design(90.0, 90.0, 90.0, 120.0, 120.0, 1.0),
        *(Design(*row) for row in points.tolist()),
    ]


def evaluate(design: Design) -> Indices | None:
    """Measure a design; None where it cannot do the motion."""
    try:
        scene = design.scene()
        geometry = Geometry.of(scene)
        peak_torque, bending = follow(scene, geometry)
    except SstError:
        return None
    directions, faces = workspace.triangle_directions(geometry, DIVISIONS)
    chart = workspace.over_orientations(geometry, directions, TURNS)
    weights = np.zeros(len(directions))  # solid angle of each direction
    corners = directions[faces]
    sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = 0.5 * np.linalg.norm(np.cross(*sides), axis=1)
    for corner in faces.T:
        np.add.at(weights, corner, areas / 3.0)
    inside = chart.measures.admissible
    density = np.where(inside, weights[:, None] * 2.0 * np.pi / TURNS, 0.0)
    volume = float((weights * chart.turn).sum())
    conditioning = float((density / chart.measures.cond_j).sum() / density.sum())
    poses = workspace.orientations(directions[:, None], chart.psi)[inside]
    q = tuple(quaternion_of(poses).T)
    with np.errstate(all="ignore"):
        held, _ = kernel.actuator_torque(kernel.model_of(scene), q, ZERO, ZERO)
    static = np.percentile(np.abs(held).max(axis=0), PERCENTILE)
    error = orientation_error(design, geometry, poses)
    rms = float(np.sqrt(np.average(error**2, weights=density[inside])))
    share = 100.0 * volume / (8.0 * np.pi**2)
    return Indices(share, conditioning, float(static), peak_torque, bending, 1e3 * rms)


def follow(scene: Scene, geometry: Geometry) -> tuple[float, float]:
    """Return peak torque and bending moment [N m], or refuse a motion that leaves."""
    motion = reference_motion(scene)
    t = np.linspace(0.0, motion.duration, SAMPLES)
    desired = [motion.at(time) for time in t.tolist()]
    q, rate, acceleration = (
        np.array([getattr(at, name) for at in desired])
        for name in ("quaternion", "body_rate", "body_acceleration")
    )
    rotation = rotation_matrix(q)
    gamma = kinematics.inverse(geometry, rotation)[0]
    measured = workspace.measures(geometry, gamma, rotation)
    if not measured.admissible.all():
        raise SstError("the motion leaves the workspace")
    model = kernel.model_of(scene)
    rows, _ = kernel.actuator_torque(
        model, tuple(q.T), tuple(rate.T), tuple(acceleration.T)
    )
    torque = np.stack(rows, axis=1)
    found = reactions_of(scene, t, q, rate, torque)
    return float(np.abs(torque).max()), float(found.prismatic.bending_moment.max())


def orientation_error(design: Design, geometry: Geometry, poses: Array) -> Array:
    """Return the standard deviation [rad] of orientations by tolerances.

    Orientations have the shape (n, 3, 3), the result (n,).
    """
    by = rates.orientation_sensitivity(geometry, poses)
    on_base, on_star = (
        PART_ERROR / (0.35 * design.size),
        PART_ERROR / (0.4 * design.size),
    )
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


def isotropy() -> list[tuple[float, float]]:
    """Return arcs [deg] of symmetric designs, and 1/cond(J) in their middle."""
    found = []
    for arc in np.arange(60.0, 115.0, 5.0).tolist():
        geometry = Geometry.of(Design(arc, arc, arc, 120.0, 120.0, 1.0).scene())
        gamma = geometry.arc / 2.0
        rotation = kinematics.admissible(geometry, gamma).rotation
        found.append(
            (arc, 1.0 / float(workspace.measures(geometry, gamma, rotation).cond_j))
        )
    return found


@styled
def draw(table: DataFrame, front: Array) -> Figure:
    """Draw error and workspace of the designs over the peak torque.

    The first design and the front are marked.
    """
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    labels = {
        "error": "orientation error (RMS) [mrad]",
        "workspace": "orientations reached [%]",
    }
    looks = (("design", ".", GREY, 4), ("on the front", "o", BLUE, 4),
             ("isotropic, shipped size", "*", VERMILION, 14))  # fmt: skip
    rows = np.arange(len(table)) >= 0, front, np.arange(len(table)) == 0
    for axes, (name, label) in zip(figure.subplots(1, 2), labels.items(), strict=True):
        for (word, marker, colour, size), chosen in zip(looks, rows, strict=True):
            part = table[chosen]
            given = {"color": colour, "markersize": size, "label": word}
            axes.plot(part["peak_torque"], part[name], marker, **given)
        axes.set(xlabel="peak torque of the motion [N m]", ylabel=label)
        axes.legend(fontsize=8)
    return figure


def page(frame: DataFrame, designs: int, symmetric: list[tuple[float, float]]) -> str:
    """Write the page, with ten designs of the front from least to largest torque."""
    front = frame[frame["front"]].sort_values("peak_torque")
    shown = front.iloc[np.unique(np.linspace(0, len(front) - 1, 10).astype(int))]
    values = shown.drop(columns="front").map(lambda x: f"{x:.3g}")
    return render(
        PAGES / "design.md",
        frame=frame,
        designs=designs,
        symmetric=symmetric,
        front=front,
        shown=values,
        first=frame.iloc[0],
        low=LOW,
        high=HIGH,
        motion=MOTION["spiral"],
        part=PART_ERROR,
        percentile=PERCENTILE,
        payload=PAYLOAD,
    )


def report(options: argparse.Namespace) -> bool:
    """Write the page, its table and picture.

    True where the front and isotropy are found.
    """
    designs = draw_designs()
    results = [evaluate(one) for one in designs]
    kept = [(one, found) for one, found in zip(designs, results, strict=True) if found]
    frame = data_frame(asdict(one) | asdict(found) for one, found in kept)
    costs = np.stack(
        [-frame["workspace"], frame["peak_torque"], frame["error"]], axis=1
    )
    frame["front"] = front = find_front(costs)
    text = page(frame, len(designs), symmetric := isotropy())
    publish(
        options.out, "design", {".csv": frame, ".md": text, ".png": draw(frame, front)}
    )
    print(text)
    return bool(front.any()) and max(symmetric, key=lambda row: row[1])[0] == 90.0


if __name__ == "__main__":
    raise SystemExit(run(report, "design", DOCS, None))
