# SPDX-License-Identifier: Apache-2.0
"""Page of stability: runs of extreme cases, what they must agree with, and regions.

A method multiplies the solution of y' = lambda y by its stability function R(h lambda)
a step; it is stable where abs(R) <= 1 (Hairer & Wanner, Solving ODEs II, sections IV.2
and IV.3).
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmark.plain_python import without_llvmlite
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import RunStopped, SstError
from sst_ros.figures import (
    BLUE,
    GREEN,
    INK,
    MARKERS,
    ORANGE,
    PURPLE,
    VERMILION,
    styled,
)
from sst_ros.integration.methods import METHODS, Method, Rosenbrock
from sst_ros.integration.stepper import WHOLE_MOTION_BUDGET
from sst_ros.programs.llvm import llvmlite_version
from sst_ros.report.accuracy import proven_error
from sst_ros.report.results import data_frame, publish, records, render
from sst_ros.report.scene_summary import eigenvalues, stability_function, step_advice
from sst_ros.scene import scene as scenes
from sst_ros.scene.torque_profile import TorqueTable
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import NANOSECONDS, Array
from studies import DOCS, PAGES, run, run_jobs
from studies.control_loop import run_in_loop
from studies.extreme_cases import LOOSE, Case, apart, catalogue

LOOSER = 1e-4
"""Tolerance at which the error estimate is checked where LOOSE resolves no error."""

FACTOR = 10.0
"""The error estimate must lie within this factor of the true error."""

ROUNDING = 1e-12
"""True errors below this [rad], or 100 times the estimate of the run at the default
tolerance, are not resolved: then the estimate must not be above FACTOR times that
either.
"""


LONGEST_PROOF = 1000
"""Steps of a proof after which it ends."""

FAR = -1e12
"""Where the stability function of an L-stable method has vanished."""


class CaseRun(NamedTuple):
    """A simulation at its end, or the refusal and the simulation at its last state."""

    simulation: Simulation | None
    error: SstError | None

    def same_as(self, other: CaseRun) -> bool:
        """Whether both ended in the same bits, or with the same error."""
        if self.simulation is None or other.simulation is None:
            return False
        ends = (self.simulation.state, str(self.error))
        return ends == (other.simulation.state, str(other.error))


class EstimateCheck(NamedTuple):
    """True error and estimate at a loose tolerance [rad], None without such a run.

    A verdict.
    """

    true: float | None
    estimate: float | None
    verdict: str
    holds: bool = True


@dataclass(frozen=True)
class CaseResult:
    """Result of a case; None for what was not run or has no value."""

    name: str
    group: str
    difficulty: str
    expected: str
    bound: float
    result: str  # what happened, in words
    deviation: float | None = None  # from the truth
    energy: float | None = None  # residual at the end relative to the energy
    closure: float | None = None  # largest abs(r_k . t_k) at the end
    estimate: float | None = None  # of the error of the orientation at the end [rad]
    loose_error: float | None = None  # true error at a loose tolerance [rad]
    loose_estimate: float | None = None  # its estimate [rad]
    check: str = ""  # what the estimate was found to be, or why it cannot be checked
    plain_s: float | None = None  # processor time of the run in plain Python [s]
    compiled_s: float | None = None  # and of the compiled one, compilation included
    same_bits: bool | None = None  # plain Python ended in the same bits, or error
    run_loop: bool | None = None  # so did that through the loop of the node
    # what the error of `simulate` is proven to be below, or why it is not
    proven: str = ""
    correct: bool = False  # the result is the truth, and the error estimate holds

    @property
    def passed(self) -> bool:
        """The result is correct, and no run differs from that in plain Python."""
        return (
            self.correct and self.same_bits is not False and self.run_loop is not False
        )


def run_case(
    case: Case, *, tolerance: float | None = None, looped: bool = False
) -> CaseRun:
    """Run a case, also through the tick loop of the node; refusals are results.

    A given tolerance allows steps of any length.
    """
    simulation = None
    try:
        simulation = Simulation(
            case.scene(), case.integrator, tolerance=tolerance or 1e-10,
            step_budget=WHOLE_MOTION_BUDGET,
        )  # fmt: skip
        if looped:
            run_in_loop(simulation, case.torque_at, case.period_ns, case.steps)
        elif not callable(case.torque) and tolerance is not None:
            simulation.step(case.torque, case.steps * case.period_ns)
        elif not callable(case.torque):
            simulation.steps(case.torque, case.period_ns, case.steps)
        else:
            for _ in range(case.steps):
                simulation.step(case.torque_at(simulation), case.period_ns)
    except SstError as error:
        return CaseRun(simulation, error)
    return CaseRun(simulation, None)


def evaluate_case(case: Case, *, plain: bool = True) -> CaseResult:
    """Run a case, and compare it with the truth, the tick loop and plain Python."""
    began = time.process_time()
    first = run_case(case)
    found: dict[str, Any] = {"compiled_s": time.process_time() - began}
    deviation, correct, result = _judge(case, first)
    check = estimate_check(case, first)
    remarks = [result]
    if first.simulation is not None:
        found |= _measure_end(first.simulation)
        if not case.long:
            found["run_loop"] = first.same_as(run_case(case, looped=True))
            remarks += [] if found["run_loop"] else ["the run loop differs"]
            if plain and llvmlite_version() is not None:
                began = time.process_time()
                with without_llvmlite():
                    found["same_bits"] = first.same_as(run_case(case))
                found["plain_s"] = time.process_time() - began
                remarks += [] if found["same_bits"] else ["plain Python differs"]
    remarks += [] if check.holds else [f"error estimate: {check.verdict}"]
    return CaseResult(
        case.name,
        case.group,
        case.difficulty,
        case.expected,
        case.bound,
        "; ".join(remarks),
        deviation=deviation,
        correct=correct and check.holds,
        loose_error=check.true,
        loose_estimate=check.estimate,
        check=check.verdict,
        **found,
    )


def _judge(case: Case, done: CaseRun) -> tuple[float | None, bool, str]:
    """Compare a run's end with the truth: deviation, whether correct, and words."""
    simulation, error = done
    if error is not None:
        result = f"{type(error).__name__}: {str(error).splitlines()[0]}"
        correct = type(error).__name__ == case.refusal
        if correct and case.stop_time is not None and isinstance(error, RunStopped):
            exact = case.stop_time()
            late = abs(error.time - exact)
            result += f" ({late:.1e} s off)"
            correct = late <= 1e-6 * exact + 1e-15
        return None, correct, result
    if simulation is None or case.deviation is None:
        return None, False, "finished"
    deviation = float(case.deviation(case, simulation))
    return deviation, deviation <= case.bound, "finished"


