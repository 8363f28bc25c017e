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
from sst_ros.dynamics.model import LEGS, Model, actuated_inertia
from sst_ros.dynamics.traced_dynamics import (
    BODY_ACCELERATION,
    MOTION,
    STATE_SIZE,
    TORQUE_SYMBOLS,
    Dynamics,
    Function,
    parameter_symbols,
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
    subtract,
    symmetric_rows,
    transform,
    triple,
)
from sst_ros.mechanism.geometry import Array
from sst_ros.programs.expression import (
    compile_for_arrays,
    compile_program,
    divide,
    mark_present,
    trace,
)
from sst_ros.scene.bodies import entries_of
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import leaves, rebuild
from sst_ros.state import STAR_RATE, ZERO, Explained, cached_property

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
    value_axes = tuple(range(t.ndim, values.ndim))
    times = np.broadcast_to(np.expand_dims(t, value_axes), values.shape)
    when = np.take_along_axis(times, row[None], axis=0)[0]
    span = times[-1] - times[0]
    intervals = np.diff(times, axis=0)
    first, last = values[:-1], values[1:]
    # three times the mean square of the line between two samples
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
    x, y, z, w = quaternion.T
    state = (x, y, z, w, *body_rate.T)
    with np.errstate(all="ignore"):
        legs = _legs(scene, Dynamics.of(scene).model, state, triple(torque.T))
    return _collect(t, _flatten(legs), rotation_rows((x, y, z, w)))


def reaction_at(scene: Scene, joint: str, leg: int) -> Function:
    """Return a function for what one joint exerts on the link that is nearer the star.

    Its six results are the force through O [N] and the moment about O [N m] in the axes
    of the joint's frame, see `JointLoads`. Its 13 arguments are the quaternion
    (x, y, z, w), the body rate [rad/s], the torques that act at the actuators [N m] and
    the angular acceleration in {E} [rad/s^2].

    Args:
        scene: what moves.
        joint: one of LINK_JOINTS.
        leg: 0, 1 or 2.

    """
    model = Dynamics.of(scene).model

    def wrench(*inputs: Any) -> tuple[Scalar, ...]:
        state, drive = inputs[:STATE_SIZE], inputs[STATE_SIZE:]
        torque, acceleration = triple(drive[:LEGS]), triple(drive[LEGS:])
        legs = _solve(scene, model, state, acceleration, torque)
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
        names = (*MOTION, *TORQUE_SYMBOLS, *parameter_symbols(len(columns)))

        def run(*inputs: Any) -> list[Any]:
            sizes = {"state": STATE_SIZE, "torque": LEGS, "columns": len(columns)}
            of = divide(sizes, inputs)
            symbols = dict(zip(columns, map(mark_present, of["columns"]), strict=True))
            own_scene, own_model = rebuild(tree, symbols)
            torque = triple(of["torque"])
            return _flatten(_legs(own_scene, own_model, of["state"], torque))

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
        q, _ = kernel.split_motion(list(state))
        return _collect(t, list(numbers), rotation_rows(q))


def _legs(
    scene: Any, model: Model, state: Sequence[Scalar], torque: Triple
) -> list[_LegReactions]:
    """Solve for the reactions of the legs under torques that act."""
    without_lag = model._replace(time_constant=None)  # these torques act already
    slope = kernel.derivative(without_lag, tuple(state), torque)
    return _solve(scene, model, state, triple(slope[STAR_RATE]), torque)


def _flatten(tree: Any) -> list[Scalar]:
    """List the numbers of nested tuples in order."""
    if isinstance(tree, (list, tuple)):
        return [number for branch in tree for number in _flatten(branch)]
    return [tree]


