# SPDX-License-Identifier: Apache-2.0
"""Unknown constants of a scene: their names, and how torques depend on them.

The names are the keys of a scene, and for a body "star.moment.x": mass times centre [kg
m], in which torques are linear. "actuated_links.mass" means all three alike,
"actuated_links[0].mass" one. "offset[0]" is a constant torque at an actuator, as of a
sensor without zero balance [N m].

Torques are linear in the inertial parameters, the friction coefficients, the stiffness
of springs and the inertia of the rotors (Atkeson, An and Hollerbach, Int. J. Robotics
Research 5 (1986) 101-119): torque = known part + Y parameters. So the regressor Y is
the derivative of the traced inverse dynamics by these parameters, which has no
parameter in it: it is exact, and covers each term that the dynamics have.

Base parameters are the combinations of parameters that torques depend on, and no
others. A QR decomposition of the regressor shows which columns are combinations of
earlier ones (Gautier, J. Robotic Systems 8 (1991) 485-506). With random states it does
so for the mechanism; with the states of a motion it shows what that motion leaves
undetermined as well.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.traced_dynamics import (
    BODY_ACCELERATION,
    QUATERNION_SYMBOLS,
    RATE_SYMBOLS,
)
from sst_ros.errors import Check, refuse_unless, suggestion
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of
from sst_ros.programs.expression import compile_for_arrays, mark_present, trace
from sst_ros.report.results import render
from sst_ros.scene.loads import Friction
from sst_ros.scene.scene import LINKS, Scene
from sst_ros.scene.schema import build, build_unchecked, drop_idle
from sst_ros.scene.yaml_document import find_number, plain, replace_values, values_at
from sst_ros.state import ReadOnly

JOINT_KINDS = ("gamma", "mu", "beta")
NEGLIGIBLE = 1e-12  # friction coefficient below which a scene has no such friction
# Distance of a column from the span of those before it, over its own length, below
# which it counts as one of them: between rounding (1e-13) and the least of any
# mechanism tried (1e-4).
DEPENDENT = 1e-8
ROUNDED = 1e-10  # share of a column's length that is rounding
INERTIA_ENTRIES = ("xx", "yy", "zz", "xy", "xz", "yz")
STANDARD = (
    "mass",
    *(f"moment.{axis}" for axis in "xyz"),
    *(f"inertia.{part}" for part in INERTIA_ENTRIES),
)
"""The ten inertial parameters of a body about O, in the order of a body's columns."""


def select_names(scene: Scene, requested: Iterable[str] | None) -> tuple[str, ...]:
    """Return names of parameters of a scene: all, or the `requested` ones.

    A name counts that begins as in ("star", "friction.gamma", "offset"); a beginning of
    none is refused.
    """
    own, optional = _list_names(scene)
    if requested is None:
        return tuple(own)
    names: dict[str, None] = {}
    checks, selectable = list[Check](), dict.fromkeys(own + optional)
    for begin in [requested] if isinstance(requested, str) else requested:
        matches = [
            name
            for name in selectable
            if re.match(re.escape(str(begin)) + r"($|\.|\[)", name)
        ]
        if str(begin) in LINKS:  # the three alike
            matches = [name for name in matches if "[" not in name]
        hint = "" if matches else suggestion(str(begin), selectable)
        requirement = f"begins no parameter of the scene{hint}"
        checks.append(("parameters", begin, bool(matches), requirement))
        names |= dict.fromkeys(matches)
    for link in LINKS:
        forms = {name.removeprefix(link)[:1] for name in names if name.startswith(link)}
        requirement = f"name {link} alike, or {link}[0] to {link}[2], not both"
        checks.append(("parameters", link, len(forms) <= 1, requirement))
    refuse_unless("identify", *checks)
    return tuple(names)


def values(scene: Scene, names: Sequence[str]) -> Array:
    """Return the values of parameters in a scene, shape (len(names),).

    A value is zero for what the scene does not have.
    """
    numbers = []
    for name in names:
        body, moment, _ = name.partition(".moment.")
        mass = (find_number(scene, f"{body}.mass") or 0.0) if moment else 1.0
        numbers.append(mass * (find_number(scene, _of_centre(name)) or 0.0))
    return np.array(numbers)


def _of_centre(name: str) -> str:
    """Return the key of the component of a centre that a moment has."""
    return re.sub(r"moment\.([xyz])$", lambda m: f"centre[{'xyz'.index(m[1])}]", name)


