# SPDX-License-Identifier: Apache-2.0
"""Gauss collocation whose nodes are the lanes of a SIMD loop: whole motions in few long steps.

A step puts a polynomial through the accelerations at the Gauss nodes (order 2 s with s nodes). Its
equations are solved by fixed-point iteration (Picard; van der Houwen & Sommeijer, J. Comput. Appl.
Math. 29 (1990) 111-127): all s accelerations are evaluated at once, which costs a compiler with
SIMD little more than one. The first evaluation of a step is at the state of its beginning, where
only time differs from lane to lane. Steps have one length and no memory of each other. Not for
stiff scenes, nor for torques that jump, nor for contacts.
"""

from __future__ import annotations

import inspect
import math
import re
import threading
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.polynomial import legendre

from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.model import Limit, limits_of
from sst_ros.dynamics.traced_dynamics import MOTION, ODE, Dynamics, limit_distances
from sst_ros.host import compiled_module
from sst_ros.integration.compiled_method import estimate_error, orientation_distance, state_distance
from sst_ros.integration.propagator import first_event
from sst_ros.integration.simd_source import (
    Layout,
    assign_once,
    evaluate_lanes,
    flat_sin,
    indent,
    loop,
    put,
)
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.programs.expression import Program, Slots, number_constants, trace
from sst_ros.scene.torque_profile import ConstantTorque, SineTorque
from sst_ros.simulation.stepped_motion import Task
from sst_ros.simulation.trajectory import Trajectory, check_error
from sst_ros.state import clamp

GAUSS = "gauss"

NODES = 8
"""Of a step, two registers of AVX2; the order is 16."""
_NEAR = 0.05
"""Distance above which no limit is met between nodes that resolve the motion to the tolerance."""
_HOPELESS, _SLOW = 128, 4.0
"""Steps from which on doubling them must bring two solutions of `auto` nearer by this factor:
smooth motions gain far more, those with kinks a factor of two."""
_FINEST_PER_SECOND, _FINEST = 1024, 4096
"""Steps a second beyond which `auto` turns to methods with error control, and the most of all."""
_ITERATIONS, _MOST_ITERATIONS = (5, 6, 8), 10
_ROUNDING = 1e-14
"""Least distance in the search."""
_WORTH_LOADING, _WORTH_COMPILING = 20_000, 300_000
"""Evaluations in plain Python that take as long as numba to load machine code, and to make it."""
_EVALUATIONS: Counter[str] = Counter()
"""In plain Python, by the text of the code, which all scenes of one structure share."""


class NotSmooth(ArithmeticError):
    """Collocation does not reach the tolerance with steps worth taking."""


