# SPDX-License-Identifier: Apache-2.0
"""Figures of a run: path and angles of the star, joints, limits, control, torques, energy.

Those of the star are Figs. 8 to 14 of the paper. Each takes any number of solutions: a run, the
continuous solution, an independent engine. Several are drawn over each other, with their
differences from the first below, on a logarithmic axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sst_ros.dynamics import kernel as physics
from sst_ros.dynamics.kernel import model_of
from sst_ros.mechanism.frames import rotation_matrix, zyz_angles
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.rates import body_rates
from sst_ros.plot.style import (
    BLUE,
    GREY,
    LINES,
    VERMILION,
    few,
    legend,
    lines,
    mark_ends,
    positive,
    scaled,
    span,
    stack,
    three,
    widen,
)
from sst_ros.recording.signals import Integers, Signals
from sst_ros.scene.scene import Scene
from sst_ros.state import NANOSECONDS

NUMBERS = {
    "example1": {"position_of_E": 8, "psi": 9},
    "example2": {"path_of_E": 10, "position_of_E": 11, "theta": 12, "phi": 13, "psi": 14},
}
"""Number of a picture in the paper, by the name of the scene."""

ASSUMPTION = "assumed inertias: the paper's are lost"

LEAST_POSITION_M, LEAST_ANGLE_DEG = 0.05, 1.0
"""An axis never shows less than this, so that rounding is a flat line."""


class Solution(NamedTuple):
    """One solution of the motion: its name, times [s] (n,), quaternions (n, 4), ZYZ angles (n, 3).

    Angles are in rad; where they are nan those of the quaternion are drawn.
    """

    name: str
    seconds: Array
    quaternion: Array
    euler: Array | None = None

    @property
    def degrees(self) -> Array:
        """ZYZ angles [deg] without jumps, shape (n, 3)."""
        computed = zyz_angles(rotation_matrix(self.quaternion))
        if self.euler is not None:
            computed = np.where(np.isfinite(self.euler), self.euler, computed)
        return np.asarray(np.degrees(_unwrapped(computed)))

    def position(self, scene: Scene) -> Array:
        """Position of E in {B} [m], shape (n, 3)."""
        return np.asarray(scene.star.radius * rotation_matrix(self.quaternion)[:, :, 2])


def caption(name: str, title: str, scene: str | None) -> tuple[str, str]:
    """Return the stem of a picture's file and its title.

    The paper's figures have their number and name the assumption behind them.
    """
    title += f", {scene}" if scene else ""
    number = NUMBERS.get(scene or "", {}).get(name)
    if number is None:
        return name, title
    return f"fig{number:02d}_{name}", f"{title}\nFig. {number} of the paper; {ASSUMPTION}"


def position_of_e(scene: Scene, solutions: Sequence[Solution]) -> Figure:
    """Draw the coordinates of E over time."""
    values = [each.position(scene) for each in solutions]
    return _over_time(solutions, values, "xyz", "position of E in {B} [m]", "m", LEAST_POSITION_M)


def angle(solutions: Sequence[Solution], which: int) -> Figure:
    """Draw one of the ZYZ angles over time: 0 theta, 1 phi, 2 psi."""
    letter = "θφψ"[which]
    values = [each.degrees[:, which : which + 1] for each in solutions]
    return _over_time(solutions, values, letter, f"{letter} [deg]", "deg", LEAST_ANGLE_DEG)


def _over_time(
    solutions: Sequence[Solution],
    values: Sequence[Array],
    letters: str,
    label: str,
    unit: str,
    least_span: float,
) -> Figure:
    """Draw columns over time; differences from the first solution below where there are several."""
    first = solutions[0]
    if len(solutions) == 1:
        figure = Figure(figsize=(7.0, 4.2))
        axes = figure.subplots()
        lines(axes, first.seconds, values[0], list(letters), least_span=least_span)
        axes.set_xlabel("time t [s]")
        axes.set_ylabel(label)
        return figure
    figure = Figure(figsize=(7.0, 6.4))
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for solution, columns, style in zip(solutions, values, LINES, strict=False):
        above.plot(solution.seconds, columns, label=solution.name, **style)
    widen(above, values[0], least_span)
    _name_columns(above, first.seconds, values[0], letters)
    handles, names = above.get_legend_handles_labels()
    unique = dict(zip(names, handles, strict=True))
    above.legend(unique.values(), unique.keys(), loc="lower right", bbox_to_anchor=(1.0, 1.0),
                 ncol=len(unique), fontsize=8, frameon=False, borderaxespad=0.1)  # fmt: skip
    above.set_ylabel(label)
    for solution, columns, style in list(zip(solutions, values, LINES, strict=False))[1:]:
        at, here, there = np.intersect1d(
            np.round(first.seconds, 9), np.round(solution.seconds, 9), return_indices=True
        )
        apart = np.abs(columns[there] - values[0][here]).max(axis=1)
        below.plot(at, positive(apart), label=f"{solution.name}: {_largest(apart, unit)}", **style)
    below.set_yscale("log")
    below.set_ylabel(f"difference from\n{first.name} [{unit}]")
    below.set_xlabel("time t [s]")
    below.legend(fontsize=8, loc="best", title="largest difference", title_fontsize=8)
    span([above, below], first.seconds)
    return figure


def _largest(apart: Array, unit: str) -> str:
    return f"{np.nanmax(apart):.1e} {unit}" if np.isfinite(apart).any() else "no common times"


def _name_columns(axes: Axes, seconds: Array, columns: Array, letters: str) -> None:
    """Write the letter of each column beside its last value, where there are several."""
    if len(letters) == 1:
        return
    for letter, column in zip(letters, columns.T, strict=True):
        known = np.flatnonzero(np.isfinite(column))
        if len(known):
            axes.annotate(letter, (seconds[known[-1]], column[known[-1]]), (4, 0),
                          textcoords="offset points", va="center",
                          annotation_clip=False)  # fmt: skip


def path(scene: Scene, solutions: Sequence[Solution]) -> Figure:
    """Draw E over the base triangle, both at their own radius, and the triangle's image at E's."""
    figure = Figure(figsize=(6.4, 6.4))
    axes = figure.add_subplot(projection="3d")
    geometry = Geometry.of(scene)
    base, star = scene.base.radius, scene.star.radius
    outline = triangle(geometry)
    axes.plot(*(base * outline).T, color=GREY, linewidth=1.6, label="base triangle P₁P₂P₃")
    if star != base:
        axes.plot(*(star * outline).T, color=GREY, linewidth=0.9, linestyle=":",
                  label="its image on the sphere of E")  # fmt: skip
    for index, point in enumerate(1.14 * max(base, star) * geometry.v):
        axes.text(*point, f"P{'₁₂₃'[index]}", ha="center", va="center")
    several = len(solutions) > 1
    for solution, style in zip(solutions, LINES, strict=False):
        name = solution.name if several else "path of E"
        looks = style if several else {"color": BLUE, "linewidth": 1.8}
        axes.plot(*solution.position(scene).T, label=name, **looks)
    position = solutions[0].position(scene)
    known = position[np.isfinite(position[:, 0])]
    mark_ends(axes, *known.T)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.set_box_aspect((1, 1, 1))
    shown = np.concatenate([base * outline, star * outline, known])
    middle = 0.5 * (shown.min(axis=0) + shown.max(axis=0))
    reach = 0.5 * float(np.ptp(shown, axis=0).max())
    low, high = middle - reach, middle + reach
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    centre = geometry.v.sum(axis=0)
    azimuth = np.degrees(np.arctan2(centre[1], centre[0]))
    height = np.degrees(np.arctan2(centre[2], np.hypot(centre[0], centre[1])))
    axes.view_init(elev=height - 8.0, azim=azimuth + 8.0)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10], prune="both"))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncol=3, fontsize=9)
    return figure


def triangle(geometry: Geometry) -> Array:
    """Points of the closed base triangle on the unit sphere, shape (n, 3)."""
    share = np.linspace(0.0, 1.0, 40)[:, None]
    sides = []
    for k in range(3):
        along: Array = geometry.arc[k] * share
        across = np.cross(geometry.w[k], geometry.v[k])
        sides.append(np.cos(along) * geometry.v[k] + np.sin(along) * across)
    return np.asarray(np.concatenate(sides))


def _unwrapped(angles: Array) -> Array:
    """Take out whole turns between samples, over lost samples too; shape (n, 3)."""
    result: Array = angles.copy()
    for column in range(3):
        known = np.isfinite(result[:, column])
        result[known, column] = np.unwrap(result[known, column])
    return result


KINDS = {"gamma": "γ", "mu": "μ", "beta": "β"}


def joint_angles(run: Signals, _: Scene | None) -> Figure:
    """Draw the angles of all nine joints."""
    return _of_kinds(run, "{}", "{} [deg]", "{}", np.degrees(1.0))


def joint_rates(run: Signals, _: Scene | None) -> Figure:
    """Draw the rates of all nine joints, actuated and passive."""
    return _of_kinds(run, "{}_dot", "{}̇ [rad/s]", "{}̇", 1.0)


def _of_kinds(run: Signals, quantity: str, label: str, name: str, scale: float) -> Figure:
    figure, panels = stack([label.format(letter) for letter in KINDS.values()])
    for axes, (kind, letter) in zip(panels, KINDS.items(), strict=True):
        values = scale * run.legs(quantity.format(kind))
        lines(axes, run.seconds(), values, three(name.format(letter)))
    return figure


def phase(run: Signals, _: Scene | None) -> Figure:
    """Draw each actuator's rate over its angle, from the circle to the square."""
    figure = Figure(figsize=(10.5, 3.8))
    angle, rate = np.degrees(run.legs("gamma")), run.legs("gamma_dot")
    for leg, axes in enumerate(figure.subplots(1, 3)):
        axes.plot(angle[:, leg], rate[:, leg], color=BLUE, linewidth=1.4)
        mark_ends(axes, angle[:, leg], rate[:, leg])
        axes.set_xlabel(f"{three('γ')[leg]} [deg]")
        axes.set_ylabel(f"{three('γ̇')[leg]} [rad/s]")
    figure.axes[-1].legend(loc="best", fontsize=8)
    return figure


