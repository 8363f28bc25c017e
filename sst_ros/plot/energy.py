# SPDX-License-Identifier: Apache-2.0
"""Figures of power and energy of a run."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from sst_ros.dynamics import energy as physics
from sst_ros.dynamics.kernel import model_of
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.mechanism.rates import body_rates
from sst_ros.plot.style import BLUE, GREY, lines, scaled, span, stack
from sst_ros.recording.signals import Signals
from sst_ros.recording.time_series import Integers
from sst_ros.scene.scene import Scene


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
    result[0, known] = physics.kinetic(model, state)
    result[1, known] = physics.potential(model, state)
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
