# SPDX-License-Identifier: Apache-2.0
"""Absolute stability of the methods: their regions, and the largest stable steps found.

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
from numpy.typing import NDArray

from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.integration.compiled_method import CompiledMethod, Method
from sst_ros.integration.methods import METHODS, Rosenbrock
from sst_ros.mechanism.geometry import Geometry
from sst_ros.plot import style
from sst_ros.plot.style import INK, MARKERS, free_figure, note, styled
from sst_ros.report.results import data_frame
from sst_ros.report.scene_summary import FAR, eigenvalues, stability_function, step_advice
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

_STEPS, _GROWTH = 400, 10.0


def limits_of_theory() -> Iterator[str]:
    """Yield where each method is stable on the axes, from its stability function."""
    for name, method in METHODS.items():
        if isinstance(method, Rosenbrock):
            on_axis = _growth(method, 1j * np.geomspace(1e-3, 1e9, 100_000)).max()
            far = _growth(method, np.array([FAR]))[0]
            yield (
                f"{name}: A-stable and L-stable; abs(R) is at most {on_axis:.15g} on the imaginary "
                f"axis, all poles lie at z = {1.0 / method.gamma:.4g}, and abs(R({FAR:g})) = "
                f"{far:.0e}"
            )
            continue
        line = np.linspace(0.0, 10.0, 100_001)
        real, imaginary = (
            1e-4 * (np.flatnonzero(_growth(method, axis * line) > 1.0 + 1e-9)[0] - 1)
            for axis in (-1.0, 1j)
        )
        yield (
            f"{name}: stable for h lambda from -{real:.3f} to 0, and up to {imaginary:.3f} i on "
            "the imaginary axis"
        )


def _growth(method: Method, z: NDArray[Any]) -> Array:
    """Return abs(R(z))."""
    return np.abs(stability_function(method, z.astype(np.complex128)))


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
    """Find the longest step, to one per cent, by which rates do not grow tenfold in 400 steps."""
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

    step = LONGEST_S if stable(LONGEST_S) else largest_stable(stable, 1e-9, 1e3, 0.01)
    return LargestStep(family, method.name, coefficient, rate, step)


def largest_steps(progress: str = "") -> list[LargestStep]:
    """Find the largest stable step of every method in both families."""
    jobs = [
        partial(largest_step, family, method, 10.0**power)
        for family, (_, powers) in FAMILIES.items()
        for power in powers
        for method in METHODS.values()
    ]
    return run_jobs(methodcaller("__call__"), jobs, progress)


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


@styled
def draw_regions(points: Mapping[str, NDArray[np.complex128]], footnote: str) -> Figure:
    """Draw regions of absolute stability with eigenvalues of scenes times their steps in them.

    Args:
        points: eigenvalues times steps by scene.
        footnote: small print.

    """
    x, y = np.linspace(-8.0, 2.0, 401), np.linspace(-6.0, 6.0, 401)
    z = x[None, :] + 1j * y[:, None]
    figure = free_figure(13.0, 8.6)
    grid = figure.add_gridspec(2, 2, left=0.05, right=0.63, top=0.95, bottom=0.1, hspace=0.14,
                               wspace=0.08)  # fmt: skip
    panels: Any = grid.subplots(sharex=True, sharey=True)
    near = figure.add_axes((0.69, 0.53, 0.3, 0.42))
    for axes, (name, method) in zip(panels.flat, METHODS.items(), strict=True):
        colour, modulus = MARKERS[name][0], _growth(method, z)
        axes.contourf(x, y, modulus, levels=[0.0, 1.0], colors=[colour], alpha=0.25)
        axes.contour(x, y, modulus, levels=[1.0], colors=[colour], linewidths=1.8)
        axes.set_title(f"{name}: stable where coloured")
    shown = [z[(np.abs(z.real + 3.0) <= 5.0) & (np.abs(z.imag) <= 6.0)] for z in points.values()]
    colours = (style.BLUE, style.VERMILION, style.GREEN, style.PURPLE, style.ORANGE, INK)
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
    near.set(xlim=(-reach, reach), ylim=(-reach, reach), title="Near the origin")
    for axes in (*panels[1], near):
        axes.set_xlabel("Re hλ")
    for axes in panels[:, 0]:
        axes.set_ylabel("Im hλ")
    names = [
        name if len(z) == len(points[name]) else f"{name} (some beyond the axes)"
        for name, z in zip(points, shown, strict=True)
    ]
    figure.legend(near.get_lines()[: len(names)], names, loc="upper left", ncol=2, frameon=False,
                  bbox_to_anchor=(0.68, 0.46), fontsize=8.5, title_fontsize=9,
                  title="hλ of the scenes at their start, step h as advised")  # fmt: skip
    note(figure, footnote, 170)
    return figure