def margins(run: Signals, scene: Scene) -> Figure:
    """Draw the distance of each leg to the nearest limit of its joints."""
    geometry = Geometry.of(scene)
    gamma, beta = run.legs("gamma"), run.legs("beta")
    stroke = np.degrees(np.minimum(gamma, geometry.arc - gamma))
    reach = np.degrees(np.minimum(beta, geometry.beta_max - beta))
    figure, panels = stack(["to an end of the stroke [deg]", "to a limit of β [deg]"], 2.6)
    for axes, values in zip(panels, (stroke, reach), strict=True):
        lines(axes, run.seconds(), values, [f"leg {leg}" for leg in (1, 2, 3)])
        axes.axhline(0.0, color="black", linewidth=0.8)
    return figure


def tracking(run: Signals, _: Scene | None) -> Figure:
    """Draw the desired angle of each actuator, and the measured one over it."""
    figure, panels = stack([f"{name} [deg]" for name in three("γ")])
    desired, measured = (np.degrees(run.legs(name)) for name in ("gamma_desired", "gamma"))
    for leg, axes in enumerate(panels):
        axes.plot(run.seconds(), desired[:, leg], color=GREY, linewidth=3.2, label="desired")
        axes.plot(run.seconds(), measured[:, leg], "--", color=BLUE, linewidth=1.5,
                  label="measured")  # fmt: skip
    legend(panels[0])
    span(panels, run.seconds())
    return figure


