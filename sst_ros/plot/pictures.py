# SPDX-License-Identifier: Apache-2.0
"""The pictures of a recorded run: what each shows, what it needs, how it is drawn.

The motion of the star is that of Figs. 8 to 14 of the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.interpolate import CubicHermiteSpline

from sst_ros import figures
from sst_ros.dynamics.kernel import kinetic_energy, model_of, potential_energy
from sst_ros.errors import refuse_unless
from sst_ros.figures import (
    BLUE,
    DEGREES,
    GREY,
    LINES,
    VERMILION,
    Panel,
    leg_names,
    stack,
)
from sst_ros.files import write_into
from sst_ros.mechanism.geometry import (
    Array,
    Geometry,
    rotation_matrix,
    star_direction,
    zyz_angles,
)
from sst_ros.mechanism.rates import body_rates
from sst_ros.plot import workspace
from sst_ros.recording.recording import Signals
from sst_ros.recording.topic_tables import SCENE_TOPIC, TRUE_JOINT_STATES
from sst_ros.scene.scene import Scene
from sst_ros.state import NANOSECONDS

FORMATS = ("pdf", "png")
QUATERNION_COLUMNS = ("q_x", "q_y", "q_z", "q_w")
ACTUATOR_LABELS = [f"actuator {leg}" for leg in (1, 2, 3)]
FIGURE_NUMBERS = {
    "example1": {"position_of_E": 8, "psi": 9},
    "example2": {
        "path_of_E": 10,
        "position_of_E": 11,
        "theta": 12,
        "phi": 13,
        "psi": 14,
    },
}
"""Number of a picture in the paper, by the name of the scene."""
ASSUMPTION = "assumed inertias: the paper's are lost"
LEAST_POSITION_M = 0.05
LEAST_ANGLE_DEG = 1.0
"""An axis never shows a smaller range, so that rounding is a flat line."""
POSITION = "position of E in {B} [m]"
ZYZ = "θφψ"


class Picture(NamedTuple):
    """A picture of one run, or of several."""

    title: str
    needs: tuple[str, ...]  # keys of the topics without which it cannot be drawn
    #: takes a run and its scene, which is there if it is needed; or several runs
    make: Callable[..., Figure]


class CurvePanel(NamedTuple):
    """Curves over time in one panel."""

    label: str  # of the axis
    names: Sequence[str]
    values: Callable[[Signals], Array]  # of a run: a column for each name


def curves(
    *panels: CurvePanel, height: float = 2.6
) -> Callable[[Signals, Scene], Figure]:
    """Return what draws panels one above the other."""

    def draw(run: Signals, _: Scene) -> Figure:
        drawn = [Panel(panel.label, panel.names, panel.values(run)) for panel in panels]
        return figures.draw_panels(run.seconds(), drawn, height, gaps=run.gaps())

    return draw


def legs(label: str, quantity: str, letter: str) -> CurvePanel:
    """Return a panel of one quantity of the three legs."""
    return CurvePanel(label, leg_names(letter), lambda run: run.legs(quantity))


def joints(
    letters: Mapping[str, str], unit: str, scale: float = 1.0
) -> Callable[..., Figure]:
    """Return what draws quantities of the joints of the legs, by their letters.

    Where the true ones are recorded, they are the lines, and dots behind them what was
    measured.
    """

    def draw(run: Signals, _: Scene) -> Figure:
        seconds = run.seconds()
        labels = [f"{letter} [{unit}]" for letter in letters.values()]
        figure, panels = stack(labels, 2.6)
        for axes, (name, letter) in zip(panels, letters.items(), strict=True):
            if TRUE_JOINT_STATES.key not in run.missing:
                _draw_dots(axes, seconds, scale * run.legs(name))
            values = scale * run.true_legs(name)
            figures.lines(axes, seconds, values, leg_names(letter), gaps=run.gaps())
        return figure

    return draw


def _draw_dots(axes: Axes, seconds: Array, values: Array) -> None:
    """Draw what was measured, shape (n, 3), with one entry in the legend."""
    label: str | None = "measured"
    for column in values.T:
        axes.plot(seconds, column, ".", color=GREY, markersize=2, label=label)
        label = None


class LegCurves(NamedTuple):
    """A quantity of the three legs over time."""

    name: str
    seconds: Array  # shape (n,)
    values: Array  # shape (n, 3); no line is drawn at nan
    looks: Mapping[str, Any]

    @classmethod
    def of(
        cls, name: str, run: Signals, values: Array, looks: Mapping[str, Any]
    ) -> LegCurves:
        """Return values at the samples of a run, broken at its gaps."""
        seconds, broken = figures.break_lines(run.seconds(), values, run.gaps())
        return cls(name, seconds, broken, looks)


def draw_legs(label: str, curves: Sequence[LegCurves], *below: str) -> Figure:
    """Draw curves, a panel for each leg.

    Panels of the labels `below` follow, in which nothing is drawn yet.
    """
    letter, _, unit = label.partition(" ")
    figure, panels = stack([*(f"{name} {unit}" for name in leg_names(letter)), *below])
    for curve in curves:
        for axes, column in zip(panels, curve.values.T, strict=False):
            axes.plot(curve.seconds, column, label=curve.name, **curve.looks)
    figures.legend(panels[0])
    return figure


def position_of_e(scene: Scene, quaternion: Array) -> Array:
    """Position of E in {B} [m], shape (n, 3)."""
    return scene.star.radius * star_direction(rotation_matrix(quaternion))


def caption(name: str, title: str, scene: str | None) -> tuple[str, str]:
    """Return the stem of a picture's file and its title.

    The paper's figures have their number and name the assumption behind them.
    """
    if scene is None:
        return name, title
    title = f"{title}, {scene}"
    number = FIGURE_NUMBERS.get(scene, {}).get(name)
    if number is None:
        return name, title
    in_paper = f"Fig. {number} of the paper; {ASSUMPTION}"
    return f"fig{number:02d}_{name}", f"{title}\n{in_paper}"


def zyz_degrees(quaternion: Array, place: int) -> Array:
    """Return a ZYZ angle (0 theta, 1 phi, 2 psi) without jumps [deg], shape (n, 1)."""
    angle = zyz_angles(rotation_matrix(quaternion))[:, place : place + 1]
    finite = np.isfinite(angle)
    angle[finite] = np.unwrap(angle[finite])  # over lost samples too
    return np.degrees(angle)


def _position(run: Signals, scene: Scene) -> Figure:
    """Draw the coordinates of E over time."""
    quaternion = run.take(*QUATERNION_COLUMNS)
    panel = Panel(POSITION, "xyz", position_of_e(scene, quaternion))
    return figures.draw_panels(
        run.seconds(), [panel], 3.2, least_span=LEAST_POSITION_M, gaps=run.gaps()
    )


def _angle(run: Signals, _: Scene | None, place: int) -> Figure:
    """Draw one of the ZYZ angles over time."""
    degrees = zyz_degrees(run.take(*QUATERNION_COLUMNS), place)
    panel = Panel(f"{ZYZ[place]} [deg]", ZYZ[place], degrees)
    return figures.draw_panels(
        run.seconds(), [panel], 3.2, least_span=LEAST_ANGLE_DEG, gaps=run.gaps()
    )


def draw_path(scene: Scene, paths: Mapping[str, Array]) -> Figure:
    """Draw E over the base triangle, and the triangle's image at the radius of E.

    E and the triangle are at their own radius. Paths are quaternions (n, 4) by name.
    """
    figure = Figure(figsize=(6.4, 6.4))
    axes = figure.add_subplot(projection="3d")
    geometry = Geometry.of(scene)
    base = scene.base.radius
    star = scene.star.radius
    x, y, z = np.concatenate(workspace.sides(geometry, 40)).T
    outline = {"color": GREY, "linewidth": 1.6, "label": "base triangle P₁P₂P₃"}
    axes.plot(base * x, base * y, base * z, **outline)
    if star != base:
        label = "its image on the sphere of E"
        image = {"color": GREY, "linewidth": 0.9, "linestyle": ":", "label": label}
        axes.plot(star * x, star * y, star * z, **image)
    corners = geometry.v
    middle = corners.sum(axis=0) / np.linalg.norm(corners.sum(axis=0))
    # The names are inside: outside are the numbers of the axes.
    name_places = base * (corners + 0.22 * (middle - corners))
    for name, place in zip(leg_names("P"), name_places, strict=True):
        axes.text(*place, name, ha="center", va="center")
    positions = [position_of_e(scene, quaternion).T for quaternion in paths.values()]
    for name, path, looks in zip(paths, positions, LINES, strict=False):
        axes.plot(*path, label=name, **looks)
    figures.mark_ends(axes, *positions[0])
    _look_at_middle(axes, middle)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncol=3, fontsize=9)
    return figure


def _look_at_middle(axes: Any, middle: Array) -> None:
    """Label the axes of a sphere and look at it from outside, over the middle."""
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.zaxis.set_rotate_label(False)  # by itself it stands on its head
    axes.set_zlabel("z [m]", rotation=90.0)
    axes.set_box_aspect(
        np.ptp([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()], axis=1)
    )
    x, y, z = middle
    height = np.degrees(np.arctan2(z, np.hypot(x, y)))
    azimuth = np.degrees(np.arctan2(y, x))
    axes.view_init(elev=height - 8.0, azim=azimuth + 8.0)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10], prune="both"))


def _path(run: Signals, scene: Scene) -> Figure:
    """Draw the recorded path of E."""
    return draw_path(scene, {"path of E": broken_quaternions(run)})


def _tracking(run: Signals, _: Scene) -> Figure:
    """Draw the desired angle of each actuator, and the measured one over it."""
    desired_look = {"color": GREY, "linewidth": 3.2}
    measured_look = {"color": BLUE, "linewidth": 1.5, "linestyle": "--"}
    desired = DEGREES * run.legs("gamma_desired")
    measured = DEGREES * run.legs("gamma")
    series = [
        LegCurves.of("desired", run, desired, desired_look),
        LegCurves.of("measured", run, measured, measured_look),
    ]
    if TRUE_JOINT_STATES.key not in run.missing:
        true_look = {"color": VERMILION, "linewidth": 0.9, "linestyle": ":"}
        true = DEGREES * run.true_legs("gamma")
        series.append(LegCurves.of("true", run, true, true_look))
    return draw_legs("γ [deg]", series)


def _torques(run: Signals, _: Scene) -> Figure:
    """Draw the torque of each tick, and the commands over it where they were recorded.

    Commands without a stamp are drawn where the recorder received them, by its clock.
    """
    seconds, torque = tick_torques(run)
    line = {"color": BLUE, "linewidth": 3.0}
    series = [LegCurves("applied", seconds, torque, line)]
    for table in ("commands_stamped", "commands"):
        if table not in run.tables:
            continue
        command_times = run.seconds(table)
        commands = run.legs("tau", table)
        inside = (command_times >= seconds[0]) & (command_times <= seconds[-1])
        dots = {
            "color": VERMILION,
            "linestyle": "none",
            "marker": ".",
            "markersize": 1.5,
        }
        if inside.any():
            series.append(
                LegCurves("commanded", command_times[inside], commands[inside], dots)
            )
        break  # stamped ones replace those without a stamp
    return draw_legs("τ [N m]", series)


class _Ticks(NamedTuple):
    """The ticks of a run, m of them."""

    start_ns: Any  # shape (m,)
    end_ns: Any
    torque: Array  # [N m], shape (m, 3)

    @property
    def are_apart(self) -> Any:
        """Whether ticks are lost between a tick and the next, shape (m - 1,)."""
        return self.start_ns[1:] != self.end_ns[:-1]


def _ticks(run: Signals) -> _Ticks:
    """Return the recorded ticks of a run."""
    start_ns = run.time_ns("ticks")
    length_ns = run.take("length", table="ticks")[:, 0].astype(np.int64)
    return _Ticks(start_ns, start_ns + length_ns, run.legs("tau", "ticks"))


def tick_torques(run: Signals) -> tuple[Array, Array]:
    """Return times [s] and torques [N m], shape (m, 3), that draw what each tick held.

    A gap between ticks is nan.
    """
    ticks = _ticks(run)
    ends_ns = np.stack([ticks.start_ns, ticks.end_ns], axis=1)
    seconds = ends_ns.ravel() / NANOSECONDS
    torques = np.repeat(ticks.torque, 2, axis=0)
    gaps = 2 * (np.flatnonzero(ticks.are_apart) + 1)
    seconds_with_gaps = np.insert(seconds, gaps, seconds[gaps])
    return seconds_with_gaps, np.insert(torques, gaps, np.nan, axis=0)


def energies(run: Signals, scene: Scene) -> tuple[Array, Array]:
    """Return kinetic and potential energy at each sample [J], shape (n,).

    Nan where it was lost.
    """
    quaternion = run.take(*QUATERNION_COLUMNS)
    gamma_dot = run.true_legs("gamma_dot")
    mu_dot = run.true_legs("mu_dot")
    beta_dot = run.true_legs("beta_dot")
    geometry = Geometry.of(scene)
    body_rate = body_rates(geometry, quaternion, gamma_dot, mu_dot, beta_dot)
    model = model_of(scene)
    state = (*quaternion.T, *body_rate.T)
    kinetic = np.asarray(kinetic_energy(model, state))
    # The potential energy is one number where it is constant.
    return kinetic, potential_energy(model, state) + 0.0 * kinetic


def work(run: Signals) -> Array:
    """Work of each actuator from the first sample to each [J], shape (n, 3).

    A torque that is held over a tick does work by the angle of that tick. Angles at the
    ends of ticks between samples are those of the cubic through angles and rates of
    both; where ticks are lost the work is nan from there on.
    """
    time = run.time_ns("samples")
    gamma = run.true_legs("gamma")
    rate = run.true_legs("gamma_dot")
    ticks = _ticks(run)
    finite = np.isfinite(gamma).all(axis=1) & np.isfinite(rate).all(axis=1)
    if np.count_nonzero(finite) < 2:
        return np.full(gamma.shape, np.nan)
    angles = CubicHermiteSpline(time[finite] / NANOSECONDS, gamma[finite], rate[finite])
    angles_at_start = angles(ticks.start_ns / NANOSECONDS)
    angles_at_end = angles(ticks.end_ns / NANOSECONDS)
    steps = ticks.torque * (angles_at_end - angles_at_start)
    steps[1:][ticks.are_apart] = np.nan
    steps[ticks.start_ns < time[0]] = 0.0
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    ended_ticks = np.searchsorted(ticks.end_ns, time, side="right")
    is_tick_end = (time == time[0]) | np.isin(time, ticks.end_ns)
    return np.asarray(np.where(is_tick_end[:, None], total[ended_ticks], np.nan))


def _energy(run: Signals, scene: Scene) -> Figure:
    """Draw the energies, the work of the actuators, and what they differ by.

    The difference is what friction, loads from outside and the integrator took or gave.
    """
    kinetic, potential = energies(run, scene)
    # The first finite row, or none: the sums below are then zero.
    first = np.flatnonzero(np.isfinite(kinetic))[:1]
    raised = potential - potential[first].sum()
    actuator_work = work(run).sum(axis=1)
    gained = kinetic - kinetic[first].sum() + raised
    series = {"kinetic": kinetic}
    if np.nanmax(np.abs(raised), initial=0.0):  # there is gravity, or a spring
        series["potential, gained"] = raised
    series["work of the actuators"] = actuator_work
    residual = (gained - actuator_work)[:, None]
    panels = (
        Panel("energy [J]", list(series), np.stack([*series.values()], axis=1)),
        Panel("energy gained − work [J]", ["residual"], residual),
    )
    figure = figures.draw_panels(run.seconds(), panels, 2.8, gaps=run.gaps())
    figure.axes[1].axhline(0.0, color=GREY, linewidth=0.8)
    return figure


def _margins(run: Signals, scene: Scene) -> Figure:
    """Draw the distance of each leg to the nearest limit of its joints."""
    geometry = Geometry.of(scene)
    labels = ["to an end of the stroke [deg]", "to a limit of β [deg]"]
    figure, panels = stack(labels, 2.6)
    stroke_axes, beta_axes = panels
    names = [f"leg {k}" for k in (1, 2, 3)]
    for axes, angle, limit in (
        (stroke_axes, "gamma", geometry.arc),
        (beta_axes, "beta", geometry.beta_max),
    ):
        angles = run.true_legs(angle)
        distance = np.minimum(angles, limit - angles)
        degrees = DEGREES * distance
        figures.lines(axes, run.seconds(), degrees, names, gaps=run.gaps())
        axes.axhline(0.0, color="black", linewidth=0.8)
    return figure


def broken_quaternions(run: Signals) -> Array:
    """Return the orientations of the samples, with a row of nan in each gap, (n, 4)."""
    quaternions = run.take(*QUATERNION_COLUMNS)
    return figures.break_lines(run.seconds(), quaternions, run.gaps())[1]


def directions(run: Signals) -> Array:
    """Direction of E in {B} at each sample, and nan in gaps, shape (n, 3)."""
    return star_direction(rotation_matrix(broken_quaternions(run)))


def _sphere(run: Signals, scene: Scene) -> Figure:
    """Draw the path of E over how far the star's best turn keeps from every limit."""
    looks = {"color": BLUE, "linewidth": 1.8}
    return workspace.draw_paths(scene, [("path of E", directions(run), looks)])


