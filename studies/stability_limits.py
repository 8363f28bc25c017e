# SPDX-License-Identifier: Apache-2.0
"""Absolute stability of the methods: their coefficients, and the largest stable steps found.

A method multiplies the solution of y' = lambda y by its stability function R(h lambda) a step; it
is stable where abs(R) <= 1 (Hairer & Wanner, Solving ODEs II, sections IV.2 and IV.3). The largest
stable step is found by bisection on two families of scenes: `stiff` with other viscous
coefficients, whose fastest eigenvalue is real, and a star on springs, whose eigenvalues are
imaginary.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from operator import methodcaller
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.integration.compiled_method import CompiledMethod, Method
from sst_ros.integration.methods import METHODS, RODAS4, Rosenbrock
from sst_ros.mechanism.geometry import Geometry
from sst_ros.plot.style import (
    BLUE,
    GREEN,
    INK,
    MARKERS,
    ORANGE,
    PURPLE,
    VERMILION,
    free_figure,
    note,
    styled,
)
from sst_ros.report.results import data_frame
from sst_ros.report.step_advice import FAR, eigenvalues, stability_function, step_advice
from sst_ros.scene import scene as scenes
from sst_ros.scene.scene import Scene
from sst_ros.state import Array
from studies import run_jobs
from studies.extreme_scenes import FREE, POSE, changed, start
from studies.sampled_data import largest_stable

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

LONGEST_S = 1.0
"""Longer steps are not tried [s]."""

AMPLITUDE = 1e-4
"""Distance of the springs' start from their rest [rad]: so small that the motion is linear."""

WRONG_ORDER, CONDITION, ROUNDING = 0.04, 1e-12, 1e-13
"""Faults: difference from the order, relative, and from a condition; errors of R(z) by rounding."""

_STEPS, _GROWTH = 400, 10.0


def faults() -> Iterator[str]:
    """Yield what is wrong with the coefficients of the methods."""
    for name, method in METHODS.items():
        yield from (f"WARNING: {name}: {fault}" for fault in method_faults(method))


def method_faults(method: Method) -> Iterator[str]:
    """Yield the order conditions that the coefficients of a method do not meet.

    R(z) - exp(z) must fall with z^(order + 1); rows of an explicit method must add up to its nodes,
    its weights integrate polynomials below its order, and its error weights vanish on those below
    theirs (Hairer, Norsett & Wanner, Solving ODEs I, section II.1).
    """
    found = observed_order(method)
    if abs(found / method.order - 1.0) > WRONG_ORDER:
        yield f"order {found:.2f} in place of {method.order}"
    if isinstance(method, Rosenbrock):
        at_infinity = abs(stability_function(method, np.array([FAR + 0j]))[0])
        if at_infinity > 1e-10:
            yield f"not L-stable: abs(R({FAR:g})) = {at_infinity:.0e}"
        if method.a[-1] != (*method.a[-2], 1.0):
            yield "the last stage does not start from the solution of the one before"
        return
    off = max(abs(math.fsum(row) - c) for row, c in zip(method.a, method.c, strict=True))
    # DOP853 combines two estimates, of orders 5 and 3, into one of order 7.
    below = (5, 3) if method.damping else (method.error_order, 0)
    for weights, count, what in (
        (method.b, method.order, "weights"), (method.error, below[0], "error weights"),
        (method.damping, below[1], "weights of the second estimate"),
    ):  # fmt: skip
        for k in range(count):
            moment = math.fsum(w * c**k for w, c in zip(weights, method.c, strict=True))
            expected = 1.0 / (k + 1) if what == "weights" else 0.0
            if abs(moment - expected) > CONDITION:
                yield f"{what}: moment {k} is off by {abs(moment - expected):.0e}"
    if off > CONDITION:
        yield f"a row is off its node by {off:.0e}"


def observed_order(method: Method) -> float:
    """Order of R(z) at the smallest z whose error is not rounding, the worse of two axes."""
    orders = []
    for direction in (-1.0, 1j):
        z = np.asarray(direction * 2.0 ** -np.arange(12.0), dtype=np.complex128)
        errors = np.abs(stability_function(method, z) - np.exp(z))
        last = np.flatnonzero(errors > ROUNDING)[-1]
        orders.append(math.log2(errors[last - 1] / errors[last]) - 1.0)
    return max(orders, key=lambda order: abs(order - method.order))


def limits_of_theory() -> Iterator[str]:
    """Yield where each method is stable on the axes, from its stability function."""
    for name, method in METHODS.items():
        if method is RODAS4:
            z = np.asarray(1j * np.geomspace(1e-3, 1e9, 100_000), dtype=np.complex128)
            on_axis = float(np.abs(stability_function(method, z)).max())
            far = abs(stability_function(method, np.array([FAR + 0j]))[0])
            yield (
                f"{name}: A-stable and L-stable; abs(R) is at most {on_axis:.15g} on the imaginary "
                f"axis, all poles lie at z = 4, and abs(R({FAR:g})) = {far:.0e}"
            )
            continue
        reach = []
        for direction in (-1.0, 1j):
            z = np.asarray(direction * np.linspace(0.0, 10.0, 100_001), dtype=np.complex128)
            modulus = np.abs(stability_function(method, z))
            outside = np.flatnonzero(modulus > 1.0 + 1e-9)
            reach.append(1e-4 * (outside[0] - 1) if len(outside) else math.inf)
        real = f"{name}: stable for h lambda from -{reach[0]:.3f} to 0"
        yield f"{real}, and up to {reach[1]:.3f} i on the imaginary axis"