class CollocatedMotion:
    """The motion of a task by collocation, prepared once, for several threads.

    Where the task names the method it is compiled, tries hard, and keeps the finest motion if the
    tolerance is not met. The error of the orientation at the end is twice the distance of a
    solution by steps of half the length, at least rounding. NotSmooth says why a motion is not one
    for collocation.
    """

    def __init__(self, task: Task) -> None:
        self._sine, held = _choose_torque(task)
        self._task, self._asked, scene = task, task.method == GAUSS, task.scene
        self._dynamics, self._lock = Dynamics.of(scene), threading.Lock()
        self._limits = tuple(limits_of(scene, Geometry.of(scene)))
        self._method = _collocation(self._dynamics, self._sine, self._limits, self._asked or None)
        self._start = [*start_of(scene), *(0.0 for _ in self._dynamics.state[7:])]
        self._drive = [*held, *(0.0 for _ in self._dynamics.drive[3:])]
        self._end = task.span[1]
        self._count, self._iterations, self._error = self._choose_steps(task.tolerance)
        self._h = self._end / self._count
        self._grid: Array = np.append(np.arange(float(self._count)) * self._h, self._end)
        self._motion = self._prepare(self._method, self._count, self._iterations)
        self._single = self._prepare(self._method, 1, self._iterations + 1)
        self._states = self.compute()
        self._met, times = self._find_limit(), task.times
        if self._met:
            times = np.append(times[times < self._end], self._end)
        self._repeat = self._trajectory(times).repeater()

    def compute(self) -> Array:
        """Compute the states at the ends of the steps, shape (steps + 1, numbers of the state)."""
        with self._lock:
            self._motion.run()
            y: Array = self._motion.states.copy()
            return y

    def run(self, _progress: bool = False) -> Trajectory:
        """Compute the motion, too short for a bar; its samples when they are first asked for."""
        return self._repeat(partial(self.at, self.compute()))

    def at(self, ends: Array, times: Array) -> Array:
        """States at times [s], each by one step from the beginning of its step: (m, numbers).

        `ends` are the states at the ends of the steps.
        """
        steps = np.searchsorted(self._grid, times, side="right") - 1
        pairs = zip(steps.tolist(), (times - self._grid[steps]).tolist(), strict=True)
        with self._lock:  # all of them use the same arrays
            rows = [self._inside(ends, k, x) for k, x in pairs]
        return np.array(rows).reshape(len(times), -1)

    def _inside(self, ends: Array, k: int, x: float) -> list[float]:
        """State x [s] after step k began; that of the run itself where it begins, or all end."""
        begin: list[float] = ends[k].tolist()
        if x == 0.0:
            return begin
        self._single.begin(float(self._grid[k]), x, begin, self._drive)
        self._single.run()
        end: list[float] = self._single.states[-1].tolist()
        return end

    def _find_limit(self) -> Limit | None:
        """Return the first limit that is met, if there is one; the motion ends there."""

        def joints(k: int, x: float) -> tuple[float, ...]:
            return self._dynamics.joints(*self._inside(self._states, k, x)[:7])

        if self._motion.least.min() <= _NEAR:
            for k, begin in enumerate(self._grid[:-1].tolist()):
                if met := first_event(self._limits, partial(joints, k), self._h):
                    self._end = begin + met[0]
                    return met[1]
        return None

    def _trajectory(self, t: Array) -> Trajectory:
        task, status, message = self._task, 0, "reached the end"
        if self._met:
            status, message = 1, f"stopped at t = {self._end:.12f} s: {self._met.reason}"
        status, message = check_error(self._error, task.tolerance, status, message)
        return Trajectory(
            task.scene,
            t,
            status=status,
            message=message,
            method=f"gauss, order {2 * NODES}: {self._count} steps of {self._h:.3g} s, "
            f"{self._iterations} iterations"
            + ("" if self._asked else " (auto: a smooth motion under a profile)"),
            error_estimate=self._error,
            energy_residual=self._balance_energy,
            evaluations=self._count * self._iterations * NODES,
            step=self._h,
            law=task.torque,
            dense=partial(self.at, self._states),
            parameters=task.parameters,
        )

    def _balance_energy(self) -> float:
        """Energy at the end, less that at the start, less the work done by another motion [J]."""
        method = Collocation(ODE(self._dynamics, self._sine, work=True), NODES, compiled=False)
        motion = self._prepare(method, self._count, self._iterations)
        motion.run()
        end = self.at(self._states, np.array([self._end]))[0].tolist()
        energy = self._dynamics.total_energy
        return energy(end) - energy(self._start) - float(motion.states[-1, -1])

    def _choose_steps(self, tolerance: float) -> tuple[int, int, float]:
        """Choose steps and iterations of least cost for the tolerance, and estimate their error."""
        most = _FINEST if self._asked else min(_FINEST, 16 + _FINEST_PER_SECOND * self._end)
        count, iterations, distance = 1, _MOST_ITERATIONS, math.inf
        y, z = self._solve(1), self._solve(2)
        while True:
            last, distance = distance, state_distance(y, z)
            if distance < max(_ROUNDING, 0.01 * tolerance):
                near = max(0.45 * tolerance, _ROUNDING)
                count, iterations = self._save(2 * count, z, near)
                y, z = self._solve(count, iterations), self._solve(2 * count)
                break
            slow = count >= _HOPELESS and not _SLOW * distance < last
            if 4 * count > most or (slow and not self._asked):
                break
            count, y, z = 2 * count, z, self._solve(4 * count)
        error = estimate_error(orientation_distance(y, z), count)
        if error <= tolerance or (self._asked and error < math.inf):
            return count, iterations, error
        raise NotSmooth(f"{count} steps of collocation do not reach {tolerance:g} rad")

    def _save(self, count: int, end: list[float], near: float) -> tuple[int, int]:
        """Choose the cheapest steps, fewer than `count`, and iterations that end `near` the end."""
        ladder, best, cost = [count], (count, _MOST_ITERATIONS), math.inf
        while ladder[0] > 1:
            ladder.insert(0, min(ladder[0] - 1, int(0.82 * ladder[0])))

        def reaches(steps: int, iterations: int) -> bool:
            return state_distance(self._solve(steps, iterations), end) <= near

        for iterations in _ITERATIONS:
            cheaper = [steps for steps in ladder if steps * iterations < cost]
            found = bisect_left(cheaper, True, key=partial(reaches, iterations=iterations))
            if found < len(cheaper):
                best, cost = (cheaper[found], iterations), cheaper[found] * iterations
        return best

    def _solve(self, count: int, iterations: int = _MOST_ITERATIONS) -> list[float]:
        """Return quaternion and body rate at the end, infinite where they are not finite."""
        motion = self._prepare(self._method, count, iterations)
        try:
            change = motion.run()
        except (ArithmeticError, ValueError):
            change = math.inf
        return motion.states[-1, :7].tolist() if math.isfinite(change) else [math.inf] * 7

    def _prepare(self, method: Collocation, count: int, iterations: int) -> PreparedMotion:
        y = [*self._start, *(0.0 for _ in range(len(self._start), method.size))]
        motion = PreparedMotion(method, count, iterations)
        motion.begin(0.0, self._end / count, y, self._drive)
        return motion