def _power(run: Signals) -> Array:
    """Power of each actuator at the end of each step [W]."""
    return run.true_legs("tau") * run.true_legs("gamma_dot")


def _total_power(run: Signals) -> Array:
    """Power of the actuators together [W], shape (n, 1)."""
    return np.asarray(_power(run).sum(axis=1)[:, None])


JOINT_STATES_KEY = "joint_states"
ORIENTATION = "orientation"
TICKS = "applied_torques"
SCENE_KEY = SCENE_TOPIC.key
ERROR_KEY = "tracking_error"
REFERENCE = "reference"
JOINT_LETTERS = {"gamma": "γ", "mu": "μ", "beta": "β"}
_ERROR_CURVES = curves(  # as the controller received them
    legs("γ desired − γ [rad]", "gamma_error", "γ"),
    legs("γ̇ desired − γ̇ [rad/s]", "gamma_dot_error", "γ̇"),
)
_CONTROL = curves(
    legs("feedforward [N m]", "tau_feedforward", "τ"),
    legs("feedback [N m]", "tau_feedback", "τ"),
)
_POWERS = curves(
    CurvePanel("power τₖ γ̇ₖ [W]", ACTUATOR_LABELS, _power),
    CurvePanel("all three [W]", ["sum"], _total_power),
)
_ANGLE_CURVES = joints(JOINT_LETTERS, "deg", DEGREES)
_RATE_CURVES = joints(
    {f"{name}_dot": f"{letter}̇" for name, letter in JOINT_LETTERS.items()}, "rad/s"
)
_WORK = curves(CurvePanel("work [J]", ACTUATOR_LABELS, work), height=3.2)
RUN_PICTURES = {
    "path_of_E": Picture("Path of point E", (ORIENTATION, SCENE_KEY), _path),
    "position_of_E": Picture(
        "Position of point E", (ORIENTATION, SCENE_KEY), _position
    ),
    "theta": Picture("The angle θ", (ORIENTATION,), partial(_angle, place=0)),
    "phi": Picture("The angle φ", (ORIENTATION,), partial(_angle, place=1)),
    "psi": Picture("The angle ψ", (ORIENTATION,), partial(_angle, place=2)),
    "tracking": Picture(
        "Desired and measured angles", (JOINT_STATES_KEY, REFERENCE), _tracking
    ),
    "tracking_error": Picture("Tracking error", (ERROR_KEY,), _ERROR_CURVES),
    "control_torques": Picture(
        "Torques of the controller", (REFERENCE, ERROR_KEY), _CONTROL
    ),
    "torques": Picture("Torques", (TICKS,), _torques),
    "power": Picture("Power of the actuators", (JOINT_STATES_KEY,), _POWERS),
    "work": Picture("Work of the actuators", (JOINT_STATES_KEY, TICKS), _WORK),
    "energy": Picture(
        "Energy", (JOINT_STATES_KEY, ORIENTATION, TICKS, SCENE_KEY), _energy
    ),
    "joint_angles": Picture("Joint angles", (JOINT_STATES_KEY,), _ANGLE_CURVES),
    "joint_rates": Picture("Joint rates", (JOINT_STATES_KEY,), _RATE_CURVES),
    "margins": Picture(
        "Distance to the limits", (JOINT_STATES_KEY, SCENE_KEY), _margins
    ),
    "sphere": Picture("Path of E in the workspace", (ORIENTATION, SCENE_KEY), _sphere),
}