def _measure_end(simulation: Simulation) -> dict[str, float]:
    began = *initial_state(simulation.scene, simulation.geometry), 0.0, 0.0, 0.0
    energies = map(simulation.dynamics.total_energy, (simulation.sample[0], began))
    return {
        "energy": abs(simulation.energy_residual) / max(*map(abs, energies), 1e-300),
        "closure": simulation.closure_residual,
        "estimate": simulation.error_estimate,
    }


def estimate_check(case: Case, accurate: CaseRun) -> EstimateCheck:
    """Compare the error estimate with the true error, at the default tolerance."""
    if accurate.error is not None or accurate.simulation is None:
        held = "its time is held to theory" if case.stop_time else "there is no motion"
        return EstimateCheck(None, None, f"none: the run is refused, {held}")
    if case.loose is None:
        return EstimateCheck(None, None, f"none: {case.estimate}")
    unresolved = None
    for tolerance in dict.fromkeys((case.loose, max(case.loose, LOOSER))):
        loose = run_case(case, tolerance=tolerance).simulation
        if loose is None or loose.time_ns != accurate.simulation.time_ns:
            break
        true, estimate = apart(loose, accurate.simulation), loose.error_estimate
        resolved = max(ROUNDING, 100.0 * accurate.simulation.error_estimate)
        if true >= resolved:
            holds = true / FACTOR <= estimate <= FACTOR * true
            words = (
                f"{estimate / true:.2g} of the true error at a tolerance of"
                f" {tolerance:g}"
            )
            words += f"; {case.estimate}" if case.estimate else ""
            return EstimateCheck(true, estimate, words, holds)
        if true == 0.0 == estimate:
            return EstimateCheck(0.0, 0.0, "both are zero: it rests")
        words = (
            f"true error below {resolved:.0e} rad, which is not resolved; so is the"
            " estimate"
        )
        holds = estimate <= FACTOR * resolved
        unresolved = unresolved or EstimateCheck(true, estimate, words, holds)
    return unresolved or EstimateCheck(
        None, None, "there is no run at a loose tolerance", False
    )


