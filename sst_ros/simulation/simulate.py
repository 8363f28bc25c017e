# SPDX-License-Identifier: Apache-2.0
"""simulate(): a whole motion of a scene in one call."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import InputError, Problem
from sst_ros.scene.loads import Initial, SineTorque
from sst_ros.scene.scene import Scene, scene_of, with_initial
from sst_ros.simulation.simulate_gauss import CollocatedMotion, NotSmooth
from sst_ros.simulation.simulate_steps import MOST_PERIODS, Task, integrate
from sst_ros.simulation.simulation import AUTO, INTEGRATORS, NANOSECONDS
from sst_ros.simulation.torque_profile import (
    FeedbackFunction,
    FunctionTorque,
    SineProfile,
    TorqueFunction,
    TorqueProfile,
    profile_of,
)
from sst_ros.simulation.trajectory import Array, Trajectory

GAUSS = "gauss"
METHODS = (*INTEGRATORS, GAUSS)

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
    breaks: ArrayLike = (),
    max_step: float | None = None,
    progress: bool = False,
) -> Trajectory:
    """Simulate a motion from the initial state of a scene: `prepare(...).run()`.

    Where a limit of the scene ends the motion, or no step resolves it, the trajectory has the part
    that is valid, and its `status` and `message` give the reason.

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
            periods, or 200 even intervals. The steps do not depend on them.
        method: "gauss" (Gauss collocation), "dopri5", "dop853", "rk4" (explicit Runge-Kutta of
            order 5, 8, 4), "rodas4" (Rosenbrock, order 4, for stiff scenes) or "auto".
        tolerance: error of the orientation at the end that is allowed [rad]. A motion whose
            `error_estimate` exceeds it is run again by smaller steps, up to three times; if it
            still does, `status` is 2. With `control_period` it runs once.
        control_period: a function is called once a period [s], at its beginning, and its torques
            are held until the next, as those of a controller. Without it a function is part of the
            differential equation, called in each stage of a step, and must have no memory.
        breaks: times at which a function jumps or has a kink [s], ascending. Jumps in time are
            found without it, unless a pulse is shorter than a step.
        max_step: longest step [s]; by default the error alone decides. Not for collocation.
        progress: draw a bar on a terminal.

    Raises:
        InputError: an argument is not allowed; names it and the allowed values.
        AssemblyError: the initial gamma has no unique admissible assembly.
        SingularConfiguration: the motion starts from a parallel singularity.

    """
    return prepare(
        scene,
        torque,
        duration,
        initial=initial,
        t_eval=t_eval,
        method=method,
        tolerance=tolerance,
        control_period=control_period,
        breaks=breaks,
        max_step=max_step,
    ).run(progress=progress)


def prepare(
    scene: Scene | Mapping[str, Any] | str | Path,
    torque: TorqueInput = None,
    duration: float | None = None,
    *,
    initial: InitialInput = None,
    t_eval: ArrayLike | None = None,
    method: str = "auto",
    tolerance: float = 1e-9,
    control_period: float | None = None,
    breaks: ArrayLike = (),
    max_step: float | None = None,
) -> PreparedRun:
    """Prepare a motion that is run many times, by the arguments of `simulate`.

    All that does not change from run to run is done once: the scene's equations, the choice of the
    method, and for collocation of its steps.

    Raises:
        InputError, AssemblyError, SingularConfiguration: as `simulate`.

    """
    given = with_initial(scene_of(scene), initial)
    profile = _profile(given, torque)
    span = _span(given, duration)
    period = _checked_period(control_period, profile, span)
    times = _times(t_eval, span)
    _refuse_bad_options(method, tolerance)
    jumps, longest = _breaks(breaks, span), _longest(max_step)
    reason = ""
    if method in (AUTO, GAUSS):
        try:
            if len(jumps) or longest < span / NANOSECONDS:
                raise NotSmooth("collocation takes no breaks and no max_step")
            motion = CollocatedMotion(given, profile, span, period, tolerance, method == GAUSS)
        except NotSmooth as error:
            if method == GAUSS:
                raise InputError("simulate", [Problem("method", method, str(error))]) from None
            reason = f" (auto: {error})"
        else:
            return PreparedRun(lambda _: motion.trajectory(times))
    task = Task(given, profile, span, period, method, tolerance, jumps, longest)
    return PreparedRun(lambda progress: integrate(task, reason, times, progress))


class PreparedRun:
    """A motion that can be run any number of times, by several threads at once.

    A torque function is called anew in each run.
    """

    def __init__(self, run: Callable[[bool], Trajectory]) -> None:
        self._run = run

    def run(self, *, progress: bool = False) -> Trajectory:
        """Compute the motion; the trajectory has arrays of its own."""
        return self._run(progress)


def _profile(scene: Scene, torque: TorqueInput) -> TorqueProfile | FeedbackFunction:
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


def _checked_period(period: float | None, profile: Any, span: int) -> int | None:
    if period is None:
        return None
    if isinstance(profile, TorqueProfile) and not isinstance(profile, FunctionTorque):
        allowed = "is for a function; give none for numbers and profiles"
        raise InputError("simulate", [Problem("control_period", period, allowed)])
    found = _nanoseconds("control_period", period)
    if span > MOST_PERIODS * found:
        allowed = f"must be at least {span / NANOSECONDS / MOST_PERIODS:.3g} s for this duration"
        raise InputError("simulate", [Problem("control_period", period, allowed)])
    return found


def _ascending(values: ArrayLike) -> Array | None:
    """Return finite, ascending numbers as an array; None where they are none."""
    try:
        numbers: Array = np.atleast_1d(np.array(values, dtype=float))
    except (TypeError, ValueError):
        return None
    fits = numbers.ndim == 1 and np.all(np.isfinite(numbers)) and np.all(np.diff(numbers) > 0)
    return numbers if fits else None


def _breaks(breaks: ArrayLike, span: int) -> Array:
    """Return the times of jumps inside the motion [s]."""
    times = _ascending(breaks)
    if times is None:
        raise InputError("simulate", [Problem("breaks", breaks, "must be ascending times [s]")])
    return times[(times > 0.0) & (times < span / NANOSECONDS)]


def _longest(max_step: float | None) -> float:
    if max_step is None:
        return math.inf
    if isinstance(max_step, (int, float)) and not isinstance(max_step, bool) and max_step > 0.0:
        return float(max_step)
    raise InputError("simulate", [Problem("max_step", max_step, "must be a number > 0 [s]")])


def _times(t_eval: ArrayLike | None, span: int) -> np.ndarray | None:
    """Return the times of the samples [ns]."""
    if t_eval is None:
        return None
    times = _ascending(t_eval)
    if times is not None and len(times):
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