def _collect(t: Array, numbers: Sequence[Scalar], rows: Rows) -> Reactions:
    """Make reactions of the 36 numbers of each leg, which `_flatten` lists."""
    of_legs = _stack(t, numbers).reshape(*t.shape, LEGS, -1, 3)
    # First a force and a moment of each joint, then the axes of both frames in {E}.
    wrench_rows = 2 * len(LINK_JOINTS)
    wrenches, axes = np.split(of_legs, [wrench_rows], axis=-2)
    joints: dict[str, Any] = {}
    for index, name in enumerate(LINK_JOINTS):
        force = wrenches[..., 2 * index, :]
        moment = wrenches[..., 2 * index + 1, :]
        joints[name] = JointLoads(force, moment, AXES[name])
    by_frame = axes.reshape(*t.shape, LEGS, 2, 3, 3)
    frames = _stack(t, rows)[..., None, None, :, :] @ np.swapaxes(by_frame, -1, -2)
    frames.setflags(write=False)
    first, second = frames[..., 0, :, :], frames[..., 1, :, :]
    return Reactions(t=t, **joints, actuated_frames=first, intermediate_frames=second)


class _Wrench(NamedTuple):
    """A force through O [N] and a moment about O [N m]."""

    force: Triple
    moment: Triple

    def plus(self, wrench: _Wrench) -> _Wrench:
        """Return the sum of two wrenches."""
        force = add(self.force, wrench.force)
        return _Wrench(force, add(self.moment, wrench.moment))

    def along(self, axes: Rows) -> _Wrench:
        """Return the components along axes."""
        return _Wrench(transform(axes, self.force), transform(axes, self.moment))


class _LegReactions(NamedTuple):
    """What the joints of a leg transmit, in the axes of their frames.

    Then the axes of {1k} and {2k} in {E}.
    """

    actuated: _Wrench
    revolute: _Wrench
    prismatic: _Wrench
    first: Rows
    second: Rows


class _Turning(NamedTuple):
    """How a body turns, and the field that it is in, in {E}."""

    field: Triple  # acceleration of free fall [m/s^2]
    rate: Triple  # angular velocity [rad/s]
    acceleration: Triple  # angular acceleration [rad/s^2]


def _solve(
    scene: Any,
    model: Model,
    state: Sequence[Scalar],
    acceleration: Triple,
    torque: Triple,
) -> list[_LegReactions]:
    """Solve the balances of all links, leg by leg, in {E}."""
    q, rate = kernel.split_motion(state)
    rows = rotation_rows(q)
    field = ZERO if model.gravity is None else rotate_back(rows, model.gravity)
    turning = _Turning(field, rate, acceleration)
    motions = list(kernel.leg_motions(model, state))
    own = kernel.own_torques(model, rows, rate) if model.own_loads else None
    star = _star_needs(scene, model, turning)
    legs = []
    for k, (motion, drive) in enumerate(zip(motions, torque, strict=True)):
        loads = _joint_loads(motion)
        if own is not None:
            loads = add(loads, own.joints[k])
        legs.append(_Leg.of(scene, k, motion, turning, drive, loads))
    # Least sum of squares of the forces x, x + b and x + b + a of each leg, whose x
    # make up the star's: 3 x + 2 b + a is the same in all legs.
    spread = [add(multiply(2.0, leg.link.force), leg.drive.force) for leg in legs]
    first, second, third = spread
    mean = multiply(1.0 / 3.0, add(add(first, second), third))
    reactions = []
    for leg, own_spread in zip(legs, spread, strict=True):
        share = add(star.force, subtract(mean, own_spread))
        reactions.append(leg.express(multiply(1.0 / 3.0, share)))
    return reactions


