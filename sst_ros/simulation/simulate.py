# SPDX-License-Identifier: Apache-2.0
"""simulate(): a whole motion of a scene in one call."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NoReturn, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.dynamics.initial_state import start_of
from sst_ros.dynamics.variational import Sensitivities
from sst_ros.errors import (
    check_kinds,
    read_numbers,
    refusal,
    refuse_other_rounding,
    refuse_unless,
)
from sst_ros.integration.methods import DORMAND_PRINCE
from sst_ros.integration.stepper import WHOLE_MOTION_BUDGET, EvaluationBudget
from sst_ros.mechanism.geometry import Geometry
from sst_ros.removed import REMOVED_METHODS
from sst_ros.scene.loads import Initial
from sst_ros.scene.scene import Scene, SceneInput, scene_of, with_initial
from sst_ros.scene.torque_profile import (
    FunctionTorque,
    TorqueLike,
    TorqueProfile,
    TorqueTable,
    ascend,
    profile_of,
)
from sst_ros.simulation.simulation import INTEGRATORS, describe_conditioning
from sst_ros.simulation.stepped_motion import SteppedMotion, Task
from sst_ros.simulation.trajectory import RunRecord, Trajectory, check_error
from sst_ros.state import NANOSECONDS, Array, TimesLike

_MOST_PERIODS = WHOLE_MOTION_BUDGET // (3 * len(DORMAND_PRINCE.a))
"""Control periods that the budget of a motion reaches.

A step and its check are three steps.
"""

_DEFAULT_SAMPLES = 200
"""Even intervals of a motion by default: smooth curves in a figure."""
_MOST_SAMPLES = 10_000_000
"""Most intervals of a motion: each has 29 numbers, 2.3 GB in all."""

_RUN_ATTEMPTS = 4
"""Runs until the error estimate is at most the tolerance."""
_FINEST = 1e-14
"""Least tolerance of a step: below it rounding decides."""
_RUN_MARGIN = 5.0
"""Factor by which steps of the next run are more accurate than the error asks for."""
_LEAST_GAIN = 0.5
"""Share of the last run's error: a run that keeps more of it is the last.

The error of a smooth motion falls farther from run to run; under torques that switch
with the state it does not.
"""
_FUNCTION_BUDGET = 1_000_000
"""Most evaluations of a motion that calls a function in each: half a minute."""
_BUDGET_PER_SECOND = 5_000
"""Most evaluations for each second of any other motion, if it is long enough for that
to exceed WHOLE_MOTION_BUDGET.
"""
_LONGEST_BUDGET = 50_000_000
"""Most evaluations that a long motion gets by that: a minute."""
_ADVICE = (
    "; if the torque function switches with the state, give control_period, as a"
    " controller has it, or smooth the switch"
)

_UNSEEN_ANSWER = 10.0
"""Factor of the error estimate where a controller's answer to the error is unknown.

