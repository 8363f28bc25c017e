# SPDX-License-Identifier: Apache-2.0
"""Figs. 8 to 14 of the paper anew: nodes, continuous solution, independent engine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

from benchmark.peers.pinocchio_peer import Model
from benchmark.peers.task import KINDS, Task
from sst_ros import demo
from sst_ros.errors import MissingDependency, require
from sst_ros.figures import (
    BLUE,
    LINES,
    VERMILION,
    Looks,
    hide_zeros,
    legend,
    stack,
    styled,
    widen,
)
from sst_ros.files import write_into
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.geometry import (
    Array,
    angle_between,
    quaternion_of,
    rotation_matrix,
)
from sst_ros.plot.pictures import (
    ASSUMPTION,
    FIGURE_NUMBERS,
    LEAST_ANGLE_DEG,
    LEAST_POSITION_M,
    POSITION,
    RUN_PICTURES,
    ZYZ,
    caption,
    draw_path,
    position_of_e,
    save,
    zyz_degrees,
)
from sst_ros.recording import recording
from sst_ros.report.results import publish, render
from sst_ros.scene.scene import Scene, load
from sst_ros.simulation.simulate import simulate
from sst_ros.simulation.trajectory import Trajectory
from studies import PAGES, run

NODES_LIMIT, ENGINE_LIMIT, TORQUE_LIMIT = 5e-5, 1e-9, 1e-8
"""Largest differences that are expected: of angles [rad], and of torques [N m]."""

STEP = 1e-3
"""Spacing of the samples in the check by inverse dynamics, whole nanoseconds [s]."""


Solutions: TypeAlias = Mapping[str, Array]
"""Solutions of one motion by name: quaternions (n, 4), all at the same times."""


class LargestDifference(NamedTuple):
    """A largest difference over a run, and what it may be."""

    scene: str
    what: str
    value: float
    limit: float
    unit: str

    @property
    def within(self) -> bool:
        """Whether it is as small as expected."""
        return self.value <= self.limit

    def __str__(self) -> str:
        limit = f"{'within' if self.within else 'ABOVE'} {self.limit:.0e} {self.unit}"
        return f"{self.scene}: {self.what}: {self.value:.1e} {self.unit}, {limit}"


@styled
def paper(out: Path) -> list[LargestDifference]:
    """Run both examples, draw the figures into `out` and write an index page.

    Returns:
        The largest differences between the solutions; `within` of each is true if all
        is well.

    """
    found: list[LargestDifference] = []
    paths: list[Path] = []
    notes: list[str] = []
    with write_into(out, "paper"):
        for name in demo.EXAMPLES:
            scene = load(name)
            print(f"{name}: {scene.description}", flush=True)
            times, solutions, differences, note = _solve(
                scene, demo.record(name, out / name)
            )
            found += differences
            notes += note
            paths += _draw(scene, times, solutions, out)
        path, difference = _inverse_dynamics(load("example1"), out)
        found.append(difference)
        paths.insert(2, path)
        lines = [*map(str, found), *dict.fromkeys(notes)]
        page = render(
            PAGES / "paper.html",
            lines=lines,
            paths=paths,
            assumption=ASSUMPTION.capitalize(),
        )
        publish(out, "paper", {"index.html": page})
    print(
        "\n".join([*lines, f"Files: {out}: index.html, {len(paths)} pictures"]),
        flush=True,
    )
    return found


def _solve(
    scene: Scene, bag: Path
) -> tuple[Array, dict[str, Array], list[LargestDifference], list[str]]:
    """Return a run's samples, the solutions at them, their distances, and notes."""
    run = recording.read(bag)
    times = run.seconds
    motion = simulate(scene, duration=float(times[-1]), t_eval=times, tolerance=1e-12)
    solutions = {"continuous": motion.quaternion, "nodes, 500 Hz": run.quaternion}
    differences = [
        _difference(scene, "nodes", motion, run.quaternion, run.gamma, NODES_LIMIT)
    ]
    try:
        quaternion, gamma = integrate_by_pinocchio(scene, times)
    except MissingDependency as error:
        return times, solutions, differences, [f"no independent engine: {error}"]
    solutions["Pinocchio"] = quaternion
    differences.append(
        _difference(scene, "Pinocchio", motion, quaternion, gamma, ENGINE_LIMIT)
    )
    return times, solutions, differences, []


def integrate_by_pinocchio(scene: Scene, times: Array) -> tuple[Array, Array]:
    """Integrate a scene by Pinocchio.

    Its equations share nothing with those of this package. The seven links are a tree,
    base -> actuated -> intermediate link of each leg with the star on leg 1; a point of
    the axis t_k on legs 2 and 3 is tied to the star. SciPy's DOP853 integrates
    Pinocchio's accelerations in the angles of the seven joints of the tree.

    Returns:
        Quaternions of the star (n, 4) and actuator angles [rad], shape (n, 3), at the
        times [s].

    Raises:
        MissingDependency: Pinocchio is not installed.

    """
    pin, model = require("pinocchio"), Model(task := Task(scene.name))
    size, rates = model.model.nv, task.dynamics.joints(*task.start)[9:]
    start = np.zeros(2 * size)
    for joint, place in model.place.items():
        start[size + place] = rates[KINDS[joint[0]] + int(joint[1])]

    def derivative(t: float, state: Array) -> Array:
        force = np.zeros(size)
        force[model.drives] = task.torque_at(t)
        acceleration = pin.constraintDynamics(
            model.model,
            model.data,
            state[:size],
            state[size:],
            force,
            model.ties,
            model.tied,
            model.proximal,
        )
        return np.append(state[size:], acceleration)

    span = (0.0, float(times[-1]))
    run = solve_ivp(
        derivative, span, start, "DOP853", t_eval=times, rtol=1e-12, atol=1e-12
    )
    poses = [model.pose(state) for state in run.y.T]
    rotations = np.array([pose.rotation for pose in poses])
    return quaternion_of(rotations), np.array([pose.gamma for pose in poses])


