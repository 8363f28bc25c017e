# SPDX-License-Identifier: Apache-2.0
"""A motion of a scene as a table over time, simulated or recorded.

Between its samples states are propagated from the sample before, under the torques that
act there.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.dynamics import kernel
from sst_ros.dynamics.motion_table import JOINT_QUANTITIES, MotionTable
from sst_ros.dynamics.reactions import REACTION_UNITS, Reactions, reactions_of
from sst_ros.dynamics.traced_dynamics import STATE_SIZE, Dynamics
from sst_ros.dynamics.variational import Sensitivities, Sensitivity
from sst_ros.errors import (
    Check,
    Diverged,
    MissingDependency,
    check_kinds,
    read_numbers,
    refusal,
    refuse_errors,
    refuse_unless,
    require,
)
from sst_ros.integration.methods import DOP853
from sst_ros.integration.stepper import WHOLE_MOTION_BUDGET, EvaluationBudget
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.generic_math import triple
from sst_ros.mechanism.geometry import Geometry, rotation_matrix, unwrap_zyz
from sst_ros.scene.scene import Scene
from sst_ros.scene.torque_profile import (
    LostTorque,
    TorqueProfile,
    TorqueTable,
    ascend,
    profile_from,
    profile_of,
)
from sst_ros.scene.yaml_document import dump, read
from sst_ros.simulation.stepped_motion import SteppedMotion, Task
from sst_ros.simulation.tables import SUFFIXES, load_table, write_table
from sst_ros.state import (
    DIMENSIONS,
    JOINT_COUNT,
    LAGGED_TORQUES,
    MOTION_UNITS,
    QUANTITIES,
    QUATERNION,
    STAR_RATE,
    Array,
    TimesLike,
    cached_property,
    freeze,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

_METADATA_KEY = "sst_ros"
"""Key of the text in a file about the motion as a whole."""
_FORMAT = 1
"""Number of the form of that text; a file of another form is refused."""
_LOADABLE = "must be a trajectory that `Trajectory.save` has written as Parquet or NPZ"
_BETWEEN_SAMPLES = 1e-13
"""Tolerance of a step between samples: there are few, so their errors do not add up."""
_UNIT_DEVIATION = 1e-6
"""Largest deviation of the length of a quaternion from 1 in a file."""
_CLOSURE = 0.02
"""Largest abs(r_k . t_k) in a file. A simulated motion has 1e-15; a recorded one has
the noise of its encoders. What exceeds this is the orientation of another motion.
"""

_STATUSES = (-1, 0, 1, 2)
_UNMET = 2
"""Status of a motion that reached its end, its error estimate above the tolerance."""


@dataclass(frozen=True)
class RunRecord:
    """What is known of a run as a whole.

    Attributes:
        status: 0 where the motion reached its end, 1 where a limit ended it, 2 where it
            reached its end with an error estimate above the tolerance, -1 where no step
            resolved it.
        message: the same in words.
        method: the integrator, and why it was chosen.
        error_estimate: estimated error of the orientation at the end [rad], nan if
            unknown.
        energy_residual: energy at the end, less that at the start, less the work done
            [J], nan if unknown; `ends` take its place where they are known.
        evaluations: how often the derivative was evaluated.
        step: mean length of the steps of the integrator [s], nan if unknown.
        law: torques that act between the samples, for `Trajectory.at`, as `simulate`
            takes them; by default each is held over the interval that ends at its
            sample.
        parameters: numbers of the scene, its start or its torques by which
            `Trajectory.sensitivities` differentiates.
        ends: states at the start and at the end of the run, in each the work done until
            then [J] as the last number.
        dense: a function from times [s], shape (m,), to states, shape (m, 7), or (m,
            10) with the torques, which `Trajectory.at` uses in place of the law. Copies
            do not have it.

    Raises:
        InputError: the status is none of these.

    """

    status: int = 0
    message: str = ""
    method: str = ""
    error_estimate: float = float("nan")
    energy_residual: float = float("nan")
    evaluations: int = 0
    step: float = float("nan")
    law: TorqueProfile | None = None
    parameters: tuple[str, ...] = ()
    ends: tuple[Sequence[float], Sequence[float]] | None = None
    dense: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        is_known = type(self.status) is int and self.status in _STATUSES
        requirement = f"must be one of {_STATUSES}"
        refuse_unless("trajectory", ("status", self.status, is_known, requirement))
        if self.law is not None:
            object.__setattr__(self, "law", profile_of(self.law))

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or another process gets: not the function `dense`."""
        return vars(self) | {"dense": None}


