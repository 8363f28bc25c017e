# SPDX-License-Identifier: Apache-2.0
"""certify(): how far the motion of a scene can be from the one that `simulate` gives, proven.

Numbers of a scene, its start and its torques are taken as exact, or as anything in a range that is
given. What is made from them (unit vectors, the posture at the start) is enclosed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from decimal import Decimal
from functools import cached_property
from itertools import groupby, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.model import limits_of
from sst_ros.dynamics.motion_table import JOINTS
from sst_ros.dynamics.traced_dynamics import MOTION, TORQUE, Dynamics
from sst_ros.errors import check_kinds, refusal, refuse_unless, require
from sst_ros.host.output import Bar
from sst_ros.mechanism.generic_math import cross3, dot3, quaternion_product, triple
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.programs.expression import Expression, mark_present, trace
from sst_ros.proof import enclosure
from sst_ros.proof.enclosure import (
    Advance,
    Function,
    Refused,
    Region,
    arb,
    arb_mat,
    arb_poly,
    between,
    column,
    cut,
    entries,
    magnitude,
    norm,
    upper,
)
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Place, leaves, rebuild, walk
from sst_ros.scene.torque_profile import FunctionTorque, LostTorque, SineTorque, TorqueProfile
from sst_ros.scene.yaml_document import find_fields
from sst_ros.simulation.simulate import TorqueInput, simulate
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import NANOSECONDS, Explained, clamp

Span = tuple[float, float, int]  # begin, end, sign of a number in between; 0 where not known
PARALLEL = "parallel singularity, det J2 = 0"
LIMIT_ORDER, SPLITS = 6, 200  # of expansions whose signs say where limits are; of a step there
TURN, REST = ("turn_x", "turn_y", "turn_z"), (0.0, 0.0, 0.0)
ATTEMPTS = 3
_PHYSICAL = (
    "star", "actuated_links", "intermediate_links", "payload", "gravity", "moment", "friction",
    "springs", "own_loads", "actuators",
)  # fmt: skip
"""Parts of a scene that the equations have numbers from."""


class _Axes(NamedTuple):
    """The arrays of `Geometry`, as balls or symbols."""

    v: Any
    w: Any
    e: Any
    arc: Any
    beta_max: Any

    def of_leg(self, name: str, k: int) -> Any:
        return getattr(self, name)[k]


def _axes_of(scene: Scene) -> _Axes:
    v = [triple(arb(x) / norm(list(map(arb, row))) for x in row) for row in scene.base.v]
    pairs = [(v[k], v[(k + 1) % 3]) for k in range(3)]
    normals = [cross3(*pair) for pair in pairs]
    turn = arb.pi() / 180
    first, second, _ = (turn * x for x in scene.star.alpha_deg)
    return _Axes(
        tuple(v),
        tuple(triple(x / norm(n) for x in n) for n in normals),
        tuple((-x.sin(), x.cos(), arb(0)) for x in (arb(0), first, first + second)),
        tuple(arb.atan2(norm(n), dot3(*pair)) for n, pair in zip(normals, pairs, strict=True)),
        turn * scene.workspace.beta_max_deg,
    )


class _Equations:
    """A scene on balls; the state has its numbers that are ranges at the end, for they are inputs.

    A ball is added to a number as radius where its place is in `ranges`.
    """

    def __init__(self, scene: Scene, profile: TorqueProfile, ranges: Mapping[Place, float]) -> None:
        self.scene, self.profile, self.state = scene, profile, Dynamics.of(scene).state
        numbers = leaves(scene)
        self.ranges = {place: arb(numbers[place], radius) for place, radius in ranges.items()}
        self.varied = [place for place in ranges if place[0] != "initial"]
        self.inputs = (*self.state, *(f"p{i}" for i in range(len(self.varied))))
        self._axes = _axes_of(scene)
        axes = {place: x for place, x in walk(self._axes) if isinstance(x, arb)}
        self._folded = {place: float(x) for place, x in axes.items() if x in (-1, 0, 1)}
        present = (p for p, x in numbers.items() if p[0] in _PHYSICAL and x and p not in ranges)
        self._constants = {place: arb(numbers[place]) for place in present}
        self._constants |= {p: x for p, x in axes.items() if p not in self._folded}

    def compile(
        self, function: Callable[..., Any], inputs: Sequence[str], by: Sequence[str] = ()
    ) -> Function:
        """Compile function(model, *inputs), with derivatives by some inputs."""
        size, first = len(inputs), len(self.state)

        def traced(*values: Any) -> Any:
            given = dict(zip(self._constants, values[size:], strict=True)) | self._folded
            if inputs[: len(self.inputs)] == self.inputs:
                given |= zip(self.varied, values[first : len(self.inputs)], strict=True)
            numbers = {place: mark_present(x) for place, x in given.items()}
            axes: Any = rebuild(self._axes, numbers)
            model: Any = kernel.model_of(rebuild(self.scene, numbers), axes)
            parts = {p: mark_present(x) for p, x in walk(model) if isinstance(x, Expression)}
            return function(rebuild(model, parts), *values[:size])

        program = trace(traced, (*inputs, *(f"c{i}" for i in range(len(self._constants)))), by)
        return enclosure.compile_on_balls(program, list(self._constants.values()))

    def start(self) -> Region:
        """Enclose the start by Krawczyk's test; Refused: it is not proven to be the only one."""
        x, y, z, w, *_ = start_of(self.scene)
        initial = leaves(self.scene.initial)
        gamma, gamma_dot = (
            [self.ranges.get(("initial", name, k), arb(initial[name, k])) for k in range(3)]
            for name in ("gamma", "gamma_dot")
        )

        def turned(a: Any, b: Any, c: Any) -> Any:
            return quaternion_product((x, y, z, w), (a, b, c, 1.0))

        def angles(model: Any, *turn: Any) -> Any:
            legs = kernel.leg_motions(model, (*turned(*turn), *REST))
            return [kernel.joint_angle(at, 0) for at in legs]

        run = self.compile(angles, TURN, TURN)

        def at(turn: Any) -> tuple[Any, Any]:  # how far gamma is off, and its derivatives
            found = run(*entries(turn))
            off = [arb(x) - angle for x, angle in zip(found, gamma, strict=False)]
            slopes = [[found[3 + 3 * j + i] for j in range(3)] for i in range(3)]
            return column(off), arb_mat(slopes)

        middle = column([0] * 3)
        for _ in range(5):  # Newton
            off, slopes = at(middle)
            inverse = slopes.mid().inv().mid()
            middle = (middle - inverse * off).mid()
        step = inverse * at(middle)[0]
        least = arb(2) ** (8 - enclosure.PRECISION)
        radii = [(4 * x + least).upper() for x in entries(magnitude(step))]
        box = column([arb(m, r) for m, r in zip(entries(middle), radii, strict=True)])
        image = entries(middle - step - (inverse * at(box)[1] - 1) * (box - middle))
        if not all(b.contains_interior(t) for b, t in zip(entries(box), image, strict=True)):
            raise Refused("the posture at the start is not proven to be the only one near")
        q, rate = turned(*image), [arb(0)] * 3
        if not all(x == 0 for x in gamma_dot):
            legs = self.compile(
                lambda model, *y: [x for at in kernel.leg_motions(model, y) for x in at.g], MOTION
            )
            g = [arb(x) for x in legs(*q, *rate)]
            rate = entries(arb_mat([g[:3], g[3:6], g[6:]]).solve(column(gamma_dot)))
        lagged = [arb(0)] * (len(self.state) - 7)
        return Region.box(0.0, [*q, *rate, *lagged, *(self.ranges[p] for p in self.varied)])

    @cached_property
    def _derivatives(self) -> tuple[Function, Function]:
        size, inputs = len(self.state), (*self.inputs, *TORQUE)

        def derivative(model: Any, *given: Any) -> Any:
            slope = kernel.derivative(model, given[:size], triple(given[-3:]))
            return (*slope, *[0.0] * len(self.varied))

        return self.compile(derivative, inputs), self.compile(derivative, inputs, self.inputs)

    def between(self, begin: float, end: float) -> tuple[Function, Function]:
        """Return the derivative, and it with the Jacobian, of time and state between two kinks."""
        acting, limit = self.profile.acting(begin, end), self.scene.torque_limit

        def torque(t: Any) -> Sequence[Any]:
            if isinstance(acting, SineTorque):
                rows = zip(acting.amplitude, acting.frequency, acting.phase, strict=True)
                found: Any = [(f * t + p).sin() * a if a else 0.0 for a, f, p in rows]
            elif callable(acting):
                found = acting(t)
            else:
                return clamp(acting, limit)
            if limit is None:
                return list(found)
            return [limit - cut(2 * limit - cut(x + limit)) for x in found]

        f, jacobian = self._derivatives
        return (lambda t, *y: f(*y, *torque(t))), (lambda t, *y: jacobian(*y, *torque(t)))

    @cached_property
    def joints(self) -> Function:
        """Angles and rates of the joints, 18 numbers, and their derivatives by quaternion and W."""
        return self.compile(
            lambda model, *y: [x for row in kernel.joints(model, y) for x in row], MOTION, MOTION
        )

    @cached_property
    def limits(self) -> tuple[list[str], Function]:
        """Names of limits, and numbers of time and state that are zero there, positive inside."""
        stop = SimpleNamespace(at_end="stop", at_edge="stop")
        found = limits_of(SimpleNamespace(stroke=stop, workspace=stop), Geometry.of(self.scene))
        ends = {0: self._axes.arc, 2: [self._axes.beta_max] * 3}  # enclosed, unlike those of floats
        limits = [
            limit._replace(end=ends[limit.joint // 3][limit.joint % 3])
            if limit.sign < 0 and limit.joint // 3 in ends
            else limit
            for limit in found
        ]

        def watch(model: Any, *y: Any) -> Any:
            legs = list(kernel.leg_motions(model, y))
            first, *others = (at.g for at in legs)
            angles = (kernel.joint_angle(at, kind) for kind in range(3) for at in legs)
            return (*angles, dot3(first, cross3(*others)))

        run = self.compile(watch, MOTION)

        def distances(_: Any, *y: Any) -> list[Any]:
            *angles, determinant = run(*y[:7])
            return [*(limit.distance(angles) for limit in limits), determinant]

        return [*(limit.reason for limit in limits), PARALLEL], distances


class ProvenMotion(Explained):
    """What is proven of a motion at the instants of a table.

    Attributes:
        scene: what moves.
        columns: by name, shape (n,): t [s], none later than `until`; quaternion_x to _w, an
            orientation, and angle [rad], how far the true one can be from it; body_rate_x to _z
            [rad/s] and gamma_1 to beta_dot_3 [rad, rad/s], each with NAME_bound; distance [rad],
            the most between the true orientation and that of `simulate`.
        until: time to which the motion is proven to exist and to be within the bounds [s].
        reason: why it ends there; "" where that is the duration.
        limits: for each limit of the mechanism the spans of time [s] in which the motion may be on
            it; at all other times until `until` it is proven not to be.
        trajectory: what `simulate` gives.
        bound: what the angle was to be at most [rad].
        steps: number of steps of the proof.

    """

    def __init__(self, equations: _Equations, bound: float, trajectory: Trajectory) -> None:
        self.scene, self.bound, self._equations = equations.scene, bound, equations
        self.until, self.reason, self.steps, self.trajectory = 0.0, "", 0, trajectory
        self._times, self._rows = trajectory.t.tolist(), list[list[float]]()
        self._signs: dict[str, list[Span]] = {name: [] for name in equations.limits[0]}
        stops = limits_of(equations.scene, Geometry.of(equations.scene))
        self._stops = {limit.reason for limit in stops}

    def _follow(self, breaks: Sequence[float], tolerance: float, max_steps: int, bar: Bar) -> None:
        """Prove step by step from one break in time to the next, as far as that goes."""
        order = max(14, math.ceil(-1.2 * math.log10(tolerance)))
        try:
            here = self._equations.start()
            for begin, end in pairwise(breaks):
                f, jacobian = self._equations.between(begin, end)
                for step in enclosure.enclose(f, jacobian, here, end, tolerance, order):
                    self._take(step)
                    bar.draw(step.end / breaks[-1])
                    if self.reason:
                        return
                    if self.steps >= max_steps and step.end < breaks[-1]:
                        raise Refused(f"{max_steps} steps are not enough")
                here = enclosure.region_at_end(step)
        except Refused as refused:
            self.reason = str(refused)
        finally:
            self._finish()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or another process gets: all but the equations on balls."""
        return vars(self) | {"_equations": None}

    def _take(self, step: Advance) -> None:
        """Take what a step proves, up to where the motion meets an end of the scene."""
        self.steps, end = self.steps + 1, step.end
        names, run = self._equations.limits
        for low, high, signs in _signs(step, run, len(names)):
            for name, sign in zip(names, signs, strict=True):
                self._signs[name].append((low, high, sign))
                if name in self._stops and sign <= 0 and low < end:
                    self.reason, end = name, low
        self.until = end
        while self._times and self._times[0] <= end:
            self._rows.append(self._row(step, self._times.pop(0)))

    def _row(self, step: Advance, time: float) -> list[float]:
        p, e = step.at(time)
        box = [arb(x, r) for x, r in zip(p[:7], e, strict=False)]
        joints, slopes = (self._equations.joints(*y) for y in (p[:7], box))
        by = [[slopes[18 + 18 * j + i] for j in range(7)] + [0] * (len(p) - 7) for i in range(18)]
        found = [*zip(p[4:7], e[4:7], strict=True)]
        found += zip(joints, step.at(time, arb_mat(by))[1], strict=False)
        pairs = [(float(x), upper(abs(x - float(x)) + r)) for x, r in found]
        wrong, q = norm(e[:4]) / norm(p[:4]), [float(x / norm(p[:4])) for x in p[:4]]
        others = q, self.trajectory.quaternion[len(self._rows)].tolist()
        known = wrong < 1
        angle = [2 * wrong.asin() + _turn(p[:4], q) if known else arb.pi() for q in others]
        return [time, *q, *map(upper, angle), *(x for pair in pairs for x in pair)]

    def _finish(self) -> None:
        names = [*(f"body_rate_{part}" for part in "xyz")]
        names += [f"{joint}_{leg}" for joint in JOINTS for leg in (1, 2, 3)]
        heads = ["t", *(f"quaternion_{part}" for part in "xyzw"), "angle", "distance"]
        heads += [name + more for name in names for more in ("", "_bound")]
        table = np.array(self._rows).reshape(-1, len(heads))
        table.flags.writeable = False
        self.columns: dict[str, Array] = dict(zip(heads, table.T, strict=True))
        self.limits: dict[str, list[tuple[float, float]]] = {}
        for name, known in self._signs.items():
            groups = (list(spans) for _, spans in groupby(known, lambda span: span[2]))
            unknown = (spans for spans in groups if spans[0][2] == 0 and spans[0][0] <= self.until)
            self.limits[name] = [(spans[0][0], spans[-1][1]) for spans in unknown]

    @property
    def largest(self) -> float:
        """Largest angle between true orientation and that of the table [rad]; inf without one."""
        return float(np.max(self.columns["angle"], initial=0.0 if self._rows else math.inf))

    @property
    def error(self) -> float:
        """Largest distance of `simulate` from the true motion [rad]; inf without one."""
        return float(np.max(self.columns["distance"], initial=0.0 if self._rows else math.inf))

    @property
    def success(self) -> bool:
        """Whether the motion is proven to its end, within the bound asked for."""
        ended = not self.reason or self.reason in self._stops
        return ended and self.largest <= self.bound

    def to_pandas(self) -> Any:
        """Table of `columns`."""
        return require("pandas").DataFrame(self.columns)

    def _facts(self) -> dict[str, object]:
        met = [f"{name}: {a:.12g} to {b:.12g} s" for name, x in self.limits.items() for a, b in x]
        until = f"to {self.until:.12g} s" + f": {self.reason}" * bool(self.reason)
        facts: dict[str, object] = {"scene": self.scene.name, "proven": until}
        if self._rows:
            estimate = self.trajectory.error_estimate
            facts["orientation"] = f"within {self.largest:.2g} rad of the table"
            facts["error of simulate"] = (
                f"below {self.error:.2g} rad; its estimate is {estimate:.2g} rad"
            )
            facts["limits"] = met or "no limit is reached and no singularity is passed"
        return facts | {"steps": self.steps}


def _turn(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """Angle of the rotation between quaternions, as a ball [rad]."""
    pairs = [(x / norm(a), arb(y) / norm(list(map(arb, b)))) for x, y in zip(a, b, strict=True)]
    chords = (norm([x - sign * y for x, y in pairs]) for sign in (1, -1))
    return 4 * (min(chords, key=float) / 2).asin()


def _signs(
    step: Advance, run: Function, count: int
) -> Iterator[tuple[float, float, Sequence[int]]]:
    """Split a step into spans of time in which numbers are > 0 (1), < 0 (-1), or unknown (0)."""
    begin, left = step.begin.time, SPLITS
    todo = [(begin, step.end)]
    while todo:
        low, high = todo.pop()
        span, left, signs = (arb(low) - begin, arb(high) - begin), left - 1, [0] * count
        near = between(span[0] - span[1], span[1] - span[0]) / 2
        with suppress(ArithmeticError, ValueError):  # a division by what may be zero
            rows = step.enclose(run, LIMIT_ORDER, step.tube, span)
            values = [arb_poly(row)(near) for row in rows]
            signs = [int(bool(x > 0)) - int(bool(x < 0)) for x in values]
        if all(signs) or left < 0 or high - low < 1e-10 * (step.end - begin):
            yield low, high, signs
        else:
            todo += [(0.5 * (low + high), high), (low, 0.5 * (low + high))]


@check_kinds
def certify(
    scene: Scene | Mapping[str, Any] | str | Path,
    torque: TorqueInput = None,
    duration: float | None = None,
    *,
    bound: float = 1e-9,
    ranges: Mapping[str, float | str] | None = None,
    max_steps: int = 100_000,
    progress: bool = False,
    **options: Any,
) -> ProvenMotion:
    """Enclose the true motion of a scene, and bound the error of `simulate`, with proof.

    Numbers are taken as exact, or as anything in a range; rounding is outward. The proof ends where
    a term has a kink (a contact, a torque at its limit), where the motion meets an end of the
    scene, or where no step is proven: `until` and `reason` say so.

    Args:
        scene: as `simulate` takes it.
        torque: as `simulate` takes it, but for functions.
        duration: as `simulate` takes it.
        bound: angle [rad] within which the orientation is to be proven; steps are chosen for it.
        ranges: how far numbers of the scene may be from those given, by key, as in
            {"star.inertia.zz": 5e-4, "initial.gamma": 1e-6}; "digits" for half a unit of the last
            digit that a number has. Keys may name bodies, loads, and initial angles and rates.
        max_steps: number of steps after which the proof ends, some 20 ms each.
        progress: draw a bar on a terminal.
        options: of `simulate`, as initial, method, tolerance, and t_eval, the times of the table.

    Raises:
        InputError: an argument is not allowed; names it and the allowed values.
        AssemblyError, SingularConfiguration: as `simulate`.
        MissingDependency: python-flint is not installed.

    """
    trajectory = simulate(scene, torque, duration, **options)
    given, profile, end = trajectory.scene, trajectory.law, duration or trajectory.scene.duration
    known = profile is not None and not isinstance(profile, (FunctionTorque, LostTorque))
    refuse_unless(
        "certify",
        ("torque", torque, known, "must be numbers, sines, a table or polynomials"),
        ("bound", bound, 0.0 < bound < math.inf, "must be a number > 0 [rad]"),
        ("max_steps", max_steps, max_steps > 0, "must be > 0"),
    )
    assert profile is not None and end is not None
    end, kinks, tolerance = round(end * NANOSECONDS) / NANOSECONDS, profile.kinks(), 1e-6 * bound
    breaks = [0.0, *np.unique(kinks[(kinks > 0.0) & (kinks < end)]).tolist(), end]
    places = _places(given, ranges or {})
    with enclosure.precision():
        equations = _Equations(given, profile, places)
        for _ in range(ATTEMPTS):
            found = ProvenMotion(equations, bound, trajectory)
            found._follow(breaks, tolerance, max_steps, Bar("certify", progress))
            if found.largest <= bound or places or found.largest == math.inf:
                break
            tolerance *= 0.1 * bound / found.largest
        return found


def _places(scene: Scene, ranges: Mapping[str, float | str]) -> dict[Place, float]:
    """Return the half width of each number that is a range."""
    places, numbers = dict[Place, float](), leaves(scene)
    for key, width in ranges.items():
        try:
            named = [place for place, _, _ in find_fields(scene, key, components=True)]
        except ValueError as error:
            raise refusal("certify", "ranges", key, str(error)) from None
        below = [p for p in numbers if any(p[: len(place)] == place for place in named)]
        known = all(p[0] in _PHYSICAL or p[1:2] in (("gamma",), ("gamma_dot",)) for p in below)
        good = width == "digits" or (isinstance(width, (int, float)) and 0.0 <= width < math.inf)
        refuse_unless(
            "certify",
            ("ranges", key, bool(below) and known, "must name bodies, loads or the start"),
            (f"ranges[{key}]", width, good, "must be a number >= 0, or 'digits'"),
        )
        for place in below:
            last = Decimal(repr(numbers[place])).as_tuple().exponent
            places[place] = 0.5 * 10.0 ** int(last) if width == "digits" else float(width)
    return places
