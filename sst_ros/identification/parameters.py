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
from sst_ros.programs.expression import (
    compile_for_arrays,
    divide,
    mark_present,
    trace,
)
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
ROUNDED = 1e-10  # share of a column's length, and of a coefficient, that is rounding
# Random motions that show the base parameters of a mechanism: so many that their
# equations outnumber the parameters several times, with the sizes of usual motions.
RANDOM_POSES = 300
INNER_STROKE = (0.1, 0.9)  # shares of the stroke between which the poses lie
RANDOM_RATE = 2.0  # standard deviation of W [rad/s]
RANDOM_ACCELERATION = 20.0  # of W_dot [rad/s^2]
# Poses nearer to a singularity are left out: their torques would outweigh all others.
REGULAR_DET_J2 = 0.05
REGULAR_SIN_MU = 0.1

FIRST_MOMENTS = ("moment.x", "moment.y", "moment.z")
INERTIA_ENTRIES = (
    "inertia.xx",
    "inertia.yy",
    "inertia.zz",
    "inertia.xy",
    "inertia.xz",
    "inertia.yz",
)
STANDARD = ("mass", *FIRST_MOMENTS, *INERTIA_ENTRIES)
"""The ten inertial parameters of a body about O, in the order of a body's columns."""

OFFSETS = ("offset[0]", "offset[1]", "offset[2]")
ROTOR_INERTIA = "actuators.rotor_inertia"


def select_names(scene: Scene, requested: Iterable[str] | None) -> tuple[str, ...]:
    """Return names of parameters of a scene: all, or the `requested` ones.

    A request is how names begin, as "star", "friction.gamma" or "offset". Raises
    InputError where no name begins so.
    """
    own, optional = _list_names(scene)
    if requested is None:
        return tuple(own)
    beginnings: Iterable[object] = requested
    if isinstance(requested, str):
        beginnings = [requested]
    selectable = dict.fromkeys(own + optional)
    names: dict[str, None] = {}
    checks: list[Check] = []
    for beginning in beginnings:
        matches = _match(str(beginning), selectable)
        hint = "" if matches else suggestion(str(beginning), selectable)
        requirement = f"begins no parameter of the scene{hint}"
        checks.append(("parameters", beginning, bool(matches), requirement))
        names |= dict.fromkeys(matches)
    for link in LINKS:
        alike = any(name.startswith(f"{link}.") for name in names)
        single = any(name.startswith(f"{link}[") for name in names)
        requirement = f"name {link} alike, or {link}[0] to {link}[2], not both"
        checks.append(("parameters", link, not (alike and single), requirement))
    refuse_unless("identify", *checks)
    return tuple(names)


def _match(beginning: str, names: Iterable[str]) -> list[str]:
    """Return the names that begin with whole words or indices as given.

    The name of a kind of links means the three alike.
    """
    pattern = re.compile(re.escape(beginning) + r"($|\.|\[)")
    matches = [name for name in names if pattern.match(name)]
    if beginning in LINKS:
        return [name for name in matches if "[" not in name]
    return matches


def values(scene: Scene, names: Sequence[str]) -> Array:
    """Return the values of parameters in a scene, shape (len(names),).

    A value is zero for what the scene does not have.
    """
    numbers = []
    for name in names:
        factor = 1.0
        body, is_moment, _ = name.partition(".moment.")
        if is_moment:
            factor = find_number(scene, f"{body}.mass") or 0.0
        numbers.append(factor * (find_number(scene, _key_of(name)) or 0.0))
    return np.array(numbers)


def _key_of(name: str) -> str:
    """Return the key in a scene that makes a parameter: of a moment, the centre's."""
    body, is_moment, axis = name.partition(".moment.")
    if not is_moment:
        return name
    return f"{body}.centre[{'xyz'.index(axis)}]"