class LargestStep(NamedTuple):
    """Largest stable step of a method; LONGEST_S where every step was stable."""

    family: str
    method: str
    coefficient: float  # viscous coefficient [N m s/rad] or stiffness [N m/rad]
    rate: float  # largest modulus of the eigenvalues at the start [1/s]
    step: float  # [s]; nan where the shortest was unstable


def damped(coefficient: float) -> Scene:
    """Return the scene `stiff` with another viscous coefficient of the actuators [N m s/rad]."""
    return changed({"friction": {"gamma": {"viscous": coefficient}}}, "stiff")


def oscillating(stiffness: float) -> Scene:
    """Return the star of example2_heavy on springs [N m/rad], close to their rest."""
    springs = [
        {"joint": f"gamma_{k + 1}", "stiffness": stiffness, "rest": angle - AMPLITUDE}
        for k, angle in enumerate(POSE)
    ]
    return changed({**FREE, **start(POSE), "springs": springs, "torque": None})


FAMILIES: dict[str, tuple[Callable[[float], Scene], range]] = {
    "decay": (damped, range(6)),
    "oscillation": (oscillating, range(1, 9)),
}
"""Scene by a coefficient, and the powers of ten of the coefficients."""


def largest_step(family: str, method: Method, coefficient: float) -> LargestStep:
    """Find the longest stable step by bisection: the rates do not grow tenfold in 400 steps."""
    scene = FAMILIES[family][0](coefficient)
    dynamics = Dynamics.of(scene)
    rate = float(np.abs(eigenvalues(scene)).max())
    integrator = CompiledMethod(ODE(dynamics), method, compiled=False)
    start = list(initial_state(scene, Geometry.of(scene)))
    drive = (0.0,) * len(dynamics.drive)
    # Rates of the oscillation at its amplitude; at rest the damped family has a rate of its own.
    bound = _GROWTH * (1.0 if family == "decay" else AMPLITUDE * rate)

    def stable(h: float) -> bool:
        try:
            with np.errstate(all="ignore"):
                y = integrator.step_fixed(0.0, h, _STEPS, start, drive)
        except (ArithmeticError, ValueError):
            return False
        return all(map(math.isfinite, y)) and math.hypot(*y[4:7]) < bound

    return LargestStep(family, method.name, coefficient, rate, bisect_step(stable))


def bisect_step(stable: Callable[[float], bool]) -> float:
    """Return the largest h for which `stable` holds, to one per cent; nan where there is none."""
    return LONGEST_S if stable(LONGEST_S) else largest_stable(stable, 1e-9, 1e3, 0.01)


def largest_steps(*, workers: int | None = None, progress: str = "") -> list[LargestStep]:
    """Find the largest stable step of every method in both families."""
    jobs = [
        partial(largest_step, family, method, coefficient)
        for family, (_, powers) in FAMILIES.items()
        for coefficient in [10.0**power for power in powers]
        for method in METHODS.values()
    ]
    return run_jobs(methodcaller("__call__"), jobs, progress, workers)


def scene_points() -> dict[str, NDArray[np.complex128]]:
    """Eigenvalues of the shipped scenes times the steps that `step_advice` recommends."""
    found = {}
    for name in scenes.names():
        step = step_advice(scenes.load(name)).step
        if math.isfinite(step):
            found[name] = step * eigenvalues(scenes.load(name))
    return found


def step_table(steps: Sequence[LargestStep], family: str) -> DataFrame:
    """Return the largest stable steps of a family as texts: step [ms], step times abs(lambda)."""
    rows: dict[float, dict[str, str]] = {}
    for each in (step for step in steps if step.family == family):
        row = rows.setdefault(each.coefficient, {
            "coefficient": f"{each.coefficient:g}", "largest abs(lambda) [1/s]": f"{each.rate:.4g}",
        })  # fmt: skip
        row[each.method] = (
            f">= {1e3 * LONGEST_S:g}" if each.step >= LONGEST_S
            else f"{1e3 * each.step:.3g} ({each.step * each.rate:.2f})"
        )  # fmt: skip
    return data_frame(rows.values())


TITLES = {"decay": "Damped: viscous friction", "oscillation": "Oscillating: springs"}