def with_parameters(
    scene: Scene, names: Sequence[str], numbers: Array, note: str
) -> Scene:
    """Return the scene with identified values, or refuse them.

    A note of their provenance is added.
    """
    by_name = dict(zip(names, (float(number) for number in numbers), strict=True))
    changed: dict[str, Any] = {}
    for name, number in by_name.items():
        body, _, entry = name.partition(".")
        if entry.startswith("moment."):
            mass = by_name.get(f"{body}.mass", find_number(scene, f"{body}.mass"))
            centre = [by_name.get(f"{body}.moment.{axis}", 0.0) for axis in "xyz"]
            changed[f"{body}.centre"] = (
                [h / mass for h in centre] if mass else [0.0] * 3
            )
        elif not name.startswith("offset"):
            changed[name] = number
    document = replace_values(plain(scene), changed)
    for terms in document.get("friction", {}).values():
        for key in Friction.EFFECTS:
            if terms.get(key, 0.0) < NEGLIGIBLE:
                terms[key] = 0.0
    notes = document.setdefault("provenance", {})
    sections = {re.sub(r"\[\d\]", "", name).split(".")[0] for name in by_name}
    notes |= dict.fromkeys(sorted(sections & document.keys()), note)
    return build(Scene, drop_idle(Scene, document), scene.name)


def _list_names(scene: Scene) -> tuple[list[str], list[str]]:
    """List names of what the scene has, and of what may be asked for besides.

    Equal links are named alike. What may be asked for besides are links alone or alike,
    friction that is not yet known, and offsets.
    """
    entries = STANDARD if scene.gravity is not None else STANDARD[4:]

    def name_parts(*bodies: str) -> list[str]:
        massive = (body for body in bodies if values_at(scene, f"{body}.inertia"))
        return [f"{body}.{entry}" for body in massive for entry in entries]

    own, optional = name_parts("star"), list[str]()
    for link in LINKS:
        each, alike = (
            name_parts(*(f"{link}[{k}]" for k in range(3))),
            name_parts(f"{link}[0]"),
        )
        alike = [name.replace("[0]", "") for name in alike]
        first, *following = values_at(scene, link)[0]
        own += alike if following == [first, first] else each
        optional += each + alike
    terms = [
        f"friction.{link}.{entry}" for link in JOINT_KINDS for entry in Friction.EFFECTS
    ]
    springs = [f"springs[{i}].stiffness" for i in range(len(scene.springs))]
    own += filter(
        partial(find_number, scene), [*terms, *springs, "actuators.rotor_inertia"]
    )
    optional += (name for name in terms if not name.endswith("static"))
    return own, [
        *optional,
        "actuators.rotor_inertia",
        *(f"offset[{k}]" for k in range(3)),
    ]