def with_parameters(
    scene: Scene, names: Sequence[str], numbers: Array, note: str
) -> Scene:
    """Return the scene with identified values, and a note of their provenance.

    Raises InputError where no bodies have these values.
    """
    by_name = dict(zip(names, (float(number) for number in numbers), strict=True))
    changed: dict[str, Any] = {}
    for name, number in by_name.items():
        body, _, entry = name.partition(".")
        if entry.startswith("moment."):
            mass = by_name.get(f"{body}.mass", find_number(scene, f"{body}.mass"))
            centre = [0.0, 0.0, 0.0]
            if mass:
                moments = (by_name.get(f"{body}.{key}", 0.0) for key in FIRST_MOMENTS)
                centre = [moment / mass for moment in moments]
            changed[f"{body}.centre"] = centre
        elif name not in OFFSETS:
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

    Three equal links of a scene have one name. Besides, links may be asked for alone or
    alike, and so may friction and rotors that the scene does not have, and offsets.
    """
    own = _list_inertial(scene, "star")
    optional: list[str] = []
    for link in LINKS:
        alike = [
            name.replace("[0]", "") for name in _list_inertial(scene, f"{link}[0]")
        ]
        single: list[str] = []
        for leg in range(3):
            single += _list_inertial(scene, f"{link}[{leg}]")
        first, second, third = values_at(scene, link)[0]
        own += alike if first == second == third else single
        optional += single + alike
    friction = [
        f"friction.{kind}.{effect}"
        for kind in JOINT_KINDS
        for effect in Friction.EFFECTS
    ]
    springs = [f"springs[{i}].stiffness" for i in range(len(scene.springs))]
    for name in (*friction, *springs, ROTOR_INERTIA):
        if find_number(scene, name):
            own.append(name)
    optional += (name for name in friction if not name.endswith("static"))
    optional += (ROTOR_INERTIA, *OFFSETS)
    return own, optional


def _list_inertial(scene: Scene, body: str) -> list[str]:
    """List the names of the inertial parameters of a body, none if it has no inertia.

    Without gravity torques do not depend on mass and first moments: the star turns
    about O.
    """
    if not values_at(scene, f"{body}.inertia"):
        return []
    entries = INERTIA_ENTRIES if scene.gravity is None else STANDARD
    return [f"{body}.{entry}" for entry in entries]


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
        return render("identification.txt", fit=self, rows=rows)


class Regressor:
    """Y and the known part of the torques of a scene.

    What is not among the parameters is known.
    """

    def __init__(self, scene: Scene, names: Sequence[str]) -> None:
        self.scene = scene
        self.names = tuple(names)
        traced = [
            name
            for name in self.names
            if name not in OFFSETS and not name.endswith(".mass")
        ]
        keys = [_key_of(name) for name in traced]
        geometry = Geometry.of(scene)
        document = _with_unit_masses(scene)
        symbols = tuple(f"p{i}" for i in range(len(traced)))
        inputs = (*QUATERNION_SYMBOLS, *RATE_SYMBOLS, *BODY_ACCELERATION, *symbols)
        sizes = {
            "quaternion": len(QUATERNION_SYMBOLS),
            "rate": len(RATE_SYMBOLS),
            "acceleration": len(BODY_ACCELERATION),
            "parameters": len(symbols),
        }

        def torques(*numbers: Any) -> tuple[Any, ...]:
            """Return the torques of a motion with given values of the parameters."""
            given = divide(sizes, numbers)
            values = map(mark_present, given["parameters"])
            varied = dict(zip(keys, values, strict=True))
            opened = build_unchecked(Scene, replace_values(document, varied))
            torque, _ = kernel.actuator_torque(
                kernel.model_of(opened, geometry),
                given["quaternion"],
                given["rate"],
                given["acceleration"],
            )
            return torque

        self._torques = compile_for_arrays(trace(torques, inputs, symbols))
        indices = [self.names.index(name) for name in traced]
        self._traced = np.array(indices, dtype=int)
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
        rows = [np.broadcast_to(row, (count,)) for row in outputs]
        # the torques, then their derivative by each parameter
        torque, *slopes = np.stack(rows).reshape(-1, 3, count)
        columns = np.zeros((count, 3, len(self.names)))
        for index, slope in zip(self._traced, slopes, strict=True):
            columns[:, :, index] = slope.T
        for leg, name in enumerate(OFFSETS):
            if name in self.names:
                columns[:, leg, self.names.index(name)] = 1.0
        return torque.T - columns[:, :, self._springs].sum(axis=2), columns


def _with_unit_masses(scene: Scene) -> dict[str, Any]:
    """Return the document of a scene with the same first moments and masses of 1 kg.

    Torques depend on mass times centre alone: bodies of mass 1 have it as their centre.
    """
    document = dict(plain(scene))
    bodies = [document["star"]]
    for link in LINKS:
        bodies += document[link]
    for body in bodies:
        mass = body["mass"]
        body["centre"] = [mass * coordinate for coordinate in body["centre"]]
        body["mass"] = 1.0
    return document


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
    geometry = Geometry.of(regressor.scene)
    rng = np.random.default_rng(seed)
    stroke_shares = rng.uniform(*INNER_STROKE, (RANDOM_POSES, 3))
    poses = kinematics.direct_many(geometry, stroke_shares * geometry.arc)
    is_regular = np.abs(poses.det_j2) > REGULAR_DET_J2
    is_regular &= np.all(np.sin(poses.mu) > REGULAR_SIN_MU, 1)
    quaternion = quaternion_of(poses.rotation[poses.admissible & is_regular])
    rate, acceleration = rng.normal(size=(2, len(quaternion), 3))
    _, columns = regressor(
        quaternion, RANDOM_RATE * rate, RANDOM_ACCELERATION * acceleration
    )
    return find_independent(columns, regressor.names)


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
    chosen_lengths = lengths[nonzero[chosen]]
    transform[:, nonzero] = solved * lengths[nonzero] / chosen_lengths[:, None]
    indices: list[int] = nonzero[chosen].tolist()
    labels = [names[i] for i in indices]
    for (row, i), factor in np.ndenumerate(transform):
        if factor and i != indices[row]:
            sign = "-" if factor < 0.0 else "+"
            size = abs(factor)
            coefficient = f"{size:.4g} " if abs(size - 1.0) > ROUNDED else ""
            labels[row] += f" {sign} {coefficient}{names[i]}"
    return BaseParameters(tuple(labels), indices, transform)