def tracking_error(run: Signals, _: Scene | None) -> Figure:
    """Draw desired less measured, as the controller received it."""
    figure, panels = stack(["γ desired − γ [rad]", "γ̇ desired − γ̇ [rad/s]"], 2.6)
    lines(panels[0], run.seconds(), run.legs("gamma_error"), three("γ"))
    lines(panels[1], run.seconds(), run.legs("gamma_dot_error"), three("γ̇"))
    return figure


def control_torques(run: Signals, _: Scene | None) -> Figure:
    """Draw the torques of the controller's model, and of its feedback."""
    figure, panels = stack(["feedforward [N m]", "feedback [N m]"], 2.6)
    for axes, name in zip(panels, ("tau_feedforward", "tau_feedback"), strict=True):
        lines(axes, run.seconds(), run.legs(name), three("τ"))
    return figure


def applied_and_commanded(run: Signals, _: Scene | None) -> Figure:
    """Draw the torque of each tick, and the commands over it where they were recorded.

    Commands without a stamp are drawn where the recorder received them, by its clock.
    """
    figure, panels = stack([f"{name} [N m]" for name in three("τ")])
    times, torque = applied(run)
    at, commands = _commands(run, float(times[0]), float(times[-1]))
    for leg, axes in enumerate(panels):
        axes.plot(times, torque[:, leg], color=BLUE, linewidth=3.0, label="applied")
        if len(at):
            axes.plot(at, commands[:, leg], ".", markersize=1.5, color=VERMILION, label="commanded")
    legend(panels[0])
    span(panels, times)
    return figure


def applied(run: Signals) -> tuple[Array, Array]:
    """Return times [s] and torques [N m], shape (m, 3), that draw what each tick held."""
    start = run.time_ns("ticks")
    length = run.take("length", table="ticks")[:, 0].astype(np.int64)
    return few(*held(start, start + length, run.legs("tau", "ticks")))


def held(start_ns: Integers, end_ns: Integers, values: Array) -> tuple[Array, Array]:
    """Return times [s] and values that draw a zero-order hold; a gap between ticks is nan."""
    times = np.stack([start_ns, end_ns], axis=1).ravel() / NANOSECONDS
    steps = np.repeat(values, 2, axis=0)
    gaps = 2 * (np.flatnonzero(start_ns[1:] != end_ns[:-1]) + 1)
    return np.insert(times, gaps, times[gaps]), np.insert(steps, gaps, np.nan, axis=0)