def _difference(
    scene: Scene,
    who: str,
    motion: Trajectory,
    quaternion: Array,
    gamma: Array,
    limit: float,
) -> LargestDifference:
    """Return the largest difference of the actuator angles and of the orientation."""
    apart = float(np.abs(gamma - motion.gamma).max())
    turned = float(angle_between(quaternion, motion.quaternion).max())
    what = f"{who} against the continuous solution"
    return LargestDifference(scene.name, what, max(apart, turned), limit, "rad")


def _draw(scene: Scene, times: Array, solutions: Solutions, out: Path) -> list[Path]:
    """Draw the paper's figures of a scene."""
    paths: list[Path] = []
    for name in FIGURE_NUMBERS[scene.name]:
        stem, title = caption(name, RUN_PICTURES[name].title, scene.name)
        if name == "path_of_E":
            figure = draw_path(scene, solutions)
        elif name == "position_of_E":
            values = [position_of_e(scene, each) for each in solutions.values()]
            figure = _compare(
                times, [*solutions], values, "xyz", POSITION, LEAST_POSITION_M
            )
        else:
            which = ("theta", "phi", "psi").index(name)
            values = [zyz_degrees(each, which) for each in solutions.values()]
            label = f"{ZYZ[which]} [deg]"
            figure = _compare(
                times, [*solutions], values, ZYZ[which], label, LEAST_ANGLE_DEG
            )
        paths += save(figure, title, out, stem, ["png"])
    return paths


def _compare(
    seconds: Array,
    names: Sequence[str],
    values: Sequence[Array],
    letters: str,
    label: str,
    least: float,
) -> Figure:
    """Draw columns of solutions over time; below, how far they are from the first."""
    unit = label.split("[")[1].rstrip("]")
    figure, (above, below) = stack(
        [label, f"difference from\n{names[0]} [{unit}]"], 2.7
    )
    for name, columns, looks in zip(names, values, LINES, strict=False):
        above.plot(seconds, columns, **looks)[0].set_label(name)
        if columns is not values[0]:
            apart = np.abs(columns - values[0]).max(axis=1)
            largest = f"{name}: at most {np.nanmax(apart):.1e} {unit}"
            below.plot(seconds, hide_zeros(apart), label=largest, **looks)
    widen(above, values[0], least)
    # beside the last value, those that lie there together on one line
    if len(letters) > 1:
        beside: Looks = {
            "textcoords": "offset points",
            "va": "center",
            "annotation_clip": False,
        }
        last, apart = values[0][-1], 0.06 * np.ptp(above.get_ylim())
        order = np.argsort(last, kind="stable")
        for near in np.split(order, np.flatnonzero(np.diff(last[order]) > apart) + 1):
            text = ", ".join(letters[k] for k in sorted(near))
            above.annotate(text, (seconds[-1], last[near].mean()), (4, 0), **beside)
    legend(above)
    below.set_yscale("log")
    legend(below)
    return figure


def _inverse_dynamics(scene: Scene, out: Path) -> tuple[Path, LargestDifference]:
    """Check Example 1 as the paper does.

    Inverse dynamics of the motion gives the torques back. Accelerations are those of a
    spline through the rates, so that no direct dynamics enters.
    """
    assert scene.torque is not None and scene.duration is not None
    times = np.arange(0.0, scene.duration, STEP)
    motion = simulate(scene, t_eval=times, tolerance=1e-12)
    accelerations = make_interp_spline(times, motion.gamma_dot, k=7).derivative()(times)
    mechanism = virtual_work.Mechanism.of(scene)
    rows = zip(motion.gamma, motion.gamma_dot, accelerations,
               rotation_matrix(motion.quaternion), strict=True)  # fmt: skip
    torque = np.array(
        [
            virtual_work.inverse_dynamics(
                mechanism,
                virtual_work.posture(mechanism.geometry, gamma, rotation),
                rate,
                change,
            )
            for gamma, rate, change, rotation in rows
        ]
    )
    given = scene.torque.amplitude[0] * np.sin(scene.torque.frequency[0] * times)
    apart = np.abs(torque - given[:, None]).max(axis=1)
    labels = ["torque [N m]", "largest difference\nof three actuators [N m]"]
    figure, (above, below) = stack(labels, 2.7)
    above.plot(times, given, color=BLUE, linewidth=2.6, label="1.13 sin 12t")
    above.plot(
        times,
        torque[:, 0],
        "--",
        color=VERMILION,
        linewidth=1.8,
        label="inverse dynamics of the simulated motion, actuator 1",
    )
    above.legend(fontsize=9)
    below.plot(times, hide_zeros(apart), color=VERMILION)
    below.set_yscale("log")
    title = (
        f"Inverse dynamics of Example 1, the check in the paper's text\n{ASSUMPTION}"
    )
    path = save(figure, title, out, "fig09_inverse_dynamics", ["png"])[0]
    what = "torques by inverse dynamics against 1.13 sin 12t"
    return path, LargestDifference(
        scene.name, what, float(apart.max()), TORQUE_LIMIT, "N m"
    )


def main(words: Sequence[str] | None = None) -> int:
    """Draw the figures from the command line."""
    out = Path("paper_out")
    return run(
        lambda given: all(each.within for each in paper(given.out)),
        "paper",
        out,
        words,
        careful=True,
    )


if __name__ == "__main__":
    raise SystemExit(main())
