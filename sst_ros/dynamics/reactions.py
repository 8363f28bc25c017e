# SPDX-License-Identifier: Apache-2.0
"""Forces and moments that the joints transmit, link by link (Newton and Euler).

All seven links turn about O, so every joint is a revolute about an axis through O: w_k
(base to actuated link), r_k (to the intermediate link), t_k (the curved prismatic
joint, to the star). What a link exerts on the next one is a force through O and a
moment about O.

The moments are determined by the motion. About its own axis a joint transmits what acts
there: motor, friction, springs, stops. With the rate of change of the angular momentum
of a link, less the moment of its weight, A_k of the actuated and B_k of the
intermediate link, the moment m_k on the star obeys::

    t.m = -tau_beta,   r.(m + B) = -tau_mu,   w.(m + B + A) = tau + tau_gamma,

three equations with the determinant c_k = (r x t).w, which is zero in a serial
singularity only.

The forces are not: all axes meet in O, so forces that run round the two loops change no
motion. Six of the 27 components are free. Given here are the forces of least sum of
squares, which are those of joints equally stiff in all directions (Castigliano's
theorem of least work). The sums over the three legs do not depend on this choice.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.kernel import LegMotion
from sst_ros.dynamics.model import Model
from sst_ros.dynamics.traced_dynamics import (
    BODY_ACCELERATION,
    MOTION,
    TORQUE_SYMBOLS,
    Dynamics,
    Function,
)
from sst_ros.errors import require
from sst_ros.mechanism.generic_math import (
    Rows,
    Scalar,
    Triple,
    add,
    cross3,
    dot3,
    multiply,
    rotate_back,
    rotation_rows,
    sqrt,
    symmetric_rows,
    triple,
)
from sst_ros.mechanism.geometry import Array
from sst_ros.programs.expression import (
    compile_for_arrays,
    compile_program,
    mark_present,
    trace,
)
from sst_ros.scene.bodies import entries_of
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import leaves, rebuild
from sst_ros.state import ZERO, Explained, cached_property

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINK_JOINTS = ("actuated", "revolute", "prismatic")
"""Joints of a leg from the base to the star."""
AXES = {"actuated": 2, "revolute": 0, "prismatic": 2}
"""Which axis of its frame a joint turns about: w_k of {1k}; r_k and t_k of {2k}."""
SIZES = {
    "radial_force": "N", "axial_force": "N",
    "bending_moment": "N m", "axis_torque": "N m",
}  # fmt: skip
"""What a bearing and a motor are chosen by, with units."""
REACTION_UNITS = {
    f"{quantity}_{name}_{leg}_{axis}": unit
    for name in LINK_JOINTS
    for quantity, unit in (("force", "N"), ("moment", "N m"))
    for leg in (1, 2, 3)
    for axis in "xyz"
}
"""Unit of each column of reactions, as "force_actuated_1_x"."""


@dataclass(frozen=True)
class JointLoads:
    """What joints of one kind transmit to the next link, shapes (..., 3, 3).

    Rows are by leg. The vectors have the axes of the joint's frame: {1k} = [r, w x r,
    w] for the actuated joints, {2k} = [r, t x r, t] for the revolute and the prismatic
    ones.
    """

    force: Array  #: through O [N]
    moment: Array  #: about O [N m]
    axis: int  #: which axis of the frame the joint turns about

    @property
    def radial_force(self) -> Array:
        """Force across the axis [N], shape (..., 3)."""
        return _length(np.delete(self.force, self.axis, axis=-1))

    @property
    def axial_force(self) -> Array:
        """Force along the axis [N], shape (..., 3)."""
        return self.force[..., self.axis]

    @property
    def bending_moment(self) -> Array:
        """Moment about O across the axis [N m], shape (..., 3)."""
        return _length(np.delete(self.moment, self.axis, axis=-1))

    @property
    def axis_torque(self) -> Array:
        """Moment about the axis [N m], shape (..., 3).

        Motor, friction, springs and stops make it.
        """
        return self.moment[..., self.axis]


class LoadFigures(NamedTuple):
    """Largest absolute load over a motion, and its root mean square over time."""

    peak: Array  #: by leg, shape (..., 3)
    time: Array  #: when the peak is taken [s], shape (..., 3)
    rms: Array  #: shape (..., 3)


@dataclass(frozen=True, repr=False)
class Reactions(Explained):
    """Forces and moments at every joint of a motion. Arrays are read-only.

    A joint exerts them on the link that is nearer the star; the other one feels the
    opposite. Moments, and sums of forces over the legs, follow from the motion alone.
    The share of each leg in a force is that of joints equally stiff in all directions:
    the links are over-constrained.

    Attributes:
        t: times [s], shape (...).
        actuated: base on actuated links; about w_k with the torque of the motor.
        revolute: actuated on intermediate links.
        prismatic: intermediate links on the star.
        actuated_frames: rotations of {1k} in {B}, shape (..., 3, 3, 3).
        intermediate_frames: rotations of {2k} in {B}.
        gaps: times of which nothing is known, begin and end [s], shape (g, 2).

    """

    t: Array
    actuated: JointLoads
    revolute: JointLoads
    prismatic: JointLoads
    actuated_frames: Array
    intermediate_frames: Array
    gaps: Array = field(default_factory=partial(np.empty, (0, 2)))

    def joints(self) -> Iterator[tuple[str, JointLoads]]:
        """Yield the name and the loads of each kind of joint."""
        for name in LINK_JOINTS:
            yield name, getattr(self, name)

    def columns(self) -> dict[str, Array]:
        """Return a column a number by the names of REACTION_UNITS."""
        columns = {}
        for key in REACTION_UNITS:
            quantity, name, leg, axis = key.split("_")
            values = getattr(getattr(self, name), quantity)
            columns[key] = values[..., int(leg) - 1, "xyz".index(axis)]
        return columns

    @cached_property
    def figures(self) -> dict[str, dict[str, LoadFigures]]:
        """Peak and root mean square of each of SIZES by kind of joint.

        They are over the first axis of t.
        """
        return {
            name: {size: load_figures(self.t, getattr(loads, size)) for size in SIZES}
            for name, loads in self.joints()
        }

    def plot(self) -> Figure:
        """Draw bearing forces and moments and torques over time; needs matplotlib."""
        require("matplotlib")
        from sst_ros.figures import Panel, draw_panels, leg_names

        panels = []
        for name, loads in self.joints():
            force = _length(loads.force)
            panels.append(Panel(f"{name}\nforce [N]", leg_names("F"), force))
            bending = loads.bending_moment
            panels.append(Panel(f"{name}\nbending [N m]", leg_names("M"), bending))
        torque = self.actuated.axis_torque
        panels.append(Panel("motor and loads\nat γ [N m]", leg_names("τ"), torque))
        return draw_panels(self.t, panels, height=1.5, gaps=self.gaps)

    def _facts(self) -> dict[str, object]:
        facts: dict[str, object] = {"samples": len(self.t)}
        for name, figures in self.figures.items():
            for size in ("radial_force", "bending_moment"):
                label = f"peak {name} {size.replace('_', ' ')} [{SIZES[size]}]"
                facts[label] = figures[size].peak
        return facts


def load_figures(t: Array, values: Array) -> LoadFigures:
    """Return peak and root mean square of samples over time, the first axis of both.

    The mean square is that of straight lines between the samples; of a single sample
    its own.
    """
    size = np.abs(values)
    row = np.nanargmax(np.where(np.isnan(size), -1.0, size), axis=0)
    peak = np.take_along_axis(size, row[None], axis=0)[0]
    times = np.broadcast_to(
        t.reshape(*t.shape, *[1] * (values.ndim - t.ndim)), values.shape
    )
    when = np.take_along_axis(times, row[None], axis=0)[0]
    span = times[-1] - times[0]
    intervals = np.diff(times, axis=0)
    first, last = values[:-1], values[1:]
    integrand = first * first + first * last + last * last
    squares = np.sum(intervals * integrand, axis=0) / 3.0
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(span > 0.0, squares / span, size[0] ** 2)
    return LoadFigures(peak, when, np.sqrt(mean))


def reactions_of(
    scene: Scene, t: Array, quaternion: Array, body_rate: Array, torque: Array
) -> Reactions:
    """Compute the reactions of a motion under torques that act at the actuators.

    Accelerations are those of the scene's equations of motion. A moment from a topic is
    no part of them.

    Args:
        scene: what moves.
        t: times [s], shape (n,).
        quaternion: orientations (x, y, z, w) of {E} in {B}, shape (n, 4).
        body_rate: angular velocities of the star in {E} [rad/s], shape (n, 3).
        torque: torques that act at the actuators, without friction and springs [N m],
            (n, 3).

    """
    state = (*quaternion.T, *body_rate.T)
    with np.errstate(all="ignore"):
        legs = _legs(scene, Dynamics.of(scene).model, state, triple(torque.T))
    return _collect(t, _flatten(legs), rotation_rows(_quadruple(state)))


def reaction_at(scene: Scene, joint: str, leg: int) -> Function:
    """Return a function for what one joint exerts on the link that is nearer the star.

    It gives force through O [N] and moment about O [N m], six numbers in the axes of
    the joint's frame, see `JointLoads`. Its arguments are the quaternion (x, y, z, w),
    the body rate [rad/s], the torques that act at the actuators [N m] and the angular
    acceleration in {E} [rad/s^2], 13 numbers.

    Args:
        scene: what moves.
        joint: one of LINK_JOINTS.
        leg: 0, 1 or 2.

    """
    model = Dynamics.of(scene).model

    def wrench(*inputs: Any) -> tuple[Scalar, ...]:
        torque, acceleration = triple(inputs[7:10]), triple(inputs[10:13])
        legs = _solve(scene, model, inputs[:7], acceleration, torque)
        force, moment = getattr(legs[leg], joint)
        return (*force, *moment)

    return compile_program(
        trace(wrench, (*MOTION, *TORQUE_SYMBOLS, *BODY_ACCELERATION))
    )


class ScenarioReactions:
    """Reactions of many scenarios at once, whose numbers may differ.

    Args:
        scene: a scene, unchecked, with columns (N,) for the numbers that differ.
        model: its constants, with columns too.

    """

    def __init__(self, scene: Any, model: Model) -> None:
        tree = scene, model
        numbers = leaves(tree)
        columns = {
            place: x for place, x in numbers.items() if isinstance(x, np.ndarray)
        }
        self._columns = list(columns.values())
        names = (*MOTION, *TORQUE_SYMBOLS, *(f"p{i}" for i in range(len(columns))))

        def run(*inputs: Any) -> list[Any]:
            marked = map(mark_present, inputs[10:])
            symbols = dict(zip(columns, marked, strict=True))
            own_scene, own_model = rebuild(tree, symbols)
            return _flatten(
                _legs(own_scene, own_model, inputs[:7], triple(inputs[7:10]))
            )

        self._run = compile_for_arrays(trace(run, names))

    def of(self, t: Array, state: Array, torque: Array, rows: slice) -> Reactions:
        """Return the reactions of some rows.

        Shapes of t [s], of the states (7, ...) and of the torques (3, ...) [N m] end in
        the number of these rows.
        """
        with np.errstate(all="ignore"):
            numbers = self._run(
                *state, *torque, *(column[rows] for column in self._columns)
            )
        return _collect(t, list(numbers), rotation_rows(_quadruple(list(state))))


def _legs(
    scene: Any, model: Model, state: Sequence[Scalar], torque: Triple
) -> list[_LegReactions]:
    """Solve for the reactions of the legs under torques that act."""
    still = model._replace(time_constant=None)
    slope = kernel.derivative(still, tuple(state), torque)
    return _solve(scene, model, state, triple(slope[4:7]), torque)


def _flatten(tree: Any) -> list[Scalar]:
    """List the numbers of nested tuples in order."""
    if isinstance(tree, (list, tuple)):
        return [number for branch in tree for number in _flatten(branch)]
    return [tree]


def _collect(t: Array, numbers: Sequence[Scalar], rows: Rows) -> Reactions:
    """Make reactions of the 36 numbers of each leg, which `_flatten` lists."""
    flat = _stack(t, numbers).reshape(*t.shape, 3, 12, 3)
    joints: dict[str, Any] = {}
    for index, name in enumerate(LINK_JOINTS):
        force, moment = flat[..., 2 * index, :], flat[..., 2 * index + 1, :]
        joints[name] = JointLoads(force, moment, AXES[name])
    # Rows of the frames are their axes in {E}.
    axes = flat[..., 6:, :].reshape(*t.shape, 3, 2, 3, 3)
    frames = _stack(t, rows)[..., None, None, :, :] @ np.swapaxes(axes, -1, -2)
    frames.setflags(write=False)
    first, second = frames[..., 0, :, :], frames[..., 1, :, :]
    return Reactions(t=t, **joints, actuated_frames=first, intermediate_frames=second)


class _LegReactions(NamedTuple):
    """Forces and moments of a leg in the frames of the joints.

    Axes of {1k} and {2k} in {E}.
    """

    actuated: tuple[Triple, Triple]
    revolute: tuple[Triple, Triple]
    prismatic: tuple[Triple, Triple]
    first: Rows
    second: Rows


class _Change(NamedTuple):
    """What a link needs in {E}: force, and moment about O, less those of its weight."""

    force: Triple
    moment: Triple


def _solve(
    scene: Any,
    model: Model,
    state: Sequence[Scalar],
    acceleration: Triple,
    torque: Triple,
) -> list[_LegReactions]:
    """Solve the balances of all links, leg by leg, in {E}."""
    rows, rate = rotation_rows(_quadruple(state)), triple(state[4:7])
    field = ZERO if model.gravity is None else rotate_back(rows, model.gravity)
    motions = list(kernel.leg_motions(model, state))
    own = kernel.own_torques(model, rows, rate) if model.own_loads else None
    star = _change_of_star(scene, model, field, rate, acceleration)
    legs = []
    for k, (motion, drive) in enumerate(zip(motions, torque, strict=True)):
        loads = _joint_loads(motion)
        if own is not None:
            loads = add(loads, own.joints[k])
        legs.append(_Leg.of(scene, k, motion, field, rate, acceleration, drive, loads))
    # Least sum of squares of the forces x, x + b and x + b + a of each leg, whose x
    # make up the star's: 3 x + 2 b + a is the same in all legs.
    spread = [add(multiply(2.0, leg.link.force), leg.drive.force) for leg in legs]
    mean = multiply(1.0 / 3.0, add(add(spread[0], spread[1]), spread[2]))
    reactions = []
    for leg, own_spread in zip(legs, spread, strict=True):
        share = add(star.force, _subtract(mean, own_spread))
        reactions.append(leg.express(multiply(1.0 / 3.0, share)))
    return reactions


class _Leg(NamedTuple):
    """One leg: its frames in {E}, what its links need, and its moment on the star."""

    first: Rows
    second: Rows
    drive: _Change
    link: _Change
    moment: Triple

    @classmethod
    def of(
        cls,
        scene: Any,
        k: int,
        motion: LegMotion,
        field: Triple,
        rate: Triple,
        acceleration: Triple,
        torque: Scalar,
        loads: Triple,
    ) -> _Leg:
        """Solve the moments of leg k under its actuator's torque and joint loads."""
        root = sqrt(motion.u)  # c_k = (r x t).w = sin(mu_k)
        r = triple(component / root for component in motion.p)
        t = motion.along
        w = motion.axis
        across = cross3(w, r)
        first, second = (r, across, w), (r, cross3(t, r), t)
        _, gamma_rest = kernel.rest_accelerations(motion, rate)
        gamma_ddot = dot3(motion.g, acceleration) + gamma_rest
        mu_dot = -motion.a_dot / root
        turning = cross3(rate, t)
        products = motion.gamma_dot * mu_dot + motion.beta_dot * dot3(across, turning)
        beta_ddot = -(dot3(across, acceleration) + products) / root  # Eq. 46
        # omega of the star is that of the intermediate link - t beta_dot, and t turns
        # with it.
        slide = add(multiply(beta_ddot, t), multiply(motion.beta_dot, turning))
        link_rate = add(rate, multiply(motion.beta_dot, t))
        link = scene.intermediate_links[k]
        link_change = _change_of(
            entries_of(link.inertia), link.mass, link.centre, second, field,
            link_rate, add(acceleration, slide),
        )  # fmt: skip
        drive = scene.actuated_links[k]
        inertia = entries_of(drive.inertia)
        if scene.actuators is not None:
            gear = scene.actuators.gear_ratio
            inertia[2] = inertia[2] + gear * gear * scene.actuators.rotor_inertia
        drive_change = _change_of(
            inertia, drive.mass, drive.centre, first, field,
            multiply(motion.gamma_dot, w), multiply(gamma_ddot, w),
        )  # fmt: skip
        at_gamma, at_mu, at_beta = loads
        needs = link_change.moment
        along_t = -at_beta
        along_r = -at_mu - dot3(r, needs)
        along_w = torque + at_gamma - dot3(w, add(needs, drive_change.moment))
        normal = cross3(r, t)
        along_normal = (along_w - motion.a * along_t) / root
        moment = add(multiply(along_r, r), multiply(along_normal, normal))
        moment = add(moment, multiply(along_t, t))
        return cls(first, second, drive_change, link_change, moment)

    def express(self, force: Triple) -> _LegReactions:
        """Return what the joints transmit if the leg exerts this force on the star."""
        on_link = add(force, self.link.force), add(self.moment, self.link.moment)
        on_drive = add(on_link[0], self.drive.force), add(on_link[1], self.drive.moment)
        return _LegReactions(
            (
                _components(on_drive[0], self.first),
                _components(on_drive[1], self.first),
            ),
            (
                _components(on_link[0], self.second),
                _components(on_link[1], self.second),
            ),
            (_components(force, self.second), _components(self.moment, self.second)),
            self.first,
            self.second,
        )