It multiplies the largest of the errors that the controller has answered.
"""

_METHOD_WORDS = "must be one of " + ", ".join(INTEGRATORS)

InitialInput: TypeAlias = (
    Initial | Mapping[str, Any] | tuple[ArrayLike, ArrayLike] | None
)


@check_kinds
def simulate(
    scene: SceneInput,
    torque: TorqueLike = None,
    duration: float | None = None,
    *,
    initial: InitialInput = None,
    samples: int | None = None,
    t_eval: TimesLike | None = None,
    method: str = "auto",
    tolerance: float = 1e-9,
    control_period: float | None = None,
    memoryless: bool = False,
    breaks: TimesLike = (),
    max_step: float | None = None,
    sensitivities: Sequence[str] = (),
    progress: bool = False,
) -> Trajectory:
    """Simulate a motion from the initial state of a scene.

    Where a limit of the scene ends the motion, or no step resolves it, the trajectory
    has the part that is valid, and its `status` and `message` give the reason.

    Args:
        scene: name or path of a scene, its document as a dict, or a `Scene`.
        torque: three torques [N m]; a profile (`SineTorque`, `TorqueTable`,
            `PolynomialTorque`, a `scipy.interpolate.PPoly` whose values have the shape
            (3,)); or a function f(t) or f(t, state) of the time [s] and the `State`. By
            default the scene's own profile, or zero where it has none.
        duration: length of the motion [s]; by default that of the scene.
        initial: initial state in place of the scene's: (gamma [rad], gamma_dot
            [rad/s]), or a mapping or `Initial` with gamma, gamma_dot, orientation.
        samples: number of even intervals of time, at whose ends samples are returned;
            by default 200, or the control periods where there are some. The steps do
            not depend on them.
        t_eval: the times of the samples instead [s], ascending, in whole nanoseconds
            (others are rounded).
        method: "dopri5", "dop853", "rk4" (explicit Runge-Kutta of order 5, 8, 4),
            "rodas5p" (Rosenbrock, order 5, for stiff scenes) or "auto", which changes
            between them as the motion asks for.
        tolerance: error of the orientation at the end that is allowed [rad]. A motion
            whose `error_estimate` exceeds it is run again by smaller steps, up to three
            times; if it still does, `status` is 2. A function that may have a memory
            runs once.
        control_period: a function is called once a period [s], at its beginning, and
            its torques are held until the next, as those of a controller, which may
            have a memory. Without it a function is part of the differential equation,
            called in each stage of a step, and must have no memory.
        memoryless: the function depends on its arguments alone. With `control_period`
            it is then called a second time a period, with the state of the second
            solution, which shows how it answers the error. Otherwise the error
            estimate, without this answer, is ten times the largest at the end of a
            period.
        breaks: times at which a function jumps or has a kink [s], ascending. Jumps and
            kinks in time are found without it, but a pulse may be missed that lies
            between two of 32 even parts of a step, or changes less than 0.1 % of the
            largest torque in the step (10 % where it has no jump). Of a function of the
            state only pulses are found that a stage of a step meets, and no kinks.
        max_step: longest step [s]; by default the error alone decides. With it a pulse
            of a function of the time is met if it is longer than max_step / 32 and than
            0.3 ms.
        sensitivities: numbers by which `Trajectory.sensitivities` differentiates the
            motion: keys of the scene, as "star.inertia.zz", "star.inertia" (its six
            numbers), "initial.gamma" (three), "base.v" (nine) or "stroke.stiffness",
            and "torque" for all numbers of the torques. Not with a function of the
            state. By "star.alpha_deg[0]" the third angle takes what the first leaves.
        progress: draw a bar on a terminal.

    Raises:
        InputError: an argument is not allowed; names it and the allowed values.
        AssemblyError: the initial gamma has no unique admissible assembly.
        SingularConfiguration: the motion starts from a parallel singularity.

    """
    refuse_other_rounding("simulate")
    # Read what moves, what acts on it, and for how long.
    moving = with_initial(scene_of(scene), initial)
    profile = _read_torque(torque, moving)
    span_ns = _read_duration(duration, moving)
    # Read how it is integrated.
    _check_method(method, tolerance)
    period = _read_period(control_period, profile, span_ns)
    longest = _read_longest_step(max_step, span_ns)
    jumps = _read_breaks(breaks, span_ns)
    # Read what is asked for.
    times = _read_times(samples, t_eval, span_ns, period)
    parameters = _read_parameters(sensitivities, moving, profile)
    # Run it until its error estimate meets the tolerance.
    task = Task(
        scene=moving,
        torque=profile,
        span=(0.0, span_ns / NANOSECONDS),
        times=times,
        method=method,
        tolerance=tolerance,
        period=period,
        memoryless=memoryless,
        breaks=jumps,
        max_step=longest,
        parameters=parameters,
    )
    return _run_to_tolerance(task, progress=progress)


def _read_torque(torque: TorqueLike, scene: Scene) -> TorqueProfile:
    """Return the torques as a profile, by default those of the scene, or zero."""
    if torque is None:
        torque = scene.torque
    if torque is None:
        torque = (0.0, 0.0, 0.0)
    return profile_of(torque)


def _read_duration(duration: float | None, scene: Scene) -> int:
    """Return the length of the motion [ns], by default that of the scene."""
    length = scene.duration if duration is None else duration
    if length is None:
        _refuse("duration", None, "must be given: the scene has none")
    return _read_nanoseconds("duration", length)


def _check_method(method: str, tolerance: float) -> None:
    """Refuse an unknown method, and a tolerance that is not a positive number."""
    is_tolerance = 0.0 < tolerance < math.inf
    refuse_unless(
        "simulate",
        ("method", method, method in INTEGRATORS, _require_method(method)),
        ("tolerance", tolerance, is_tolerance, "must be a number > 0 [rad]"),
    )


def _read_longest_step(max_step: float | None, span_ns: int) -> float:
    """Return the longest step [s]."""
    longest = math.inf if max_step is None else float(max_step)
    least = span_ns / NANOSECONDS / _MOST_PERIODS
    requirement = f"must be > 0 s, at least {least:.3g} s for this duration"
    refuse_unless("simulate", ("max_step", max_step, longest >= least, requirement))
    return longest


def _read_breaks(breaks: TimesLike, span_ns: int) -> Array:
    """Return the times inside the motion [s] at which a function jumps."""
    if isinstance(breaks, tuple) and not breaks:  # the default: nothing to check
        return np.zeros(0)
    times = np.atleast_1d(read_numbers("simulate", "breaks", breaks, seconds=True))
    requirement = "must be ascending times [s]"
    refuse_unless("simulate", ("breaks", breaks, ascend(times), requirement))
    return np.asarray(times[(times > 0.0) & (times < span_ns / NANOSECONDS)])


def _read_parameters(
    sensitivities: Sequence[str], scene: Scene, profile: TorqueProfile
) -> tuple[str, ...]:
    """Return the names that the motion is differentiated by."""
    names = (sensitivities,) if isinstance(sensitivities, str) else sensitivities
    if names:
        Sensitivities(scene, names, profile)  # refuses names that it does not know
    return tuple(names)


def _run_to_tolerance(task: Task, *, progress: bool) -> Trajectory:
    """Run a motion by steps, again by smaller ones if the tolerance is not met.

    It is met where the error estimate does not exceed it. A function whose torques are
    held, and which may have a memory, runs once. All runs share one budget: one that is
    run again and spends it is left out.
    """
    budget = EvaluationBudget(_budget_of(task), whole_run=True)
    step_tolerance = task.tolerance
    kept: SteppedMotion | None = None
    last_excess = math.inf
    for _ in range(_RUN_ATTEMPTS):
        attempt = replace(task, tolerance=step_tolerance)
        motion = SteppedMotion(
            attempt, start_of(task.scene), budget, progress=progress
        ).run()
        if kept is not None and motion.status < 0:
            break
        kept = motion
        excess = motion.point.error / task.tolerance
        is_met = not excess > 1.0
        gains_little = excess > _LEAST_GAIN * last_excess
        if task.remembers or motion.status < 0 or is_met or gains_little:
            break
        last_excess = excess
        step_tolerance = max(step_tolerance / (_RUN_MARGIN * excess), _FINEST)
    assert kept is not None
    return _make_trajectory(task, kept, budget.spent)


def _budget_of(task: Task) -> int:
    """Return the evaluations a motion may take: fewer where each calls a function."""
    if task.period is None and task.torque.feedback:
        return _FUNCTION_BUDGET
    begin, end = task.span
    by_duration = min(_BUDGET_PER_SECOND * (end - begin), _LONGEST_BUDGET)
    return max(WHOLE_MOTION_BUDGET, round(by_duration))


def _make_trajectory(task: Task, motion: SteppedMotion, spent: int) -> Trajectory:
    """Return a run as a trajectory."""
    point = motion.point
    error = point.error
    is_answer_unseen = task.remembers and task.torque.feedback
    if is_answer_unseen:
        # The torques answered earlier errors, too, which may have been larger.
        error = _UNSEEN_ANSWER * max(error, motion.answered_error)
    message = motion.message
    if motion.status < 0:
        geometry = Geometry.of(task.scene)
        message += f" ({describe_conditioning(geometry, motion.state())})"
        if task.period is None and task.torque.feedback:
            message += _ADVICE
    status, message = check_error(error, task.tolerance, motion.status, message)
    if is_answer_unseen and error > task.tolerance:
        message += (
            f" ({_UNSEEN_ANSWER:g} times wider, as the function may have a memory)"
        )
    samples = motion.samples.table()
    methods = [motion.start.method.name]
    for change in point.changes:
        methods.append(f"{change.method} from {change.time:g} s ({change.reason})")
    law = task.torque
    if motion.held:
        period_begins, torques = zip(*motion.held, strict=True)
        law = TorqueTable(period_begins, torques)
    record = RunRecord(
        status=status,
        message=message,
        method=", then ".join(methods),
        error_estimate=error,
        evaluations=spent + motion.samples.evaluations,
        step=motion.time / max(point.steps, 1),
        law=law,
        parameters=task.parameters,
        ends=(tuple(motion.start.y), tuple(point.y)),
    )
    return Trajectory(
        task.scene,
        samples.t,
        samples.quaternion,
        samples.body_rate,
        samples.torque,
        run=record,
        joints=samples.joints,
    )


def _refuse(name: str, value: object, requirement: str) -> NoReturn:
    raise refusal("simulate", name, value, requirement) from None


def _require_method(method: object) -> str:
    """Say which methods there are, and what to use instead of one that has left."""
    advice = REMOVED_METHODS.get(str(method))
    return _METHOD_WORDS if advice is None else f"{advice}; {_METHOD_WORDS}"


def _read_nanoseconds(name: str, value: float) -> int:
    """Return a length of time [s] in nanoseconds."""
    # From one nanosecond to what a whole number of 64 bits holds of them.
    if not 1e-9 <= value <= 9e9:
        _refuse(name, value, "must be a number from 1e-9 to 9e9 [s]")
    return round(float(value) * NANOSECONDS)


def _read_period(
    period: float | None, profile: TorqueProfile, span_ns: int
) -> int | None:
    """Return the control period [ns], None where the torques are not held."""
    if period is None:
        return None
    if not isinstance(profile, FunctionTorque):
        requirement = "is for a function; give none for numbers and profiles"
        _refuse("control_period", period, requirement)
    length = _read_nanoseconds("control_period", period)
    if span_ns > _MOST_PERIODS * length:
        least = span_ns / NANOSECONDS / _MOST_PERIODS
        requirement = f"must be at least {least:.3g} s for this duration"
        _refuse("control_period", period, requirement)
    return length


def _read_times(
    samples: int | None, t_eval: TimesLike | None, span_ns: int, period: int | None
) -> Array:
    """Return the times of the samples [s], in whole nanoseconds."""
    if t_eval is None:
        return _divide_evenly(samples, span_ns, period)
    if samples is not None:
        _refuse("samples", samples, "must be None where t_eval gives their times")
    times = np.atleast_1d(read_numbers("simulate", "t_eval", t_eval, seconds=True))
    with np.errstate(over="ignore"):
        rounded_ns = np.rint(times * NANOSECONDS)
    is_inside = bool(np.all((rounded_ns >= 0.0) & (rounded_ns <= span_ns)))
    if not (rounded_ns.size and ascend(rounded_ns) and is_inside):
        end = span_ns / NANOSECONDS
        requirement = f"must be ascending times from 0 to {end:g} s, a nanosecond apart"
        _refuse("t_eval", t_eval, requirement)
    return np.asarray(np.abs(rounded_ns) / NANOSECONDS)  # -0.0 is 0.0


def _divide_evenly(samples: int | None, span_ns: int, period: int | None) -> Array:
    """Return the ends of even intervals [s]: control periods, or a number of them."""
    if samples is None and period is not None:
        even_ns = np.append(np.arange(0, span_ns, period, dtype=np.int64), span_ns)
    else:
        count = _DEFAULT_SAMPLES if samples is None else samples
        requirement = f"must be a whole number from 1 to {_MOST_SAMPLES}"
        if not 1 <= count <= _MOST_SAMPLES:
            _refuse("samples", samples, requirement)
        even_ns = np.rint(np.linspace(0, span_ns, count + 1))
        if count > span_ns:  # less than a nanosecond apart
            even_ns = np.unique(even_ns)
    return np.asarray(even_ns / NANOSECONDS)
