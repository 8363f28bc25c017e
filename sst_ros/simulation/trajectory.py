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
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.dynamics import kernel
from sst_ros.dynamics.motion_table import JOINT_QUANTITIES, MotionTable
from sst_ros.dynamics.reactions import REACTION_UNITS, Reactions, reactions_of
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.dynamics.variational import Sensitivities, Sensitivity
from sst_ros.errors import (
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
    record_of,
)
from sst_ros.scene.yaml_document import dump, read
from sst_ros.simulation.stepped_motion import SteppedMotion, Task
from sst_ros.simulation.tables import SUFFIXES, load_table, write_table
from sst_ros.state import (
    DIMENSIONS,
    MOTION_UNITS,
    QUANTITIES,
    Array,
    TimesLike,
    cached_property,
    freeze,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

_KEY, _FORMAT = "sst_ros", 1
_FIGURES = (
    "status", "message", "method", "error_estimate", "energy_residual",
    "evaluations", "step",
)  # fmt: skip
"""What a run says of itself, in its files and in xarray."""

_TEXTS = ("message", "method")
"""Those of the figures that are text; the others are numbers."""

_ACCURACY = 1e-13
"""Error of a step between samples; gaps are short, so that steps do not add up."""


_STATUSES = (-1, 0, 1, 2)
_UNMET = 2
"""Status of a motion that reached its end, its error estimate above the tolerance."""


def check_error(
    error: float, tolerance: float, status: int, message: str
) -> tuple[int, str]:
    """Return status and message of a motion with an error estimate at its end [rad]."""
    if not error > tolerance:
        return status, message
    unmet = (
        f"the error estimate {error:.1e} rad exceeds the tolerance {tolerance:g} rad"
    )
    return status or _UNMET, f"{message}; {unmet}"


_UNIT_DEVIATION = 1e-6
"""Largest deviation of the length of a quaternion from 1 in a file."""
_CLOSURE = 0.02
"""Largest abs(r_k . t_k) in a file. A simulated motion has 1e-15; a recorded one has
the noise of its encoders. What exceeds this is the orientation of another motion.
"""


def _check_columns(path: str | Path, columns: dict[str, Array]) -> None:
    """Refuse columns of a file that are no numbers, not finite or unequally long."""
    count = columns["t"].shape
    for name, column in columns.items():
        number = column.dtype.kind in "fiu"
        refuse_unless(
            f"load: {path}",
            (name, str(column.dtype), number, "must be numbers"),
            (name, column.shape, column.shape == count, f"must have the shape {count}"),
            (
                name,
                "nan",
                not number or bool(np.isfinite(column).all()),
                "must be finite",
            ),
        )


def _check_figures(about: dict[str, Any]) -> None:
    """Raise TypeError where what a run says of itself is of another kind."""
    for name in _FIGURES:
        value = about.get(name, "" if name in _TEXTS else 0)
        fits = type(value) is str if name in _TEXTS else type(value) in (int, float)
        if not fits:
            raise TypeError(f"{name} = {value!r}")


class Trajectory(MotionTable):
    """A motion over n instants. Arrays are its own, and read-only.

    Args:
        scene: what moves.
        t: times [s], shape (n,), strictly ascending.
        quaternion: orientations (x, y, z, w) of {E} in {B}, shape (n, 4).
        body_rate: angular velocities of the star in {E} [rad/s], shape (n, 3).
        torque: torques that act at the actuators [N m], shape (n, 3), as in
            `State.torque`. All three are computed by `dense` when they are first asked
            for, where none is given.
        joints: angles and rates of the joints where they are known already, shape (n,
            18): gamma, mu, beta [rad], gamma_dot, mu_dot, beta_dot [rad/s]. By default
            they are computed.
        status: 0 where the motion reached its end, 1 where a limit ended it, 2 where it
            reached its end with an error estimate above the tolerance, -1 where no step
            resolved it.
        message: the same in words.
        method: the integrator, and why it was chosen.
        error_estimate: estimated error of the orientation at the end [rad], nan if
            unknown.
        energy_residual: energy at the end, less that at the start, less the work done
            [J]; a number, or a function that computes it when it is asked for.
        evaluations: how often the derivative was evaluated.
        step: mean length of the steps of the integrator [s], nan if unknown.
        law: torques that act between the samples, for `at`, as `simulate` takes them;
            by default each is held over the interval that ends at its sample.
        dense: a function from times (m,) [s] to states (m, 7 or 10) that `at` uses
            instead.
        parameters: numbers of the scene, its start or its torques that `sensitivities`
            are by.
        gaps: spans of time [s] of which nothing is known, begin and end, shape (g, 2);
            `at` refuses times inside of them.

    Raises:
        InputError: shapes do not fit, or times do not ascend.

    """

    def __init__(
        self,
        scene: Scene,
        t: TimesLike,
        quaternion: ArrayLike | None = None,
        body_rate: ArrayLike | None = None,
        torque: ArrayLike | None = None,
        *,
        joints: ArrayLike | None = None,
        status: int = 0,
        message: str = "",
        method: str = "",
        error_estimate: float = float("nan"),
        energy_residual: float | Callable[[], float] = float("nan"),
        evaluations: int = 0,
        step: float = float("nan"),
        law: Any = None,
        dense: Callable[[Array], Array] | None = None,
        parameters: Sequence[str] = (),
        gaps: ArrayLike = (),
    ) -> None:
        self.scene, self.t = scene, _own("t", t)
        self.gaps = _own("gaps", np.empty((0, 2)) if np.size(gaps) == 0 else gaps)
        spans = (
            self.gaps.ndim == 2
            and self.gaps.shape[1] == 2
            and ascend(self.gaps.ravel())
        )
        given: dict[str, Any] = {
            "quaternion": quaternion,
            "body_rate": body_rate,
            "torque": torque,
        }
        given |= {} if joints is None else {"_joints": joints}
        if dense is None or any(array is not None for array in given.values()):
            vars(self).update(
                {name: _own(name, array) for name, array in given.items()}
            )
        sizes = {"quaternion": 4, "body_rate": 3, "torque": 3, "_joints": 18}
        shapes = {
            name: (self.t.size, size)
            for name, size in sizes.items()
            if name in vars(self)
        }
        shaped = (
            (name, vars(self)[name].shape, shape) for name, shape in shapes.items()
        )
        known = type(status) is int and status in _STATUSES
        refuse_unless(
            "trajectory",
            ("scene", scene, isinstance(scene, Scene), "must be a Scene"),
            ("status", status, known, f"must be one of {_STATUSES}"),
            ("t", t, ascend(self.t), "must be finite, ascending times [s], shape (n,)"),
            ("gaps", gaps, spans, "must be rising pairs of times [s], shape (g, 2)"),
            *(
                (name.strip("_"), x, x == y, f"must have the shape {y}")
                for name, x, y in shaped
            ),
        )
        self.status, self.message, self.method = status, message, method
        self.error_estimate, self._residual = error_estimate, energy_residual
        self.evaluations, self.step = evaluations, step
        self.law: TorqueProfile | None = None if law is None else profile_of(law)
        self.dense, self._parameters = dense, tuple(parameters)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or another process gets.

        `at` integrates there from the samples.
        """
        arrays = {
            name: getattr(self, name) for name in ("quaternion", "body_rate", "torque")
        }
        return vars(self) | arrays | {"dense": None, "_residual": self.energy_residual}

    @cached_property
    def _states(self) -> Array:
        """Rows of quaternion, body rate and torque at the samples, by `dense`."""
        return freeze(_propagate(self, self.t))

    @cached_property
    def quaternion(self) -> Array:  # type: ignore[override]
        """Orientations (x, y, z, w) of {E} in {B}, shape (n, 4)."""
        return self._states[:, :4]

    @cached_property
    def body_rate(self) -> Array:  # type: ignore[override]
        """Angular velocities of the star in {E} [rad/s], shape (n, 3)."""
        return self._states[:, 4:7]

    @cached_property
    def torque(self) -> Array:
        """Torques that act at the actuators [N m], shape (n, 3)."""
        return self._states[:, 7:10]

    @property
    def success(self) -> bool:
        """Whether the motion reached its end."""
        return self.status == 0

    @cached_property
    def _joints(self) -> Array:
        """Angles and rates of the joints, shape (n, 18)."""
        with np.errstate(all="ignore"):
            found = kernel.joints(self._dynamics.model, self._columns)
        columns = [np.broadcast_to(x, self.t.shape) for row in found for x in row]
        return freeze(np.stack(columns, axis=1))

    def _joint(self, name: str) -> Array:
        first = 3 * JOINT_QUANTITIES.index(name)
        return self._joints[:, first : first + 3]

    @cached_property
    def gamma_ddot(self) -> Array:
        """Accelerations of the actuators [rad/s^2], shape (n, 3).

        They are those under `torque` and the scene's loads. A moment from a topic is no
        part of them.
        """
        model, y = self._dynamics.model._replace(time_constant=None), self._columns
        with np.errstate(all="ignore"):
            slope = kernel.derivative(model, y, triple(self.torque.T))
            found = kernel.actuator_acceleration(model, y, triple(slope[4:7]))
        return freeze(
            np.stack([np.broadcast_to(x, self.t.shape) for x in found], axis=1)
        )

    @cached_property
    def reactions(self) -> Reactions:
        """Forces and moments at every joint, see `Reactions`.

        They are those under `torque` and the scene's loads. A moment from a topic is no
        part of them.
        """
        found = reactions_of(
            self.scene, self.t, self.quaternion, self.body_rate, self.torque
        )
        return replace(found, gaps=self.gaps)

    @cached_property
    def euler_zyz(self) -> Array:
        """ZYZ angles (theta, phi, psi) of {E} in {B} without jumps [rad], (n, 3)."""
        return freeze(unwrap_zyz(super().euler_zyz))

    @cached_property
    def energy(self) -> Array:
        """Kinetic and potential energy [J], shape (n,)."""
        with np.errstate(all="ignore"):
            model, columns = self._dynamics.model, self._columns
            total = kernel.kinetic_energy(model, columns) + kernel.potential_energy(
                model, columns
            )
        return freeze(np.broadcast_to(total, self.t.shape))

    @cached_property
    def energy_residual(self) -> float:
        """Energy at the end, less that at the start, less the work done [J].

        Nan if unknown.
        """
        return float(self._residual() if callable(self._residual) else self._residual)

    @cached_property
    def closure_error(self) -> float:
        """Largest abs(r_k . t_k) of all samples: how far the loops are from closed.

        0 if exact.
        """
        rotation, geometry = rotation_matrix(self.quaternion), Geometry.of(self.scene)
        return float(
            np.abs(kinematics.closure(geometry, self.gamma, rotation)).max(initial=0.0)
        )

    @cached_property
    def sensitivities(self) -> dict[str, Sensitivity]:
        """Derivatives of the samples by each parameter given to `simulate`, by name.

        They are computed when they are first asked for. Raises InputError: no motion is
        found.
        """
        if not self._parameters or self.law is None:
            return {}
        return Sensitivities(self.scene, self._parameters, self.law).at(self.t)

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
        inside = (times >= self.t[0]) & (times <= self.t[-1])
        fits = times.ndim == 1 and times.size > 0 and bool(np.all(inside))
        allowed = f"must be times from {self.t[0]:g} to {self.t[-1]:g} s, shape (m,)"
        refuse_unless("at", ("t", t, fits, allowed))
        known = not isinstance(self.law, LostTorque) or bool(
            np.all(np.isin(times, self.t))
        )
        allowed = (
            "must be times of samples: the function of the torques is not in the file"
        )
        refuse_unless("at", ("t", t, known, allowed))
        for begin, end in self.gaps.tolist():
            outside = not np.any((times > begin) & (times < end))
            allowed = f"nothing is known of the motion from {begin:g} to {end:g} s"
            refuse_unless("at", ("t", t, outside, allowed))
        y = _propagate(self, times)
        return self._sampled(times, y[:, :4], y[:, 4:7], y[:, 7:])

    def __getitem__(self, rows: slice) -> Trajectory:
        """Return the samples of a slice, as in `motion[::10]`.

        InputError: it is none, or empty.
        """
        chosen = isinstance(rows, slice) and len(self.t[rows])
        refuse_unless(
            "trajectory", ("rows", rows, bool(chosen), "must be a slice with samples")
        )
        arrays = self.t, self.quaternion, self.body_rate, self.torque
        return self._sampled(
            *(array[rows] for array in arrays), joints=self._joints[rows]
        )

    def _sampled(self, *arrays: Array, joints: Array | None = None) -> Trajectory:
        return Trajectory(
            self.scene, *arrays, joints=joints,
            status=self.status, message=self.message, method=self.method,
            error_estimate=self.error_estimate,
            energy_residual=lambda: self.energy_residual,
            evaluations=self.evaluations, step=self.step, law=self.law,
            dense=self.dense, parameters=self._parameters, gaps=self.gaps,
        )  # fmt: skip

    def to_pandas(self, *, reactions: bool = False) -> pd.DataFrame:
        """Table with a row an instant, a column a number, units in its `attrs`.

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
        path, ends = Path(path), f"must end in {' or '.join(SUFFIXES)}"
        free = overwrite or not os.path.exists(path)  # noqa: PTH110  # Path's raises on long names
        refuse_unless(
            "save",
            ("path", str(path), path.suffix in SUFFIXES, ends),
            ("path", str(path), free, "exists; overwrite=True replaces it"),
            (
                "reactions",
                True,
                not reactions or path.suffix == ".csv",
                "is for .csv alone",
            ),
        )
        about = self._of_run() | {
            "format": _FORMAT,
            "scene": dump(self.scene),
            "torque": self.law and record_of(self.law),
            "gaps": self.gaps.tolist(),
        }
        units = {name: {"unit": unit} for name, unit in MOTION_UNITS.items()}
        columns = self.columns()
        if reactions:
            columns |= self.reactions.columns()
        with refuse_errors("save", "path", str(path), "must be writable", OSError):
            write_table(columns, path, units, {_KEY: json.dumps(about)})

    @classmethod
    @check_kinds
    def load(cls, path: str | Path) -> Trajectory:
        """Read a Parquet or NPZ file that `save` has written.

        Raises:
            InputError: there is no such file, it holds no trajectory, or it is damaged.
            MissingDependency: pyarrow (.parquet) is not installed.

        """
        allowed = (
            "must be a trajectory that `Trajectory.save` has written as Parquet or NPZ"
        )
        try:
            columns, texts = load_table(Path(path), list(MOTION_UNITS), [_KEY])
            about = json.loads(texts[_KEY])
        except (KeyError, ValueError, RecursionError) as error:
            reason = "" if isinstance(error, KeyError) else f" ({error})"
            raise refusal("load", "path", str(path), allowed + reason) from None
        form = about.get("format") if isinstance(about, dict) else None
        refuse_unless("load", ("format", form, form == _FORMAT, f"must be {_FORMAT}"))
        _check_columns(path, columns)
        arrays = {
            name: np.stack(
                [columns[f"{name}_{part}"] for part in DIMENSIONS[dimension]], axis=1
            )
            for name, (_, dimension) in QUANTITIES.items()
        }
        try:
            _check_figures(about)
            found = cls(
                read(Scene, about["scene"], str(path)),
                columns["t"],
                *(arrays[name] for name in ("quaternion", "body_rate", "torque")),
                joints=np.hstack([arrays[name] for name in JOINT_QUANTITIES]),
                law=about["torque"] and profile_from(about["torque"]),
                gaps=about.get("gaps", ()),
                **{name: about[name] for name in _FIGURES if name in about},
            )
        except (TypeError, ValueError, LookupError, AttributeError) as error:
            reason = f" (its metadata: {type(error).__name__}: {error})"
            raise refusal("load", "path", str(path), allowed + reason) from None
        lengths = np.linalg.norm(found.quaternion, axis=1)
        off = float(np.abs(lengths - 1.0).max(initial=0.0))
        refuse_unless(
            "load",
            (
                "quaternion",
                off,
                off <= _UNIT_DEVIATION,
                f"must be of length 1 to {_UNIT_DEVIATION:g}",
            ),
            (
                "quaternion",
                found.closure_error,
                found.closure_error <= _CLOSURE,
                f"must close the loops with gamma: abs(r_k . t_k) <= {_CLOSURE:g}",
            ),
        )
        return found

    def _of_run(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in _FIGURES}

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
        # Of the two points at a step the first is of before it.
        first = np.append(times[1:] == times[:-1], False)
        acting = np.where(first, np.nextafter(times, -np.inf), times)
        limit = self.scene.torque_limit or np.inf
        return np.clip(law.values(acting), -limit, limit), times

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
        return {
            "scene": self.scene.name,
            "samples": len(self),
            "time [s]": (
                f"{self.t[0]:g} to {self.t[-1]:g}" if len(self) else "no samples"
            ),
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
        return super()._repr_html_() + svg[max(svg.find("<svg"), 0) :]


def _own(name: str, value: TimesLike) -> Array:
    """Return an array that nothing can change, of times in seconds where it is `t`."""
    return freeze(read_numbers("trajectory", name, value, seconds=name == "t"))


def _propagate(trajectory: Trajectory, times: Array) -> Array:
    """Return states at times [s] inside, shape (m, 10).

    A state is the quaternion, the body rate and the acting torque.
    """
    if trajectory.dense is not None:
        states = trajectory.dense(times)
        if states.shape[1] > 7 or trajectory.law is None:
            return states
        limit = trajectory.scene.torque_limit or np.inf
        return np.hstack([states, np.clip(trajectory.law.values(times), -limit, limit)])
    t, size = trajectory.t, len(trajectory._dynamics.state)
    samples = np.hstack(
        [trajectory.quaternion, trajectory.body_rate, trajectory.torque]
    )
    before = np.searchsorted(t, times, side="right") - 1
    found = samples[before]
    for k in np.unique(before[times > t[before]]):
        rows = np.flatnonzero((before == k) & (times > t[k]))
        asked, places = np.unique(times[rows], return_inverse=True)
        law = trajectory.law or profile_of(trajectory.torque[k + 1])
        span = float(t[k]), float(asked[-1])
        task = Task(trajectory.scene, law, span, asked, DOP853.name, _ACCURACY)
        budget = EvaluationBudget(WHOLE_MOTION_BUDGET, whole_run=True)
        motion = SteppedMotion(task, samples[k, :size], budget, limits=False).run()
        if motion.status:
            raise Diverged(motion.message, motion.time, motion.state())
        table = motion.samples.table()
        states = np.hstack([table.quaternion, table.body_rate, table.torque])
        found[rows] = states[places]
    return found