def _joint_loads(motion: LegMotion) -> Triple:
    """Torques of friction, springs and stops at gamma, mu and beta [N m].

    Weights are left out.
    """
    weightless = motion._replace(leg=motion.leg._replace(drive=ZERO, link=ZERO))
    return kernel.joint_torques(weightless, ZERO)


def _change_of_star(
    scene: Any, model: Model, field: Triple, rate: Triple, acceleration: Triple
) -> _Change:
    """Return what the star with its payload needs; its frame is {E}."""
    entries, mass = entries_of(scene.star.inertia), scene.star.mass
    if scene.payload is not None:
        pairs = zip(entries, scene.payload.entries, strict=True)
        entries = [own + carried for own, carried in pairs]
        mass = mass + scene.payload.mass
    axes: Rows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    weight = model.weight
    return _change(entries, mass, weight, axes, field, rate, acceleration)


def _change_of(
    inertia: Sequence[Scalar],
    mass: Scalar,
    centre: Triple,
    axes: Rows,
    field: Triple,
    rate: Triple,
    acceleration: Triple,
) -> _Change:
    """Return what a link needs whose centre is given in its own axes."""
    weight = _combine(multiply(mass, centre), axes)
    return _change(inertia, mass, weight, axes, field, rate, acceleration)


def _change(
    inertia: Sequence[Scalar],
    mass: Scalar,
    weight: Triple,
    axes: Rows,
    field: Triple,
    rate: Triple,
    acceleration: Triple,
) -> _Change:
    """Return Newton's and Euler's sides of a body that turns about O, less its weight.

    Inertia (xx, yy, zz, xy, xz, yz) is about O in the axes of the body; mass times
    centre, gravity, rate and acceleration are in {E}.
    """
    xx, yy, zz, xy, xz, yz = inertia
    tensor = symmetric_rows((xx, yy, zz, xy, xz, yz))
    spin, spin_dot = _components(rate, axes), _components(acceleration, axes)
    momentum = triple(dot3(row, spin) for row in tensor)
    change = add(triple(dot3(row, spin_dot) for row in tensor), cross3(spin, momentum))
    moment = _subtract(_combine(change, axes), cross3(weight, field))
    towards = add(cross3(acceleration, weight), cross3(rate, cross3(rate, weight)))
    return _Change(_subtract(towards, multiply(mass, field)), moment)


def _components(vector: Triple, axes: Rows) -> Triple:
    return triple(dot3(axis, vector) for axis in axes)


def _combine(components: Triple, axes: Rows) -> Triple:
    x, y, z = axes
    a, b, c = components
    return triple(a * x[i] + b * y[i] + c * z[i] for i in range(3))


def _subtract(a: Triple, b: Triple) -> Triple:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _quadruple(state: Sequence[Scalar]) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    x, y, z, w = state[:4]
    return x, y, z, w


def _length(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.sum(vectors * vectors, axis=-1)))


def _stack(t: Array, tree: Any) -> Array:
    """Stack nested triples of columns behind the axes of t; the result is read-only."""
    if isinstance(tree, (list, tuple)):
        array = np.stack([_stack(t, branch) for branch in tree], axis=t.ndim)
    else:
        array = np.array(np.broadcast_to(tree, t.shape), dtype=float)
    array.setflags(write=False)
    return array