@dataclass(frozen=True)
class Identification(ReadOnly):
    """Identified constants of a scene, by torques or by simulation.

    Attributes:
        scene: the scene with identified values, whose bodies can exist.
        names: of the parameters, length p.
        values: their values in `scene`, shape (p,).
        labels: quantities that are estimated: parameters or combinations of them,
            length b.
        before: their values in the scene that was given, shape (b,).
        estimate: their estimates, shape (b,).
        covariance: of the estimates, shape (b, b).
        undetermined: combinations that this motion leaves open, as text.
        warnings: what else to know.

    """

    scene: Scene
    names: tuple[str, ...]
    values: Array
    labels: tuple[str, ...]
    before: Array
    estimate: Array
    covariance: Array
    undetermined: tuple[str, ...]
    warnings: tuple[str, ...]

    def __post_init__(self) -> None:
        self._freeze()

    @property
    def deviation(self) -> Array:
        """Standard deviations of the estimates, shape (b,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def correlation(self) -> Array:
        """Correlations of the estimates, shape (b, b)."""
        return np.asarray(self.covariance / np.outer(self.deviation, self.deviation))

    def table(self) -> str:
        """Return the estimates as text.

        It has standard deviations, and what the motion leaves open.
        """
        rows = zip(self.before, self.estimate, self.deviation, self.labels, strict=True)
        return render("identification.txt", found=self, rows=rows)


class Regressor:
    """Y and the known part of the torques of a scene.

    What is not among the parameters is known.
    """

    def __init__(self, scene: Scene, names: Sequence[str]) -> None:
        self.scene, self.names = scene, tuple(names)
        traced = [
            n for n in self.names if not n.startswith("offset") and n[-5:] != ".mass"
        ]
        geometry, document = Geometry.of(scene), plain(scene)
        # Torques depend on mass times centre alone: bodies of mass 1 have it as their
        # centre.
        for body in (
            document["star"],
            *(link for kind in LINKS for link in document[kind]),
        ):
            body["centre"] = [
                body["mass"] * coordinate for coordinate in body["centre"]
            ]
            body["mass"] = 1.0

        def torques(*inputs: Any) -> tuple[Any, ...]:
            varied = zip(
                map(_of_centre, traced), map(mark_present, inputs[10:]), strict=True
            )
            opened = build_unchecked(Scene, replace_values(document, dict(varied)))
            model = kernel.model_of(opened, geometry)
            return kernel.actuator_torque(model, inputs[:4], inputs[4:7], inputs[7:10])[
                0
            ]

        symbols = tuple(f"p{i}" for i in range(len(traced)))
        inputs = (*QUATERNION_SYMBOLS, *RATE_SYMBOLS, *BODY_ACCELERATION, *symbols)
        self._torques = compile_for_arrays(trace(torques, inputs, symbols))
        places = [self.names.index(name) for name in traced]
        self._traced = np.array(places, dtype=int)
        is_spring = [name.startswith("springs") for name in self.names]
        self._springs = np.array(is_spring, dtype=bool)

    def __call__(
        self, quaternion: Array, rate: Array, acceleration: Array
    ) -> tuple[Array, Array]:
        """Return the known torques [N m], (n, 3), and Y, (n, 3, len(names)).

        States are quaternions (x, y, z, w) of {E} in {B}, W [rad/s] and W_dot [rad/s^2]
        in {E}.
        """
        count = len(quaternion)
        # A stiffness of zero leaves no rest angle: springs are evaluated at 1 N m/rad.
        stiffness = self._springs[self._traced].astype(float)
        outputs = self._torques(*quaternion.T, *rate.T, *acceleration.T, *stiffness)
        rows = np.stack([np.broadcast_to(row, (count,)) for row in outputs]).reshape(
            -1, 3, count
        )
        columns = np.zeros((count, 3, len(self.names)))
        columns[:, :, self._traced] = rows[1:].T
        for i, name in enumerate(self.names):
            if name.startswith("offset"):
                columns[:, int(name[7]), i] = 1.0
        return rows[0].T - columns[:, :, self._springs].sum(axis=2), columns


class BaseParameters(NamedTuple):
    """Combinations of parameters: beta = transform parameters.

    Attributes:
        labels: each combination as text, length b; the chosen parameter comes first.
        chosen: indices of the parameters whose columns are independent, length b.
        transform: shape (b, p); row i has 1 at the chosen parameter i, and the
            coefficients of those whose columns depend on it.

    """

    labels: tuple[str, ...]
    chosen: list[int]
    transform: Array


def find_base_parameters(regressor: Regressor, seed: int = 0) -> BaseParameters:
    """Return the base parameters of the mechanism: those that some motion determines.

    The regressor is taken at random admissible poses within the stroke, rates and
    accelerations.
    """
    geometry, rng = Geometry.of(regressor.scene), np.random.default_rng(seed)
    poses = kinematics.direct_many(
        geometry, rng.uniform(0.1, 0.9, (300, 3)) * geometry.arc
    )
    regular = (
        poses.admissible
        & (np.abs(poses.det_j2) > 0.05)
        & np.all(np.sin(poses.mu) > 0.1, 1)
    )
    quaternion = quaternion_of(poses.rotation[regular])
    rate, acceleration = rng.normal(size=(2, len(quaternion), 3)) * [[[2.0]], [[20.0]]]
    return find_independent(
        regressor(quaternion, rate, acceleration)[1], regressor.names
    )


def find_independent(columns: Array, names: Sequence[str]) -> BaseParameters:
    """Return the base parameters of a regressor, shape (n, 3, p)."""
    matrix: Any = np.linalg.qr(columns.reshape(-1, columns.shape[-1]), mode="r")
    lengths = np.linalg.norm(matrix, axis=0)
    nonzero = np.flatnonzero(lengths > ROUNDED * lengths.max(initial=1e-300))
    scaled = matrix[:, nonzero] / lengths[nonzero]
    chosen: list[int] = []
    for i in range(len(nonzero)):
        trial = [*chosen, i]
        # The last diagonal entry of R is the distance from the span of the columns
        # before.
        triangle: Any = np.linalg.qr(scaled[:, trial], mode="r")
        if abs(triangle[-1, -1]) > DEPENDENT:
            chosen = trial
    solved = np.linalg.lstsq(scaled[:, chosen], scaled, rcond=None)[0]
    solved[np.abs(solved) < ROUNDED] = 0.0
    transform = np.zeros((len(chosen), len(names)))
    transform[:, nonzero] = (
        solved * lengths[nonzero] / lengths[nonzero[chosen]][:, None]
    )
    indices: list[int] = nonzero[chosen].tolist()
    labels = [names[i] for i in indices]
    for (row, i), factor in np.ndenumerate(transform):
        if factor and i != indices[row]:
            coefficient = (
                "" if abs(abs(factor) - 1.0) <= ROUNDED else f"{abs(factor):.4g} "
            )
            labels[row] += f" {'-' if factor < 0.0 else '+'} {coefficient}{names[i]}"
    return BaseParameters(tuple(labels), indices, transform)