@figures.styled
def draw_run(
    run: Signals,
    folder: Path,
    only: Sequence[str] = (),
    formats: Sequence[str] = FORMATS,
) -> tuple[list[Path], dict[str, str]]:
    """Write the pictures of a run, all or those `only` names, into a folder.

    Returns the paths written, and for each picture that could not be drawn what is
    missing. Raises InputError where a name is none of RUN_PICTURES, or the folder
    cannot be written.
    """
    paths: list[Path] = []
    missing: dict[str, str] = {}
    for name in chosen_names(only, RUN_PICTURES):
        picture = RUN_PICTURES[name]
        absent = [key for key in picture.needs if key in run.missing]
        if absent:
            missing[name] = "the bag has no " + ", no ".join(absent)
            continue
        scene = run.scene.name if run.scene else None
        stem, title = caption(name, picture.title, scene)
        paths += save(picture.make(run, run.scene), title, folder, stem, formats)
    return paths, missing


def save(
    figure: Figure,
    title: str,
    folder: Path,
    stem: str,
    formats: Sequence[str] = FORMATS,
) -> list[Path]:
    """Write a figure under a title.

    Raises InputError where the folder cannot be written.
    """
    figure.suptitle(title, fontsize=11)
    paths = [folder / f"{stem}.{form}" for form in formats]
    with write_into(folder, "plot"):
        figures.save_figure(figure, *paths)
    return paths


def chosen_names(only: Sequence[str], names: Iterable[str]) -> list[str]:
    """Return the names that are asked for, all where none is.

    Raises InputError for another.
    """
    requirement = "must be one of " + ", ".join(names)
    checks = [("only", name, name in names, requirement) for name in only]
    refuse_unless("plot", *checks)
    return list(only or names)
