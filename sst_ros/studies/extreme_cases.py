# SPDX-License-Identifier: Apache-2.0
"""Stiff and extreme cases: what is run, and the value or the refusal that theory asks for.

Most values come from scaling laws. Without friction and springs a motion under torques tau from
rates v takes place s times slower under tau / s^2 from v / s, and is the same for inertias and
torques times a. Gravity is absent in all of them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import RunStopped, SstError
from sst_ros.integration.codegen import numba_version
from sst_ros.scene.loads import Friction, Initial, JointFriction, Spring, Stroke
from sst_ros.scene.scene import Scene
from sst_ros.simulation import WHOLE_MOTION_BUDGET, Simulation
from sst_ros.studies import extreme_scenes as extremes
from sst_ros.studies.parallel import evaluate_grid

Triple = tuple[float, float, float]
Deviation = Callable[[Simulation], float]

REST = extremes.REST


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        name: short name.
        expected: the truth and its reason, in words.
        scene: makes the scene.
        torque: torques [N m], constant or by the number of the control period.
        steps: number of control periods.
        period_ns: their length [ns].
        deviation: distance from the truth; None where a refusal is expected.
        bound: largest deviation that passes.
        refusal: name of the error that must end the run; empty where none may.
        stop_time: when the refusal must come [s]; None where that is not known.
        difficulty: why it is hard, in words.
        group: heading on the page.

    """

    name: str
    expected: str
    scene: Callable[[], Scene]
    torque: Triple | Callable[[int], Triple]
    steps: int
    period_ns: int
    deviation: Deviation | None = None
    bound: float = 0.0
    refusal: str = ""
    stop_time: Callable[[], float] | None = None
    difficulty: str = ""
    group: str = ""


@dataclass(frozen=True)
class CaseRun:
    """A simulation at its end, or the refusal and the simulation at its last state."""

    simulation: Simulation | None
    error: SstError | None


@dataclass(frozen=True)
class CaseResult:
    """Result of a case.

    Attributes:
        name, group, difficulty, expected, bound: of the case.
        result: what happened, in words.
        deviation: distance from the truth; None for a refusal.
        energy: energy residual at the end relative to the energy; None where no run began.
        closure: largest abs(r_k . t_k) at the end; None where no run began.
        estimate: error estimate of the orientation at the end [rad]; None where no run began.
        wall_s: time of the interpreted run [s].
        same_bits: the compiled run ended in the same bits; None where it was not run.
        correct: the result is the truth.

    """

    name: str
    group: str
    difficulty: str
    expected: str
    bound: float
    result: str
    deviation: float | None
    energy: float | None
    closure: float | None
    estimate: float | None
    wall_s: float
    same_bits: bool | None
    correct: bool

    @property
    def passed(self) -> bool:
        """The result is correct, and compiled and interpreted runs do not differ."""
        return self.correct and self.same_bits is not False


def run(case: Case, *, compiled: bool = False) -> CaseRun:
    """Run a case; refusals are results."""
    simulation = None
    try:
        simulation = Simulation(case.scene(), compiled=compiled, step_budget=WHOLE_MOTION_BUDGET)
        for k in range(case.steps):
            torque = case.torque(k) if callable(case.torque) else case.torque
            simulation.step(torque, case.period_ns)
    except SstError as error:
        return CaseRun(simulation, error)
    return CaseRun(simulation, None)