@lru_cache(maxsize=32)
def _collocation(
    dynamics: Dynamics, sine: SineTorque | None, limits: tuple[Limit, ...], compiled: bool | None
) -> Collocation:
    pairs = tuple((math.cos(limit.end), math.sin(limit.end)) for limit in limits)
    ends = number_constants(pairs, ("ends",))
    program = trace(
        lambda *state: limit_distances(limits, ends, dynamics.numbers, state)[: len(limits)],
        MOTION,
    )
    return Collocation(ODE(dynamics, sine), NODES, limits=program, compiled=compiled)


def _choose_torque(task: Task) -> tuple[SineTorque | None, tuple[float, ...]]:
    """Return the sine that is traced into the code, and the torques that are constant."""
    law, stroke, limit = task.torque, task.scene.stroke.at_end, task.scene.torque_limit
    if len(task.breaks) or task.max_step < task.span[1]:
        raise NotSmooth("collocation takes no breaks and no max_step")
    if task.period is not None or not isinstance(law, (SineTorque, ConstantTorque)):
        raise NotSmooth("collocation takes constant torques and sines only")
    if stroke not in ("stop", "ignore"):
        raise NotSmooth(f"collocation does not take a stroke with at_end: {stroke}")
    if isinstance(law, ConstantTorque):
        return None, clamp(law.torque, limit)
    if limit is not None and max(map(abs, law.amplitude)) > limit:
        raise NotSmooth("collocation does not take a sine that the torque limit cuts")
    return law, ()


class Collocation:
    """Motions of an ODE by Gauss collocation with steps of one length.

    Args:
        ode: what is integrated.
        nodes: of a step; the order is twice as many.
        limits: `limit_distances` of the first seven numbers, monitored at all nodes, or none.
        compiled: by numba, which may multiply and add in one: the fastest. None begins in plain
            Python and goes on with machine code of the same digits as soon as that is worth it.
            With False, or where there is no numba, all is plain Python.

    """

    def __init__(
        self, ode: ODE, nodes: int, *, limits: Program | None = None, compiled: bool | None = True
    ) -> None:
        self.size, self.inputs = len(ode.state), len(ode.program.inputs)
        self._texts, self.layout, self.numbers = source(ode, nodes, limits)
        known = compiled is not False and compiled_module.numba_version() is not None
        self._ask_at = _WORTH_LOADING if known and compiled is None else math.inf
        self.code = _compile(self._texts, rounding=False) if known and compiled else None
        self.plain = compiled_module.load(self._texts, {}, numba=False).integrate

    def charge(self, evaluations: int) -> None:
        """Count evaluations in plain Python, and take machine code if that is worth it by now."""
        _EVALUATIONS[self._texts[-1]] += evaluations
        spent = _EVALUATIONS[self._texts[-1]]
        if spent > self._ask_at:
            self._ask_at = 2 * spent
            there = compiled_module.has_code(self._texts, {}, ("integrate",))
            if there or spent > _WORTH_COMPILING:
                self.code = _compile(self._texts, rounding=True)