class _Leg(NamedTuple):
    """One leg: its frames in {E}, what its links need, and its moment on the star."""

    first: Rows
    second: Rows
    drive: _Wrench
    link: _Wrench
    moment: Triple

    @classmethod
    def of(
        cls,
        scene: Any,
        k: int,
        motion: LegMotion,
        star: _Turning,
        torque: Scalar,
        loads: Triple,
    ) -> _Leg:
        """Solve the moments of leg k under its actuator's torque and joint loads."""
        root = sqrt(motion.u)  # c_k = (r x t).w = sin(mu_k)
        r = triple(component / root for component in motion.p)
        t = motion.along
        w = motion.axis
        across = cross3(w, r)
        first = (r, across, w)
        second = (r, cross3(t, r), t)
        _, gamma_rest = kernel.rest_accelerations(motion, star.rate)
        gamma_ddot = dot3(motion.g, star.acceleration) + gamma_rest
        mu_dot = -motion.a_dot / root
        t_dot = cross3(star.rate, t)
        products = motion.gamma_dot * mu_dot + motion.beta_dot * dot3(across, t_dot)
        beta_ddot = -(dot3(across, star.acceleration) + products) / root  # Eq. 46
        # omega of the star is that of the intermediate link - t beta_dot, and t turns
        # with it.
        slide = add(multiply(beta_ddot, t), multiply(motion.beta_dot, t_dot))
        link_turning = _Turning(
            field=star.field,
            rate=add(star.rate, multiply(motion.beta_dot, t)),
            acceleration=add(star.acceleration, slide),
        )
        link = scene.intermediate_links[k]
        link_needs = _link_needs(link, entries_of(link.inertia), second, link_turning)
        inertia = actuated_inertia(scene, k)
        drive_turning = _Turning(
            field=star.field,
            rate=multiply(motion.gamma_dot, w),
            acceleration=multiply(gamma_ddot, w),
        )
        drive = scene.actuated_links[k]
        drive_needs = _link_needs(drive, inertia, first, drive_turning)
        # t.m, r.(m + B) and w.(m + B + A) are known, see above.
        at_gamma, at_mu, at_beta = loads
        needs = link_needs.moment
        along_t = -at_beta
        along_r = -at_mu - dot3(r, needs)
        along_w = torque + at_gamma - dot3(w, add(needs, drive_needs.moment))
        normal = cross3(r, t)
        along_normal = (along_w - motion.a * along_t) / root
        moment = add(multiply(along_r, r), multiply(along_normal, normal))
        moment = add(moment, multiply(along_t, t))
        return cls(first, second, drive_needs, link_needs, moment)

    def express(self, force: Triple) -> _LegReactions:
        """Return what the joints transmit if the leg exerts this force on the star."""
        on_star = _Wrench(force, self.moment)
        on_link = on_star.plus(self.link)
        on_drive = on_link.plus(self.drive)
        return _LegReactions(
            actuated=on_drive.along(self.first),
            revolute=on_link.along(self.second),
            prismatic=on_star.along(self.second),
            first=self.first,
            second=self.second,
        )


def _joint_loads(motion: LegMotion) -> Triple:
    """Torques of friction, springs and stops, not of weights, at the joints [N m]."""
    weightless = motion._replace(leg=motion.leg._replace(drive=ZERO, link=ZERO))
    return kernel.joint_torques(weightless, ZERO)


def _star_needs(scene: Any, model: Model, turning: _Turning) -> _Wrench:
    """Return what the star with its payload needs; its frame is {E}."""
    entries = entries_of(scene.star.inertia)
    mass = scene.star.mass
    if scene.payload is not None:
        pairs = zip(entries, scene.payload.entries, strict=True)
        entries = [own + carried for own, carried in pairs]
        mass = mass + scene.payload.mass
    axes: Rows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    return _needs(entries, mass, model.weight, axes, turning)


def _link_needs(
    link: Any, inertia: Sequence[Scalar], axes: Rows, turning: _Turning
) -> _Wrench:
    """Return what a link with this inertia needs; its centre is in its own axes."""
    weight = rotate_back(axes, multiply(link.mass, link.centre))
    return _needs(inertia, link.mass, weight, axes, turning)


def _needs(
    inertia: Sequence[Scalar],
    mass: Scalar,
    weight: Triple,
    axes: Rows,
    turning: _Turning,
) -> _Wrench:
    """Return the rates of change of a body's momenta, less what its weight does.

    The body turns about O. Its inertia (xx, yy, zz, xy, xz, yz) is about O in its own
    axes; `weight`, mass times centre, is in {E}.
    """
    field, rate, acceleration = turning
    xx, yy, zz, xy, xz, yz = inertia
    tensor = symmetric_rows((xx, yy, zz, xy, xz, yz))
    spin = transform(axes, rate)
    spin_dot = transform(axes, acceleration)
    momentum = transform(tensor, spin)
    change = add(transform(tensor, spin_dot), cross3(spin, momentum))
    moment = subtract(rotate_back(axes, change), cross3(weight, field))
    towards = add(cross3(acceleration, weight), cross3(rate, cross3(rate, weight)))
    return _Wrench(subtract(towards, multiply(mass, field)), moment)


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