UNKNOWN = RunRecord()
"""Of a motion that comes from no run."""

FIGURES = (
    "status", "message", "method", "error_estimate", "energy_residual", "evaluations",
    "step",
)  # fmt: skip
"""What a run says of itself in files and in xarray."""

_TEXTS = ("message", "method")
"""Figures that are text; the others are numbers."""


def read_figures(document: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a run that a document has.

    Raises:
        TypeError: one is of another kind.

    """
    figures = {name: document[name] for name in FIGURES if name in document}
    for name, value in figures.items():
        types = (str,) if name in _TEXTS else (int, float)
        if type(value) not in types:
            raise TypeError(f"{name} = {value!r}")
    return figures


def record_of_pickle(values: dict[str, Any]) -> RunRecord:
    """Return the record of a trajectory that version 0.2 or before has pickled.

    There all that is known of the run stood among the arrays.
    """
    names = {field.name for field in fields(RunRecord)}
    record_fields = {name: value for name, value in values.items() if name in names}
    record_fields["energy_residual"] = values["_residual"]
    record_fields["parameters"] = values["_parameters"]
    return RunRecord(**record_fields)


def check_error(
    error: float, tolerance: float, status: int, message: str
) -> tuple[int, str]:
    """Return status and message of a motion with an error estimate at its end [rad]."""
    if not error > tolerance:
        return status, message
    unmet = f"the error estimate {error:.1e} rad exceeds"
    return status or _UNMET, f"{message}; {unmet} the tolerance {tolerance:g} rad"


class Trajectory(MotionTable):
    """A motion over n instants. Arrays are its own, and read-only.

    Args:
        scene: what moves.
        t: times [s], shape (n,), strictly ascending.
        quaternion: orientations (x, y, z, w) of {E} in {B}, shape (n, 4).
        body_rate: angular velocities of the star in {E} [rad/s], shape (n, 3).
        torque: torques that act at the actuators [N m], shape (n, 3), as in
            `State.torque`.
        run: what is known of the run; its fields are attributes of the motion, too.
        joints: angles and rates of the joints where they are known already, shape (n,
            18): gamma, mu, beta [rad], gamma_dot, mu_dot, beta_dot [rad/s]. By default
            they are computed.
        gaps: spans of time [s] of which nothing is known, begin and end, shape (g, 2);
            `at` refuses times inside of them.

    Raises:
        InputError: shapes do not fit, or times do not ascend.

    """

    def __init__(
        self,
        scene: Scene,
        t: TimesLike,
        quaternion: ArrayLike,
        body_rate: ArrayLike,
        torque: ArrayLike,
        *,
        run: RunRecord = UNKNOWN,
        joints: ArrayLike | None = None,
        gaps: ArrayLike = (),
    ) -> None:
        self.scene = scene
        self.run = run
        self.t = _own("t", t)
        self.quaternion = _own("quaternion", quaternion)
        self.body_rate = _own("body_rate", body_rate)
        self.torque = _own("torque", torque)
        if np.size(gaps) == 0:
            gaps = np.empty((0, 2))
        self.gaps = _own("gaps", gaps)
        sizes = {"quaternion": 4, "body_rate": 3, "torque": 3}
        if joints is not None:
            self._joints = _own("joints", joints)
            sizes["_joints"] = 2 * JOINT_COUNT
        are_pairs = self.gaps.ndim == 2 and self.gaps.shape[1] == 2
        are_spans = are_pairs and ascend(self.gaps.ravel())
        spans_requirement = "must be rising pairs of times [s], shape (g, 2)"
        checks: list[Check] = [
            ("scene", scene, isinstance(scene, Scene), "must be a Scene"),
            ("run", run, isinstance(run, RunRecord), "must be a RunRecord"),
            ("t", t, ascend(self.t), "must be finite, ascending times [s], shape (n,)"),
            ("gaps", gaps, are_spans, spans_requirement),
        ]
        for name, size in sizes.items():
            shape = vars(self)[name].shape
            required = (self.t.size, size)
            requirement = f"must have the shape {required}"
            checks.append((name.strip("_"), shape, shape == required, requirement))
        refuse_unless("trajectory", *checks)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the state of a copy or a pickle, also of a version without records."""
        if "run" not in state:
            record = record_of_pickle(state)
            names = (
                "scene", "t", "quaternion", "body_rate", "torque", "gaps", "_joints",
            )  # fmt: skip
            state = {name: state[name] for name in names if name in state}
            state["run"] = record
        super().__setstate__(state)

    @property
    def status(self) -> int:
        """0 at the end, 1 at a limit, 2 above the tolerance, -1 where no step did."""
        return self.run.status

    @property
    def message(self) -> str:
        """The status in words."""
        return self.run.message

    @property
    def method(self) -> str:
        """The integrator, and why it was chosen."""
        return self.run.method

    @property
    def error_estimate(self) -> float:
        """Estimated error of the orientation at the end [rad], nan if unknown."""
        return self.run.error_estimate

    @property
    def evaluations(self) -> int:
        """How often the derivative was evaluated."""
        return self.run.evaluations

    @property
    def step(self) -> float:
        """Mean length of the steps of the integrator [s], nan if unknown."""
        return self.run.step

    @property
    def law(self) -> TorqueProfile | None:
        """Torques that act between the samples, None where each is held."""
        return self.run.law

    @property
    def success(self) -> bool:
        """Whether the motion reached its end."""
        return self.status == 0

    @cached_property
    def _joints(self) -> Array:
        """Angles and rates of the joints, shape (n, 18)."""
        with np.errstate(all="ignore"):
            joints = kernel.joints(self._dynamics.model, self._columns)
        columns = [np.broadcast_to(x, self.t.shape) for row in joints for x in row]
        return freeze(np.stack(columns, axis=1))

    def _joint(self, name: str) -> Array:
        first = 3 * JOINT_QUANTITIES.index(name)
        return self._joints[:, first : first + 3]

    @cached_property
    def gamma_ddot(self) -> Array:
        """Accelerations of the actuators [rad/s^2], shape (n, 3).

        They are those under `torque` and the scene's loads, without a moment from a
        topic.
        """
        model = self._dynamics.model._replace(time_constant=None)
        y = self._columns
        with np.errstate(all="ignore"):
            slope = kernel.derivative(model, y, triple(self.torque.T))
            acceleration = triple(slope[STAR_RATE])
            accelerations = kernel.actuator_acceleration(model, y, acceleration)
        return freeze(
            np.stack([np.broadcast_to(x, self.t.shape) for x in accelerations], axis=1)
        )

    @cached_property
    def reactions(self) -> Reactions:
        """Forces and moments at every joint, see `Reactions`.

        They are those under `torque` and the scene's loads, without a moment from a
        topic.
        """
        reactions = reactions_of(
            self.scene, self.t, self.quaternion, self.body_rate, self.torque
        )
        return replace(reactions, gaps=self.gaps)

    @cached_property
    def euler_zyz(self) -> Array:
        """ZYZ angles (theta, phi, psi) of {E} in {B} without jumps [rad], (n, 3)."""
        return freeze(unwrap_zyz(super().euler_zyz))

    @cached_property
    def energy(self) -> Array:
        """Kinetic and potential energy [J], shape (n,)."""
        with np.errstate(all="ignore"):
            model = self._dynamics.model
            columns = self._columns
            kinetic = kernel.kinetic_energy(model, columns)
            potential = kernel.potential_energy(model, columns)
        return freeze(np.broadcast_to(kinetic + potential, self.t.shape))

    @cached_property
    def energy_residual(self) -> float:
        """Energy at the end, less that at the start, less the work done [J].

        It is nan if unknown.
        """
        if self.run.ends is None:
            return self.run.energy_residual
        start, end = self.run.ends
        work = end[-1]
        energy = self._dynamics.total_energy
        return energy(end) - energy(start) - work

    @cached_property
    def closure_error(self) -> float:
        """Largest abs(r_k . t_k) of all samples, 0 if the loops are exactly closed."""
        rotation = rotation_matrix(self.quaternion)
        geometry = Geometry.of(self.scene)
        closure = kinematics.closure(geometry, self.gamma, rotation)
        return float(np.abs(closure).max(initial=0.0))

    @cached_property
    def sensitivities(self) -> dict[str, Sensitivity]:
        """Derivatives of the samples by each parameter given to `simulate`, by name.

        They are computed when they are first asked for.

        Raises:
            InputError: a parameter does not fit the scene or the torques.

        """
        if not self.run.parameters or self.law is None:
            return {}
        return Sensitivities(self.scene, self.run.parameters, self.law).at(self.t)

    @property
    def _dynamics(self) -> Dynamics:
        return Dynamics.of(self.scene)

    @property
    def _columns(self) -> tuple[Array, ...]:
        return (*self.quaternion.T, *self.body_rate.T)

    @check_kinds
    def at(self, t: TimesLike) -> Trajectory:
        """Sample the motion at other times, ascending, to the accuracy of the run.

        Each state is integrated from the sample before it, under the torques that act
        there.

        Args:
            t: one time or times [s], shape (m,), within the trajectory.

        Raises:
            InputError: a time lies outside, or in a gap; or between samples that were
                loaded from a file, of a run under a function.

        """
        times = np.atleast_1d(read_numbers("at", "t", t, seconds=True))
        first = self.t[0]
        last = self.t[-1]
        inside = bool(np.all((times >= first) & (times <= last)))
        fits = times.ndim == 1 and times.size > 0 and inside
        requirement = f"must be times from {first:g} to {last:g} s, shape (m,)"
        refuse_unless("at", ("t", t, fits, requirement))
        if isinstance(self.law, LostTorque):
            are_samples = bool(np.all(np.isin(times, self.t)))
            requirement = (
                "must be times of samples:"
                " the function of the torques is not in the file"
            )
            refuse_unless("at", ("t", t, are_samples, requirement))
        for begin, end in self.gaps.tolist():
            outside = not np.any((times > begin) & (times < end))
            requirement = f"nothing is known of the motion from {begin:g} to {end:g} s"
            refuse_unless("at", ("t", t, outside, requirement))
        states = _propagate(self, times)
        return Trajectory(
            self.scene,
            times,
            states[:, QUATERNION],
            states[:, STAR_RATE],
            states[:, LAGGED_TORQUES],
            run=self.run,
            gaps=self.gaps,
        )

    def __getitem__(self, rows: slice) -> Trajectory:
        """Return the samples of a slice, as in `motion[::10]`.

        Raises:
            InputError: it is no slice, or has no samples.

        """
        fits = isinstance(rows, slice) and len(self.t[rows]) > 0
        requirement = "must be a slice with samples"
        refuse_unless("trajectory", ("rows", rows, fits, requirement))
        return Trajectory(
            self.scene,
            self.t[rows],
            self.quaternion[rows],
            self.body_rate[rows],
            self.torque[rows],
            run=self.run,
            joints=self._joints[rows],
            gaps=self.gaps,
        )

    def to_pandas(self, *, reactions: bool = False) -> pd.DataFrame:
        """Return a table: a row an instant, a column a number, units in its `attrs`.

        With `reactions` the columns of `Reactions.columns` follow.
        """
        table = super().to_pandas()
        if reactions:
            units = table.attrs["units"] | REACTION_UNITS
            table = table.assign(**self.reactions.columns())
            table.attrs["units"] = units
        return table

    @check_kinds
    def save(
        self, path: str | Path, *, overwrite: bool = False, reactions: bool = False
    ) -> None:
        """Write a file: whole, or not at all.

        Others may read and write the same path meanwhile.

        Args:
            path: ends in .parquet or .npz, which `load` reads back to the bit, units
                (Parquet) and scene included; or in .csv, the table of `to_pandas` for
                other programs.
            overwrite: replace a file that exists.
            reactions: append the columns of `Reactions.columns` to a .csv; a trajectory
                that is loaded from another file computes them.

        Raises:
            InputError: the suffix is another, the file exists, or it cannot be written.
            MissingDependency: pyarrow (.parquet) or pandas (.csv) is not installed.

        """
        path = Path(path)
        has_suffix = path.suffix in SUFFIXES
        suffixes = f"must end in {' or '.join(SUFFIXES)}"
        # `exists` of a Path raises on long names
        is_free = overwrite or not os.path.exists(path)  # noqa: PTH110
        fits = not reactions or path.suffix == ".csv"
        refuse_unless(
            "save",
            ("path", str(path), has_suffix, suffixes),
            ("path", str(path), is_free, "exists; overwrite=True replaces it"),
            ("reactions", True, fits, "is for .csv alone"),
        )
        about = self._of_run() | {
            "format": _FORMAT,
            "scene": dump(self.scene),
            "torque": None if self.law is None else self.law.record(),
            "gaps": self.gaps.tolist(),
        }
        units = {name: {"unit": unit} for name, unit in MOTION_UNITS.items()}
        columns = self.columns()
        if reactions:
            columns |= self.reactions.columns()
        with refuse_errors("save", "path", str(path), "must be writable", OSError):
            write_table(columns, path, units, {_METADATA_KEY: json.dumps(about)})

    @classmethod
    @check_kinds
    def load(cls, path: str | Path) -> Trajectory:
        """Read a Parquet or NPZ file that `save` has written.

        Raises:
            InputError: there is no such file, it holds no trajectory, or it is damaged.
            MissingDependency: pyarrow (.parquet) is not installed.

        """
        try:
            names = list(MOTION_UNITS)
            columns, texts = load_table(Path(path), names, [_METADATA_KEY])
            about = json.loads(texts[_METADATA_KEY])
        except (KeyError, ValueError, RecursionError) as error:
            reason = "" if isinstance(error, KeyError) else f" ({error})"
            raise refusal("load", "path", str(path), _LOADABLE + reason) from None
        form = about.get("format") if isinstance(about, dict) else None
        refuse_unless("load", ("format", form, form == _FORMAT, f"must be {_FORMAT}"))
        _check_columns(path, columns)
        arrays = {}
        for name, (_, dimension) in QUANTITIES.items():
            components = [columns[f"{name}_{part}"] for part in DIMENSIONS[dimension]]
            arrays[name] = np.stack(components, axis=1)
        try:
            law = about["torque"]
            if law:
                law = profile_from(law)
            motion = cls(
                read(Scene, about["scene"], str(path)),
                columns["t"],
                arrays["quaternion"],
                arrays["body_rate"],
                arrays["torque"],
                run=RunRecord(**read_figures(about), law=law),
                joints=np.hstack([arrays[name] for name in JOINT_QUANTITIES]),
                gaps=about.get("gaps", ()),
            )
        except (TypeError, ValueError, LookupError, AttributeError) as error:
            reason = f" (its metadata: {type(error).__name__}: {error})"
            raise refusal("load", "path", str(path), _LOADABLE + reason) from None
        _check_orientations(motion)
        return motion

    def _of_run(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in FIGURES}

    def _torque_lines(self) -> tuple[Array, Array]:
        """Return torques [N m], shape (m, 3), and times [s] whose lines show them.

        Torques that are held are steps, as they acted between the samples.
        """
        law = self.law
        if self.scene.lags or not len(self):
            return self.torque, self.t
        if law is None:  # each over the interval that ends at its sample
            times = np.repeat(self.t, 2)
            return np.repeat(self.torque, 2, axis=0)[1:], times[:-1]
        if not isinstance(law, TorqueTable):
            return self.torque, self.t
        kinks = law.kinks()
        inside = kinks[(kinks > self.t[0]) & (kinks < self.t[-1])]
        times = np.sort(np.concatenate([self.t, inside, inside]))
        # Of the two points at a step the first has the torque before it.
        is_first = np.append(times[1:] == times[:-1], False)
        acting_times = np.where(is_first, np.nextafter(times, -np.inf), times)
        return _clip_torques(self, law, acting_times), times

    def plot(self) -> Figure:
        """Draw actuator angles, rates, torques and the energy of the samples.

        Needs matplotlib.
        """
        require("matplotlib")
        from sst_ros.figures import DEGREES, Panel, draw_panels, leg_names

        torque = Panel("τ [N m]", leg_names("τ"), *self._torque_lines())
        panels = (
            Panel("γ [deg]", leg_names("γ"), DEGREES * self.gamma),
            Panel("γ̇ [rad/s]", leg_names("γ̇"), self.gamma_dot),
            torque,
            Panel("energy [J]", ["energy"], self.energy[:, None]),
        )
        figure = draw_panels(self.t, panels, gaps=self.gaps)
        figure.suptitle(f"{self.scene.name}: {self.message}")
        return figure

    def _facts(self) -> dict[str, object]:
        span = f"{self.t[0]:g} to {self.t[-1]:g}" if len(self) else "no samples"
        return {
            "scene": self.scene.name,
            "samples": len(self),
            "time [s]": span,
            "status": f"{self.status}: {self.message}",
            "method": self.method,
            "error estimate [rad]": self.error_estimate,
        }

    def _repr_html_(self) -> str:
        svg = ""
        with contextlib.suppress(MissingDependency):
            figure = self.plot()
            from sst_ros.figures import encode

            svg = encode(figure, "svg").decode()
        without_header = svg[max(svg.find("<svg"), 0) :]
        return super()._repr_html_() + without_header


def _own(name: str, value: TimesLike) -> Array:
    """Return an argument as a read-only array; `t` may be durations."""
    return freeze(read_numbers("trajectory", name, value, seconds=name == "t"))


def _check_columns(path: str | Path, columns: dict[str, Array]) -> None:
    """Refuse columns of a file that are no numbers, not finite or unequally long."""
    shape = columns["t"].shape
    for name, column in columns.items():
        are_numbers = column.dtype.kind in "fiu"
        are_finite = not are_numbers or bool(np.isfinite(column).all())
        fits = column.shape == shape
        refuse_unless(
            f"load: {path}",
            (name, str(column.dtype), are_numbers, "must be numbers"),
            (name, column.shape, fits, f"must have the shape {shape}"),
            (name, "nan", are_finite, "must be finite"),
        )


def _check_orientations(motion: Trajectory) -> None:
    """Refuse orientations of a file that are none, or those of another motion."""
    lengths = np.linalg.norm(motion.quaternion, axis=1)
    deviation = float(np.abs(lengths - 1.0).max(initial=0.0))
    is_unit = deviation <= _UNIT_DEVIATION
    unit = f"must be of length 1 to {_UNIT_DEVIATION:g}"
    opening = motion.closure_error
    is_closed = opening <= _CLOSURE
    closed = f"must close the loops with gamma: abs(r_k . t_k) <= {_CLOSURE:g}"
    refuse_unless(
        "load",
        ("quaternion", deviation, is_unit, unit),
        ("quaternion", opening, is_closed, closed),
    )


def _clip_torques(trajectory: Trajectory, law: TorqueProfile, times: Array) -> Array:
    """Return the torques of a law at times [s], within the limit of the actuators."""
    limit = trajectory.scene.torque_limit or np.inf
    return np.asarray(np.clip(law.values(times), -limit, limit))


def _propagate(trajectory: Trajectory, times: Array) -> Array:
    """Return states at times [s] inside, shape (m, 10).

    A state is the quaternion, the body rate and the acting torque.
    """
    if trajectory.run.dense is not None:
        states = trajectory.run.dense(times)
        has_torques = states.shape[1] > STATE_SIZE
        if has_torques or trajectory.law is None:
            return states
        return np.hstack([states, _clip_torques(trajectory, trajectory.law, times)])
    t = trajectory.t
    size = len(trajectory._dynamics.state)
    samples = np.hstack(
        [trajectory.quaternion, trajectory.body_rate, trajectory.torque]
    )
    before = np.searchsorted(t, times, side="right") - 1
    propagated = samples[before]
    # One run from each sample behind which states are asked for.
    for k in np.unique(before[times > t[before]]):
        rows = np.flatnonzero((before == k) & (times > t[k]))
        distinct_times, places = np.unique(times[rows], return_inverse=True)
        task = Task(
            scene=trajectory.scene,
            torque=trajectory.law or profile_of(trajectory.torque[k + 1]),
            span=(float(t[k]), float(distinct_times[-1])),
            times=distinct_times,
            method=DOP853.name,
            tolerance=_BETWEEN_SAMPLES,
        )
        budget = EvaluationBudget(WHOLE_MOTION_BUDGET, whole_run=True)
        motion = SteppedMotion(task, samples[k, :size], budget, limits=False).run()
        if motion.status:
            raise Diverged(motion.message, motion.time, motion.state())
        table = motion.samples.table()
        states = np.hstack([table.quaternion, table.body_rate, table.torque])
        propagated[rows] = states[places]
    return propagated