def evaluate_case(case: Case, *, compiled: bool = True) -> CaseResult:
    """Run a case, compare it with the truth, and with its compiled run."""
    began = time.perf_counter()
    done = run(case)
    wall = time.perf_counter() - began
    simulation, error = done.simulation, done.error
    deviation, result, correct = None, "finished", False
    if error is not None:
        result = f"{type(error).__name__}: {str(error).splitlines()[0]}"
        correct = type(error).__name__ == case.refusal
        if correct and case.stop_time is not None and isinstance(error, RunStopped):
            exact = case.stop_time()
            late = abs(error.time - exact)
            result += f" ({late:.1e} s off)"
            correct = late <= 1e-6 * exact + 1e-15
    elif simulation is not None and case.deviation is not None:
        deviation = float(case.deviation(simulation))
        correct = deviation <= case.bound
    energy = closure = estimate = None
    if simulation is not None:
        now, start = simulation.state, initial_state(simulation.scene, simulation.geometry)
        ends = (_stored(simulation, y) for y in ((*now.quaternion, *now.body_rate), start))
        energy = abs(simulation.energy_residual) / max(*map(abs, ends), 1e-300)
        closure, estimate = simulation.closure_residual, simulation.error_estimate
    same_bits = None
    if compiled and simulation is not None and numba_version() is not None:
        again = run(case, compiled=True)
        same_bits = again.simulation is not None and (
            again.simulation.state == simulation.state and str(again.error) == str(error)
        )
        result += "" if same_bits else "; the compiled run differs"
    return CaseResult(
        case.name, case.group, case.difficulty, case.expected, case.bound, result, deviation,
        energy, closure, estimate, wall, same_bits, correct,
    )  # fmt: skip


def _stored(simulation: Simulation, y: Sequence[float]) -> float:
    """Kinetic and potential energy [J] of a quaternion and a body rate."""
    dynamics = simulation.dynamics
    rest = (0.0,) * (len(dynamics.state) - 7 + len(dynamics.drive))
    return float(sum(dynamics.energies(*y, *rest)[:2]))


def results(*, workers: int | None = None, shown: bool = False) -> list[CaseResult]:
    """Evaluate the whole catalogue on all cores."""
    count = len(list(cases()))
    return evaluate_grid(
        _numbered, range(count), workers=workers, label="extreme cases   ", shown=shown
    )


def _numbered(number: int) -> CaseResult:
    return evaluate_case(list(cases())[number])


def cases() -> Iterator[Case]:
    """Yield the catalogue."""
    yield from _scaled_times()
    yield from _scaled_inertias()
    yield from _violent()
    yield from _starts()
    yield from _stiff()


def _scaled_times() -> Iterator[Case]:
    for scale in (1e-3, 1e-2, 1e-1, 1e1, 1e2, 1e3):
        yield Case(
            f"time x {scale:g}",
            "the end of the same motion at its own speed, by the scaling law",
            lambda s=scale: extremes.spun(2.0 / s),  # type: ignore[misc]
            (extremes.PUSH[0] / scale**2, extremes.PUSH[1] / scale**2, extremes.PUSH[2] / scale**2),
            20,
            round(10_000_000 * scale),
            lambda simulation: extremes.apart(simulation, extremes.reference()),
            1e-9,
        )


def _scaled_inertias() -> Iterator[Case]:
    for scale in (1e-12, 1e-6, 1e6, 1e9):
        yield Case(
            f"inertia x {scale:g}",
            "the same motion, under torques scaled alike",
            lambda a=scale: extremes.heavier(a),  # type: ignore[misc]
            (extremes.PUSH[0] * scale, extremes.PUSH[1] * scale, extremes.PUSH[2] * scale),
            20,
            10_000_000,
            lambda simulation: extremes.apart(simulation, extremes.reference()),
            1e-12,
        )
    for scale in (1e-9, 1e9):
        yield Case(
            f"star's inertia x {scale:g} beside the same links",
            "energy is kept",
            lambda a=scale: extremes.odd_star(a),  # type: ignore[misc]
            REST,
            10,
            10_000_000,
            extremes.energy_drift,
            1e-9,
        )