def _commands(run: Signals, begin: float, end: float) -> tuple[Array, Array]:
    table = next((name for name in ("commands_stamped", "commands") if name in run.tables), None)
    if table is None:
        return np.empty(0), np.empty((0, 3))
    at, values = run.seconds(table), run.legs("tau", table)
    inside = (at >= begin) & (at <= end)
    return at[inside], values[inside]


def power(run: Signals, _: Scene | None) -> Figure:
    """Draw the power of each actuator at the end of each step, and their sum."""
    figure, panels = stack(["power τₖ γ̇ₖ [W]", "all three [W]"], 2.6)
    values = run.legs("tau") * run.legs("gamma_dot")
    lines(panels[0], run.seconds(), values, [f"actuator {leg}" for leg in (1, 2, 3)])
    panels[1].plot(run.seconds(), values.sum(axis=1), color=BLUE, linewidth=1.5)
    span(panels, run.seconds())
    return figure


def energy(run: Signals, scene: Scene) -> Figure:
    """Draw the energy of the motion, the actuators' work, and what is left between them."""
    seconds, kinetic, potential = run.seconds(), *energies(run, scene)
    done = work(run)
    gained = kinetic + potential - _first(kinetic + potential)
    residual, unit = scaled(gained - done.sum(axis=1))
    figure, panels = stack(["energy [J]", f"energy gained − work [{unit}J]"], 2.8)
    curves = {"kinetic": kinetic, "potential, gained": potential - _first(potential),
              "work of the actuators": done.sum(axis=1)}  # fmt: skip
    if not np.nanmax(np.abs(curves["potential, gained"]), initial=0.0):
        del curves["potential, gained"]  # no gravity, no springs
    lines(panels[0], seconds, np.stack(list(curves.values()), axis=1), list(curves))
    panels[1].plot(seconds, residual, color=BLUE, linewidth=1.4)
    panels[1].axhline(0.0, color=GREY, linewidth=0.8)
    span(panels, seconds)
    return figure


def actuator_work(run: Signals, _: Scene | None) -> Figure:
    """Draw the work that each actuator has done."""
    figure, panels = stack(["work [J]"], 3.2)
    names = [f"actuator {leg}" for leg in (1, 2, 3)]
    lines(panels[0], run.seconds(), work(run), names)
    span(panels, run.seconds())
    return figure


def energies(run: Signals, scene: Scene) -> tuple[Array, Array]:
    """Kinetic and potential energy at each sample [J], shape (n,); nan where it was lost."""
    quaternion = run.take("q_x", "q_y", "q_z", "q_w")
    rates = [run.legs(name) for name in ("gamma_dot", "mu_dot", "beta_dot")]
    known = np.isfinite(np.concatenate([quaternion, *rates], axis=1)).all(axis=1)
    turned = body_rates(Geometry.of(scene), quaternion[known], *(rate[known] for rate in rates))
    state = (*quaternion[known].T, *turned.T)
    model = model_of(scene)
    result = np.full((2, len(known)), np.nan)
    result[0, known] = physics.kinetic_energy(model, state)
    result[1, known] = physics.potential_energy(model, state)
    return result[0], result[1]


def work(run: Signals) -> Array:
    """Work of each actuator from the first sample to each [J], shape (n, 3).

    A torque that is held over a tick does work by the angle of that tick. Angles at the ends of
    ticks between samples are those of the cubic through angles and rates of both; where samples
    or ticks are lost the work is nan from there on.
    """
    time, gamma, rate = run.time_ns("samples"), run.legs("gamma"), run.legs("gamma_dot")
    start, torque = run.time_ns("ticks"), run.legs("tau", "ticks")
    end = start + run.take("length", table="ticks")[:, 0].astype(np.int64)
    steps = torque * (_angles(time, gamma, rate, end) - _angles(time, gamma, rate, start))
    steps[1:][start[1:] != end[:-1]] = np.nan
    steps[start < time[0]] = 0.0
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    done = np.searchsorted(end, time, side="right")
    whole = (time == time[0]) | np.isin(time, end)
    return np.asarray(np.where(whole[:, None], total[done], np.nan))


def _angles(time: Integers, gamma: Array, rate: Array, at: Integers) -> Array:
    """Interpolate angles at times [ns] of the run, shape (m, 3), by the cubic of Hermite."""
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    before = after - 1
    h = ((time[after] - time[before]) / 1e9)[:, None]
    s = ((at - time[before]) / (time[after] - time[before]))[:, None]
    value = (1 + 2 * s) * (1 - s) ** 2 * gamma[before] + s**2 * (3 - 2 * s) * gamma[after]
    slope = s * (1 - s) ** 2 * rate[before] - s**2 * (1 - s) * rate[after]
    return np.asarray(value + h * slope)


def _first(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known[0]) if len(known) else 0.0