class PreparedMotion:
    """A motion whose arrays are prepared once, to be computed any number of times.

    Attributes:
        run: compute it; returns the change of a rate [rad/s] over a step by its last iteration,
            the largest of all steps, infinite where the motion has no finite end. It takes no
            argument and, compiled, allocates nothing.
        states: where the last run began and at the ends of its steps, shape (count + 1, size).
        least: distances from each limit, the least of all steps, shape (limits, nodes).

    """

    def __init__(self, method: Collocation, count: int, iterations: int) -> None:
        self._method, at = method, method.layout
        self._evaluations = count * iterations * at.lanes
        block = np.zeros(at.numbers + 8)
        # From the begin of a cache line on, as no register then lies across two.
        block = block[-(block.ctypes.data // 8) % 8 :][: at.numbers]
        block[:2] = count, iterations
        groups = ("numbers", "begin", "node", "least")
        numbers, self._begin, self._node, least = (block[at.first(group) :] for group in groups)
        numbers[: len(method.numbers)] = method.numbers
        self.least: Array = least.reshape(-1, at.lanes)
        states = np.zeros((count + 1) * method.size)
        self.states: Array = states.reshape(-1, method.size)
        code, self._arrays = method.code, (block, states)
        self.run: Callable[[], float] = partial(code, block, states) if code else self._run_plain

    def _run_plain(self) -> Any:
        self._method.charge(self._evaluations)
        if self._method.code:
            self.run = partial(self._method.code, *self._arrays)
            return self.run()
        lists = [array.tolist() for array in self._arrays]
        change = self._method.plain(*lists)
        self._arrays[0][:], self._arrays[1][:] = lists
        return change

    def begin(self, t: float, h: float, y: Sequence[float], d: Sequence[float] = ()) -> None:
        """Set time where `run` begins and length of a step [s], the state, and a constant drive."""
        self._arrays[0][2] = h
        self._begin[: self._method.inputs] = [t, *y, *d]
        scaled = h * tables(self._method.layout.lanes)
        self._node[: scaled.size] = scaled.ravel()


@lru_cache(maxsize=16)
def tables(nodes: int) -> Array:
    """Rows: nodes, weights, columns of A, which integrates a polynomial from 0 to each node."""
    x, w = legendre.leggauss(nodes)
    inverse = np.linalg.inv(legendre.legvander(x, nodes - 1))
    integrals = legendre.legval(x, legendre.legint(np.eye(nodes), lbnd=-1)).T / 2.0
    return np.vstack([(x + 1.0) / 2.0, w / 2.0, (integrals @ inverse).T])


def _compile(texts: list[str], *, rounding: bool) -> Any:
    """Compile for two arrays: numba then need not look at the arguments in each call."""
    import numba

    integrate = compiled_module.load(texts, {}, numba=True, rounding=rounding).integrate
    array = numba.types.Array(numba.float64, 1, "C")
    integrate.compile((array, array))
    return integrate.get_overload((array, array))


def source(ode: ODE, nodes: int, limits: Program | None) -> tuple[list[str], Layout, list[float]]:
    """Texts of flat_sin and of `integrate(block, states)`, what is in `block`, and numbers in it.

    An iteration integrates the slopes at the nodes to rates, turns the quaternion with these
    rates, and evaluates. Rows of `block` are read lane by lane before a loop, since SIMD needs
    that they are the same for all lanes in it. Before a run are set its `head` (counts of steps and
    iterations, length of a step), `begin` (time, state, drive), `numbers`, and from `node` on the
    tables times the length of a step; `known` depends on time alone.

        def integrate(block, states):
            count, iterations, h = int(block[0]), int(block[1]), block[2]
            y0 = block[9]
            for step in range(count):
                begin = block[8] + step * h
                for i in range(8):
                    u0 = begin + block[88 + i]
                    block[248 + i] = 0.5 * v12
                for iteration in range(1, iterations):
                    g4_0 = block[280]
                    for i in range(8):
                        block[200 + i] = y4 + (block[104 + i] * g4_0 + block[112 + i] * g4_1)
    """
    size, inputs = len(ode.state), len(ode.program.inputs)
    slots, state = Slots(), range(1, 1 + size)
    y, u = [f"y{j}" for j in range(size)], [f"u{i}" for i in range(inputs)]
    before, after, results = ode.program.split(state, slots, u)
    held, moving, _ = ode.program.split((0,), slots, u)
    _, turn, turned = ode.program.prune(ode.program.outputs[:4]).split(state, slots, u)
    # What is known from time and drive alone, and is needed where the state is known, too.
    needed = set(re.findall(r"\bv\d+\b", "\n".join([*after, *results])))
    known = [name for line in before if (name := line.split(" = ")[0]) in needed]
    limited = len(limits.split((), slots)[-1]) if limits else 0
    count, monitored = len(slots.values), max(1, limited)
    head, begin, numbers = (-(-n // nodes) for n in (3, inputs, count))
    at = Layout(
        nodes, head=head, begin=begin, numbers=numbers, node=1, weight=1, a=nodes,
        known=max(1, len(known)), s=size, f=size, old=size, far=monitored, least=monitored,
    )  # fmt: skip
    s, f, old = (at.rows(group, size) for group in ("s", "f", "old"))
    kept = at.rows("known", len(known))
    far, least = at.rows("far", limited), at.rows("least", limited)

    def read(rows: range) -> list[str]:
        return [f"g{j}_{k} = {at.lane('f', j, k)}" for j in rows for k in range(nodes)]

    def at_node(j: int) -> str:
        """State j at a node: short sums side by side take less time than a long one."""
        terms = [f"{at.lane('a', k)} * g{j}_{k}" for k in range(nodes)]
        sums = [f"({' + '.join(terms[k : k + 4])})" for k in range(0, nodes, 4)]
        return " + ".join([y[j], *sums])

    def integrate(rows: range) -> list[str]:
        """Loop over few rows, for what it reads to find place in registers."""
        return [*read(rows), *loop(at, [f"{s[j]} = {at_node(j)}" for j in rows])]

    def weigh(j: int, text: str) -> str:
        """Weights times a text with lanes {f} and {old}, over the nodes."""
        terms = [text.format(f=at.lane("f", j, k), old=at.lane("old", j, k)) for k in range(nodes)]
        return " + ".join(f"{at.lane('weight', 0, k)} * {term}" for k, term in enumerate(terms))

    at_begin = [
        f"u0 = begin + {at.lane('node')}",
        *(line.replace(" = sin(", " = flat_sin(") for line in moving),
        *put(kept, known),
        *put(f, results),
        *put(old[4:], ["0.0"] * size),
    ]
    turning = [*put(u[1:], map(at_node, range(4))), *put(u[5:], s[4:]), *turn, *put(f, turned)]
    moved = [*integrate(range(4, size)), *read(range(4)), *loop(at, turning)]
    placed = [*integrate(range(2)), *integrate(range(2, 4))]
    evaluating = [*put(u[1:], s), *put(known, kept), *after, *put(old[4:], f[4:]), *put(f, results)]
    nearer = [f"{a} if {a} < {b} else {b}" for a, b in zip(far, least, strict=True)]
    check = []
    if limits:
        distances = evaluate_lanes(limits, s[:7], at, "far", slots)
        check = [*placed, *distances, *loop(at, put(least, nearer))]
    lines = [
        "def integrate(block, states):",
        "    count, iterations, h = int(block[0]), int(block[1]), block[2]",
        *indent(4, put([*y, *u[1 + size :]], (at.lane("begin", 0, i) for i in range(1, inputs)))),
        *(f"    c{i} = {at.lane('numbers', 0, i)}" for i in range(count)),
        *indent(4, loop(at, put(least, ["INFINITE"] * limited) or ["pass"])),
        *(f"    states[{j}] = {y[j]}" for j in range(size)),
        "    worst = 0.0",
        "    for step in range(count):",
        f"        begin = {at.lane('begin', 0, 0)} + step * h",
        *indent(8, [*put(u[1:], y), *held, *loop(at, at_begin)]),
        "        for iteration in range(1, iterations):",
        *indent(12, [*moved, *placed, *loop(at, evaluating)]),
        *indent(8, [*moved, *check]),
        *(f"        worst = max(worst, abs({weigh(j, '({f} - {old})')}))" for j in range(4, 7)),
        *(f"        {y[j]} = {y[j]} + {weigh(j, '{f}')}" for j in range(size)),
        "        factor = 1.0 / sqrt(y0 * y0 + y1 * y1 + y2 * y2 + y3 * y3)",
        *(f"        {y[j]} = {y[j]} * factor" for j in range(4)),
        *(f"        states[{size} * step + {size + j}] = {y[j]}" for j in range(size)),
        f"    finite = {' + '.join(f'abs({name})' for name in y)} < INFINITE",
        "    return worst if finite else INFINITE",
    ]
    return [inspect.getsource(flat_sin), assign_once(lines)], at, slots.values