def report(out: Path, *, long: bool = False) -> bool:
    """Run all cases, with `long` those of minutes, too; write the page.

    Whether all passed.
    """
    jobs = [number for number, case in enumerate(catalogue()) if long or not case.long]
    cases = run_jobs(_evaluate, jobs[::-1], "extreme cases   ")[::-1]
    print(page(cases))
    table = data_frame(asdict(case) | {"passed": case.passed} for case in cases)
    drawn = {"stability_regions.png": draw_regions(scene_points())}
    document = {"cases": records(table)}
    publish(
        out,
        "stability",
        {".csv": table, ".json": document, ".md": page(cases), **drawn},
    )
    return all(case.passed for case in cases)


def _evaluate(number: int) -> CaseResult:
    case = catalogue()[number]
    return replace(evaluate_case(case), proven=prove_case(case))


def prove_case(case: Case) -> str:
    """Say what the error of `simulate` is proven to be below, or why it is not.

    The bound holds at twenty instants.
    """
    if case.refusal and case.stop_time is None:
        return "-: there is no motion"
    if case.feedback or case.long:
        return f"-: {case.estimate or 'its torques answer the motion'}"
    torque: Any = case.torque
    if callable(torque):
        begins = [k * case.period_ns / NANOSECONDS for k in range(case.steps)]
        torque = TorqueTable(begins, [torque(k, None) for k in range(case.steps)])
    duration_ns = case.steps * case.period_ns
    times = [round(k * duration_ns / 20) / NANOSECONDS for k in range(1, 21)]
    return proven_error(
        case.scene(),
        torque,
        times[-1],
        t_eval=times,
        tolerance=1e-10,
        max_steps=LONGEST_PROOF,
    )


def page(cases: Sequence[CaseResult]) -> str:
    """Write the report as one Markdown page."""
    groups = {
        group: data_frame(_row(case) for case in cases if case.group == group)
        for group in dict.fromkeys(case.group for case in cases)
    }
    numbers = {"factor": f"{FACTOR:g}", "loose": f"{LOOSE:g}", "looser": f"{LOOSER:g}"}
    numbers["longest"] = f"{LONGEST_PROOF}"
    given = {"cases": cases, "groups": groups, "limits": limits_of_theory()}
    return render(PAGES / "stability.md", **given, **numbers)


def _row(case: CaseResult) -> dict[str, str]:
    def number(value: float | None, form: str = ".0e") -> str:
        return "-" if value is None else format(value, form)

    bits = {True: "same", False: "**differ**", None: "-"}
    return {
        "case": case.name,
        "why it is hard": case.difficulty,
        "truth": case.expected,
        "proven": case.proven,
        "result": ("" if case.passed else "**FAILED** ") + case.result,
        "deviation (bound)": (
            "-"
            if case.deviation is None
            else f"{case.deviation:.0e} ({case.bound:.0e})"
        ),
        "energy": number(case.energy),
        "true error": number(case.loose_error),
        "estimate": (
            "" if case.loose_estimate is None else f"{case.loose_estimate:.0e}: "
        )
        + case.check,
        "plain Python [s]": number(case.plain_s, ".2f") if case.plain_s else "-",
        "compiled [s]": number(case.compiled_s, ".2f"),
        "bits of plain Python": bits[case.same_bits],
        "run loop": bits[case.run_loop],
    }