@styled
def draw_largest_steps(steps: DataFrame, footnote: str) -> Figure:
    """Draw the largest stable step over the fastest rate, a panel for each family."""
    families = list(steps.family.unique())
    figure = free_figure(6.2 * len(families) + 0.6, 6.0)
    panels = figure.subplots(1, len(families), squeeze=False)[0]
    figure.subplots_adjust(left=0.07, right=0.985, top=0.91, bottom=0.16, wspace=0.18)
    for axes, family in zip(panels, families, strict=True):
        own = steps[steps.family == family]
        axes.set_xscale("log")
        axes.set_yscale("log")
        for name, rows in own.groupby("method", sort=False):
            colour, marker = MARKERS[name]
            x, y = rows.rate.to_numpy(), rows.step.to_numpy()
            reached = f"every step tried, up to {LONGEST_S:g} s"
            if not (y >= LONGEST_S).all():
                reached = f"step × rate ≤ {x[-1] * y[-1]:.2f}"
                axes.fill_between(x, 1e-12, y, color=colour, alpha=0.10, linewidth=0.0)
            axes.plot(x, y, color=colour, marker=marker, linewidth=2.0, markersize=7,
                      clip_on=False, zorder=4, label=f"{name}: {reached}")  # fmt: skip
        axes.set_ylim(0.3 * own.step.min(), 2.0 * LONGEST_S)
        axes.set_xlim(own.rate.min(), own.rate.max())
        axes.set_xlabel("largest |λ| of the family [1/s]")
        axes.set_title(TITLES[family])
        axes.legend(loc="lower left", fontsize=9)
    panels[0].set_ylabel("step [s]; a method is stable below its line")
    note(figure, footnote, 60 + 80 * len(families))
    return figure


def regions(
    x: tuple[float, float] = (-8.0, 2.0), y: tuple[float, float] = (-6.0, 6.0), points: int = 401
) -> tuple[Array, Array, dict[str, Array]]:
    """Return a grid of z, shapes (points,), and abs(R) of every method on it."""
    real, imaginary = np.linspace(*x, points), np.linspace(*y, points)
    z = real[None, :] + 1j * imaginary[:, None]
    found = {name: np.abs(stability_function(method, z)) for name, method in METHODS.items()}
    return real, imaginary, found


@styled
def draw_regions(
    x: Array,
    y: Array,
    growth: Mapping[str, Array],
    points: Mapping[str, NDArray[np.complex128]],
    footnote: str,
) -> Figure:
    """Draw regions of absolute stability with the eigenvalues of scenes times their steps in them.

    Args:
        x: real part of z = h lambda, shape (n,).
        y: imaginary part, shape (m,).
        growth: modulus of the stability function by method, shape (m, n).
        points: eigenvalues times steps by scene.
        footnote: small print.

    """
    figure = free_figure(13.0, 8.6)
    grid = figure.add_gridspec(2, 2, left=0.05, right=0.63, top=0.95, bottom=0.1, hspace=0.14,
                               wspace=0.08)  # fmt: skip
    panels: Any = grid.subplots(sharex=True, sharey=True)
    near = figure.add_axes((0.69, 0.53, 0.3, 0.42))
    for axes, (method, modulus) in zip(panels.flat, growth.items(), strict=True):
        colour = MARKERS[method][0]
        axes.contourf(x, y, modulus, levels=[0.0, 1.0], colors=[colour], alpha=0.25)
        axes.contour(x, y, modulus, levels=[1.0], colors=[colour], linewidths=1.8)
        axes.set_title(f"{method}: stable where coloured")
    inside = {name: (z.real >= x[0]) & (z.real <= x[-1]) & (np.abs(z.imag) <= y[-1])
              for name, z in points.items()}  # fmt: skip
    shown = [z[inside[name]] for name, z in points.items()]
    colours = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, INK)
    looks: list[dict[str, Any]] = [
        {"marker": "osD^v<>phX*P"[k % 12], "color": colours[(k + k // 12) % 6],
         "linestyle": "none", "markersize": 6, "markerfacecolor": "none"}
        for k in range(len(points))
    ]  # fmt: skip
    for axes in (*panels.flat, near):
        for z, look in zip(shown, looks, strict=True):
            axes.plot(z.real, z.imag, **look)
        axes.axhline(0.0, color=INK, linewidth=0.6)
        axes.axvline(0.0, color=INK, linewidth=0.6)
    reach = 1.1 * max((float(np.abs(z).max()) for z in shown if len(z)), default=1.0)
    near.set_xlim(-reach, reach)
    near.set_ylim(-reach, reach)
    near.set_title("Near the origin")
    near.set_xlabel("Re hλ")
    for axes in panels[1]:
        axes.set_xlabel("Re hλ")
    for axes in panels[:, 0]:
        axes.set_ylabel("Im hλ")
    handles = [
        Line2D(
            [], [], **look, label=name if inside[name].all() else f"{name} (some beyond the axes)"
        )
        for name, look in zip(points, looks, strict=True)
    ]
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.68, 0.46), fontsize=8.5,
                  frameon=False, ncol=2, title="hλ of the scenes at their start, step h as advised",
                  title_fontsize=9)  # fmt: skip
    note(figure, footnote, 170)
    return figure
