# SPDX-License-Identifier: Apache-2.0
"""simulate(): a whole motion of a scene in one call."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import Diverged, InputError, Problem, RunStopped
from sst_ros.progress import slices
from sst_ros.scene.given import scene_of, with_initial
from sst_ros.scene.loads import Initial, SineTorque
from sst_ros.scene.scene import Scene
from sst_ros.simulation import INTEGRATORS, NANOSECONDS, WHOLE_MOTION_BUDGET, Simulation, State
from sst_ros.torque import (
    FeedbackFunction,
    FunctionTorque,
    SineProfile,
    TorqueFunction,
    TorqueProfile,
    TorqueTable,
    Triple,
    profile_of,
    three,
)
from sst_ros.trajectory import Array, Trajectory

GAUSS = "gauss"
METHODS = (*INTEGRATORS, GAUSS)

SAMPLES = 200
"""Intervals of a motion whose times nobody has named."""

TorqueInput: TypeAlias = (
    Sequence[float] | SineTorque | TorqueProfile | TorqueFunction | FeedbackFunction | None
)
InitialInput: TypeAlias = Initial | Mapping[str, Any] | tuple[ArrayLike, ArrayLike] | None


def simulate(
    scene: Scene | Mapping[str, Any] | str | Path,
    torque: TorqueInput = None,
    duration: float | None = None,
    *,
    initial: InitialInput = None,
    t_eval: ArrayLike | None = None,
    method: str = "auto",
    tolerance: float = 1e-9,
    control_period: float | None = None,
    progress: bool = False,
) -> Trajectory:
    """Simulate a motion from the initial state of a scene.

    Where a limit of the scene ends the motion, or no step resolves it, the trajectory has the part
    that is valid, and its `status` and `message` say why it ended.

    Args:
        scene: name or path of a scene, its document as a dict, or a `Scene`.
        torque: three torques [N m]; a profile (`SineTorque`, `TorqueTable`, `PolynomialTorque`, a
            `scipy.interpolate.PPoly` whose values have the shape (3,)); or a function f(t) or
            f(t, state) of the time [s] and the `State`. By default the scene's own profile, or
            zero where it has none.
        duration: length of the motion [s]; by default that of the scene.
        initial: initial state in place of the scene's: (gamma [rad], gamma_dot [rad/s]), or a
            mapping or `Initial` with gamma, gamma_dot, orientation.
        t_eval: times at which samples are returned [s], ascending, in whole nanoseconds (others
            are rounded). By default the ends of the steps of Gauss collocation, the control
            periods, or 200 even intervals.
        method: "gauss" (Gauss collocation), "dopri5", "dop853", "rk4" (explicit Runge-Kutta of
            order 5, 8, 4), "rodas4" (Rosenbrock, order 4, for stiff scenes) or "auto".
        tolerance: error of the orientation that is allowed [rad]: estimated for the whole motion
            with "gauss", for each step with the other methods.
        control_period: a function is called once a period [s], at its beginning, and its torques
            are held until the next, as those of a controller.
        progress: draw a bar on a terminal.

    Raises:
        InputError: an argument is not allowed; says which, and what is.
        AssemblyError: the initial gamma has no unique admissible assembly.
        SingularConfiguration: the motion starts from a parallel singularity.

    """
    given = with_initial(scene_of(scene), initial)
    law = _law(given, torque)
    span = _span(given, duration)
    period = _checked_period(control_period, law)
    times = _times(t_eval, span)
    _refuse_bad_options(method, tolerance)
    stepper = _Stepper(given, law, method, tolerance, span, period)
    return stepper.run(times, progress)


class _Stepper:
    """A motion by the steps of `Simulation`."""

    def __init__(
        self,
        scene: Scene,
        law: TorqueProfile | FeedbackFunction,
        method: str,
        tolerance: float,
        span: int,
        period: int | None,
    ) -> None:
        self._scene, self._law, self._span, self._period = scene, law, span, period
        self._simulation = Simulation(
            scene, method, tolerance=tolerance, step_budget=WHOLE_MOTION_BUDGET
        )
        self._samples: list[State] = []
        self._held: list[tuple[int, Triple]] = []

    def run(self, times: np.ndarray | None, progress: bool) -> Trajectory:
        """Go to the end or a limit; times [ns] of the samples, None for the ends of all steps."""
        simulation, status, message = self._simulation, 0, "reached the end"
        ends = self._ends(times)
        wanted = None if times is None else times.tolist()[::-1]
        if wanted is None or wanted[-1] == 0:
            self._samples.append(simulation.state)
            if wanted:
                wanted.pop()
        try:
            for part in slices(len(ends), 0, f"{self._scene.name}, simulating", progress):
                for end in ends[part]:
                    self._step(int(end), wanted)
        except RunStopped as stopped:
            status, message = (-1 if isinstance(stopped, Diverged) else 1), str(stopped)
            self._approach(math.floor(stopped.time * NANOSECONDS), wanted)
        return self._trajectory(status, message)

    def _ends(self, times: np.ndarray | None) -> np.ndarray:
        """Return the ends of the steps [ns]: control periods, breaks of the torque, samples."""
        if self._period is not None:
            ends = np.arange(self._period, self._span, self._period, dtype=np.int64)
            return np.append(ends, self._span)
        if times is None:
            times = np.rint(np.linspace(0, self._span, SAMPLES + 1)).astype(np.int64)
        breaks = self._law.breaks() if isinstance(self._law, TorqueProfile) else np.empty(0)
        found = np.union1d(times, np.rint(breaks * NANOSECONDS).astype(np.int64))
        return np.union1d(found[(found > 0) & (found < self._span)], self._span)

    def _step(self, end: int, wanted: list[int] | None) -> None:
        simulation = self._simulation
        begin = simulation.time_ns
        simulation.step(self._torque(begin, end), end - begin)
        if wanted is None:
            self._samples.append(simulation.state)
            return
        while wanted and wanted[-1] <= end:
            self._samples.append(simulation.within(wanted.pop()))

    def _approach(self, end: int, wanted: list[int] | None) -> None:
        """Add the last valid state before a limit, whose time is known to the nanosecond."""
        simulation = self._simulation
        begin = simulation.time_ns
        if end <= begin:
            return
        try:
            torque = self._held[-1][1] if self._held else self._torque(begin, end)
            simulation.step(torque, end - begin)
        except RunStopped:
            return
        while wanted and wanted[-1] < end:
            self._samples.append(simulation.within(wanted.pop()))
        self._samples.append(simulation.state)

    def _torque(self, begin: int, end: int) -> Any:
        """Torques of the step from begin to end [ns]: numbers, or a function of time."""
        law, start = self._law, begin / NANOSECONDS
        if self._period is None:
            assert isinstance(law, TorqueProfile)
            piece = law.between(start, end / NANOSECONDS)
            return getattr(piece, "torque", piece)
        value = law(start) if isinstance(law, TorqueProfile) else law(start, self._simulation.state)
        torque = three(value, f"torque({start:g})")
        self._held.append((begin, torque))
        return torque

    def _trajectory(self, status: int, message: str) -> Trajectory:
        simulation, samples = self._simulation, self._samples
        law: Any = self._law
        if self._held:
            times, torques = zip(*self._held, strict=True)
            law = TorqueTable(np.array(times) / NANOSECONDS, torques)
        reasons = [f"{at:g} s: {to} ({why})" for at, to, why in simulation.changes]
        return Trajectory(
            self._scene,
            np.array([state.time_ns for state in samples]) / NANOSECONDS,
            np.array([state.quaternion for state in samples]).reshape(-1, 4),
            np.array([state.body_rate for state in samples]).reshape(-1, 3),
            np.array([state.torque for state in samples]).reshape(-1, 3),
            joints=np.array([sum(state.joints, ()) for state in samples]).reshape(-1, 18),
            status=status,
            message=message,
            method="; ".join([simulation.method, *reasons]),
            error_estimate=simulation.error_estimate,
            energy_residual=simulation.energy_residual,
            law=law,
        )


def _law(scene: Scene, torque: TorqueInput) -> TorqueProfile | FeedbackFunction:
    if torque is not None:
        return profile_of(torque)
    return profile_of((0.0, 0.0, 0.0)) if scene.torque is None else SineProfile(scene.torque)


def _span(scene: Scene, duration: float | None) -> int:
    """Length of the motion [ns]."""
    length = scene.duration if duration is None else duration
    if length is None:
        allowed = "must be given: the scene has none"
        raise InputError("simulate", [Problem("duration", None, allowed)])
    return _nanoseconds("duration", length)


def _nanoseconds(name: str, value: Any) -> int:
    try:
        seconds = float(value)
    except (TypeError, ValueError):
        seconds = math.nan
    if not (math.isfinite(seconds) and 1e-9 <= seconds <= 9e9):
        allowed = "must be a number from 1e-9 to 9e9 [s]"
        raise InputError("simulate", [Problem(name, value, allowed)])
    return round(seconds * NANOSECONDS)


def _checked_period(period: float | None, law: Any) -> int | None:
    if period is None:
        if not isinstance(law, TorqueProfile):
            allowed = "must be given for a function f(t, state), whose torques are held between"
            raise InputError("simulate", [Problem("control_period", None, allowed)])
        return None
    if isinstance(law, TorqueProfile) and not isinstance(law, FunctionTorque):
        allowed = "is for a function; give none for numbers and profiles"
        raise InputError("simulate", [Problem("control_period", period, allowed)])
    return _nanoseconds("control_period", period)


def _times(t_eval: ArrayLike | None, span: int) -> np.ndarray | None:
    """Return the times of the samples [ns]."""
    if t_eval is None:
        return None
    try:
        times: Array = np.atleast_1d(np.asarray(t_eval, dtype=float))
        fits = times.ndim == 1 and len(times) and np.all(np.isfinite(times))
    except (TypeError, ValueError):
        fits = False
    if fits:
        rounded = np.rint(times * NANOSECONDS).astype(np.int64)
        if rounded[0] >= 0 and rounded[-1] <= span and np.all(np.diff(rounded) > 0):
            return rounded
    allowed = f"must be ascending times from 0 to {span / NANOSECONDS:g} s, a nanosecond apart"
    raise InputError("simulate", [Problem("t_eval", t_eval, allowed)])


def _refuse_bad_options(method: str, tolerance: float) -> None:
    problems = []
    if method not in METHODS:
        problems.append(Problem("method", method, "must be one of " + ", ".join(METHODS)))
    if not (isinstance(tolerance, (int, float)) and 0.0 < tolerance < math.inf):
        problems.append(Problem("tolerance", tolerance, "must be a number > 0 [rad]"))
    if problems:
        raise InputError("simulate", problems)
