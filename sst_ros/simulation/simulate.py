# SPDX-License-Identifier: Apache-2.0
"""simulate(): a whole motion of a scene in one call."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import InputError, Problem
from sst_ros.integration.gauss_motion import NotSmooth
from sst_ros.scene.loads import Initial, SineTorque
from sst_ros.scene.scene import Scene, scene_of, with_initial
from sst_ros.simulation.simulate_gauss import CollocatedMotion
from sst_ros.simulation.simulate_steps import stepped
from sst_ros.simulation.simulation import AUTO, INTEGRATORS, NANOSECONDS
from sst_ros.simulation.torque import profile_of
from sst_ros.simulation.torque_profile import (
    ConstantTorque,
    FeedbackFunction,
    FunctionTorque,
    SineProfile,
    TorqueFunction,
    TorqueProfile,
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
    progress: bool = False,
) -> Trajectory:
    """Simulate a motion from the initial state of a scene.

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
            periods, or 200 even intervals.
        method: "gauss" (Gauss collocation), "dopri5", "dop853", "rk4" (explicit Runge-Kutta of
            order 5, 8, 4), "rodas4" (Rosenbrock, order 4, for stiff scenes) or "auto".
        tolerance: error of the orientation at the end that is allowed [rad]. A motion whose
            `error_estimate` exceeds it is run again by smaller steps, up to twice. With
            `control_period` it runs once, and the tolerance is that of the local error of a step;
            "rk4" has none.
        control_period: a function is called once a period [s], at its beginning, and its torques
            are held until the next, as those of a controller. Without it a function is part of the
            differential equation, called in each stage of a step, and must have no memory.
        progress: draw a bar on a terminal.

    Raises:
        InputError: an argument is not allowed; names it and the allowed values.
        AssemblyError: the initial gamma has no unique admissible assembly.
        SingularConfiguration: the motion starts from a parallel singularity.

    """
    key: Any = None
    plain = initial is None and t_eval is None and control_period is None
    if plain and type(scene) is Scene and type(torque) in _IMMUTABLE:
        acting = torque if torque is None or type(torque) is tuple else id(torque)
        key = (id(scene), acting, duration, tolerance, method)
        known = _known.get(key)
        if known is not None:
            return known[2].trajectory(None)
    given = with_initial(scene_of(scene), initial)
    law = _law(given, torque)
    span = _span(given, duration)
    period = _checked_period(control_period, law)
    times = _times(t_eval, span)
    _refuse_bad_options(method, tolerance)
    reason = ""
    if method in (AUTO, GAUSS):
        try:
            motion = CollocatedMotion(given, law, span, period, tolerance, method == GAUSS)
        except NotSmooth as error:
            if method == GAUSS:
                raise InputError("simulate", [Problem("method", method, str(error))]) from None
            reason = f" (auto: {error})"
        else:
            if key is not None:
                _remember(key, (scene, torque, motion))
            return motion.trajectory(times)
    return stepped(given, law, method, tolerance, span, period, reason, times, progress)


_known: dict[Any, tuple[Any, Any, CollocatedMotion]] = {}
"""Motions that were prepared, with the scene and the torque whose identities their keys have."""

_IMMUTABLE = (type(None), tuple, SineTorque, SineProfile, ConstantTorque)


def _remember(key: Any, motion: tuple[Any, Any, CollocatedMotion]) -> None:
    while len(_known) >= 32:
        _known.pop(next(iter(_known)), None)
    _known[key] = motion


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