def limits_of_theory() -> Iterator[str]:
    """Yield where each method is stable on the axes, from its stability function."""
    for name, method in METHODS.items():
        if isinstance(method, Rosenbrock):
            on_axis = _growth(method, 1j * np.geomspace(1e-3, 1e9, 100_000)).max()
            far = _growth(method, np.array([FAR]))[0]
            yield (
                f"{name}: A-stable and L-stable; abs(R) is at most {on_axis:.15g} on"
                f" the imaginary axis, all poles lie at z = {1.0 / method.gamma:.4g},"
                f" and abs(R({FAR:g})) = {far:.0e}"
            )
            continue
        line = np.linspace(0.0, 10.0, 100_001)
        real, imaginary = (
            1e-4 * (np.flatnonzero(_growth(method, axis * line) > 1.0 + 1e-9)[0] - 1)
            for axis in (-1.0, 1j)
        )
        yield (
            f"{name}: stable for h lambda from -{real:.3f} to 0, and up to"
            f" {imaginary:.3f} i on the imaginary axis"
        )


def _growth(method: Method, z: NDArray[Any]) -> Array:
    """Return abs(R(z))."""
    return np.abs(stability_function(method, z.astype(np.complex128)))


def scene_points() -> dict[str, NDArray[np.complex128]]:
    """Eigenvalues of the shipped scenes times the steps `step_advice` recommends."""
    found = {}
    for name in scenes.names():
        step = step_advice(scenes.load(name)).step
        if math.isfinite(step):
            found[name] = step * eigenvalues(scenes.load(name))
    return found


@styled
def draw_regions(points: Mapping[str, NDArray[np.complex128]]) -> Figure:
    """Draw regions of absolute stability and, by scene, eigenvalues times its step."""
    x, y = np.linspace(-8.0, 2.0, 401), np.linspace(-6.0, 6.0, 401)
    z = x[None, :] + 1j * y[:, None]
    figure = Figure(figsize=(13.0, 8.0))
    halves: Any = figure.subfigures(1, 2, width_ratios=(2.0, 1.0))
    left, right = halves
    panels = left.subplots(2, 2, sharex=True, sharey=True)
    near, key = right.subplots(2, 1)
    for axes, (name, method) in zip(panels.flat, METHODS.items(), strict=True):
        colour, modulus = MARKERS[name][0], _growth(method, z)
        axes.contourf(x, y, modulus, levels=[0.0, 1.0], colors=[colour], alpha=0.25)
        axes.contour(x, y, modulus, levels=[1.0], colors=[colour], linewidths=1.8)
        axes.set_title(f"{name}: stable where coloured")
    colours = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, INK)
    for k, (name, rates) in enumerate(points.items()):
        shown = rates[(np.abs(rates.real + 3.0) <= 5.0) & (np.abs(rates.imag) <= 6.0)]
        label = name if len(shown) == len(rates) else f"{name} (some beyond the axes)"
        for axes in (*panels.flat, near):
            axes.plot(
                shown.real,
                shown.imag,
                linestyle="",
                marker="osD^v<>phX*P"[k % 12],
                color=colours[(k + k // 12) % 6],
                markersize=6,
                markerfacecolor="none",
                label=label,
            )
    for axes in (*panels.flat, near):
        axes.axhline(0.0, color=INK, linewidth=0.6)
        axes.axvline(0.0, color=INK, linewidth=0.6)
        axes.set(xlabel="Re hλ", ylabel="Im hλ")
    for axes in panels.flat:
        axes.label_outer()
    near.set(xlim=(-0.6, 0.6), ylim=(-0.6, 0.6), title="Near the origin")
    key.axis("off")
    key.legend(
        *near.get_legend_handles_labels(),
        loc="upper left",
        ncols=2,
        frameon=False,
        fontsize=8,
        title="hλ of the scenes at their start, step h as advised",
    )
    return figure


def main(words: Sequence[str] | None = None) -> int:
    """Run the catalogue from the command line."""
    long = {"action": "store_true", "help": "the cases that take minutes, too"}
    return run(
        lambda given: report(given.out, long=given.long),
        "extreme",
        DOCS,
        words,
        long=long,
    )


if __name__ == "__main__":
    raise SystemExit(main())