def _violent() -> Iterator[Case]:
    push = (1e8, 0.0, 0.0)
    said = "the same end, sqrt(1e8) times sooner than under 1 N m"
    yield Case(
        "torque of 1e8 N m against an end of the stroke",
        said,
        extremes.base,
        push,
        10,
        100_000,
        refusal="StrokeExceeded",
        stop_time=lambda: extremes.stop_time(extremes.base(), (1.0, 0.0, 0.0)) * 1e-4,
    )
    yield Case(
        "torque of 1e8 N m into a serial singularity",
        said,
        extremes.free,
        push,
        10,
        100_000,
        refusal="SingularityReached",
        stop_time=lambda: (
            extremes.stop_time(replace(extremes.base(), **extremes.FREE), (1.0, 0.0, 0.0)) * 1e-4
        ),
    )
    for rate in (1e4, 1e6):
        yield Case(
            f"spin of {rate:g} rad/s",
            "without torque the way does not depend on the rate",
            lambda v=rate: extremes.spun(v),  # type: ignore[misc]
            REST,
            10,
            round(0.4e8 / rate),
            lambda simulation: extremes.apart(simulation, extremes.turned()),
            1e-7,
        )


def _starts() -> Iterator[Case]:
    right = math.pi / 2
    for gamma in (REST, (0.0, 0.5, 0.5), (right, right, right), (0.7, 0.7, 0.0)):
        yield Case(
            f"start at a corner of the strokes, {gamma[0]:.3g} {gamma[1]:.3g} {gamma[2]:.3g}",
            "rest stays rest",
            lambda g=gamma: replace(extremes.base(), initial=Initial(gamma=g)),  # type: ignore[misc]
            REST,
            10,
            1_000_000,
            lambda simulation, g=gamma: math.dist(simulation.state.joints.gamma, g),  # type: ignore[misc]
            1e-12,
        )
    yield Case(
        "pushed outwards at an end of the stroke",
        "the run ends where it starts",
        lambda: replace(extremes.base(), initial=Initial(gamma=(0.0, 0.5, 0.5))),
        (-1.0, 0.0, 0.0),
        1,
        1_000_000,
        refusal="StrokeExceeded",
        stop_time=lambda: 0.0,
    )
    yield Case(
        "start at a corner that cannot be assembled",
        "refused by name",
        lambda: replace(extremes.base(), initial=Initial(gamma=(0.0, right, 0.7))),
        REST,
        1,
        1_000_000,
        refusal="NoAdmissibleAssembly",
    )


def _stiff() -> Iterator[Case]:
    rests = (0.9, 0.7, 0.8)
    start = math.pi / 4

    def sprung(stiffness: float, damping: float) -> Scene:
        springs = [
            Spring(joint=f"gamma_{k + 1}", stiffness=stiffness, rest=rest)
            for k, rest in enumerate(rests)
        ]
        friction = JointFriction(gamma=Friction(viscous=damping))
        return replace(extremes.base(), friction=friction, springs=tuple(springs))

    def creeping(simulation: Simulation) -> float:
        decay = math.exp(-500.0 / 1e5)
        wanted = [rest + (start - rest) * decay for rest in rests]
        return math.dist(simulation.state.joints.gamma, wanted)

    yield Case(
        "viscous friction of 1e5 N m s/rad",
        "springs creep: angles decay by exp(-k t / c), inertia counts by M k / c^2 = 1e-8 of it",
        lambda: sprung(500.0, 1e5),
        REST,
        10,
        100_000_000,
        creeping,
        1e-8,
    )
    for damping in (1e3, 1e4):
        yield Case(
            f"PD gains of 1e6 N m/rad and {damping:g} N m s/rad",
            "at its set point after more than 25 time constants",
            lambda d=damping: sprung(1e6, d),  # type: ignore[misc]
            REST,
            3,
            100_000_000,
            lambda simulation: math.dist(simulation.state.joints.gamma, rests),
            1e-10,
        )
    yield Case(
        "elastic stops of 1e8 N m/rad",
        "as at 1e9 N m/rad, but for the contact of pi sqrt(m / k) = 2e-4 s; energy kept",
        lambda: extremes.bouncing(Stroke(at_end="elastic", stiffness=1e8)),
        REST,
        30,
        10_000_000,
        extremes.from_stiffer_bounce,
        1e-6,
    )
