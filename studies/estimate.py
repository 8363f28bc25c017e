# SPDX-License-Identifier: Apache-2.0
"""Calibration of the error estimate of `simulate`: its ratio to the true error.

Random scenes of each class, from a seed and from one that was not used while building,
each by a random method and tolerance, are compared with two solutions whose tolerance
is a thousandth. Where these two do not agree to a tenth of the error, or it is within
rounding, a run is only counted.
"""

from __future__ import annotations

import argparse
import copy
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from sst_ros import Simulation, SineTorque, Trajectory, certify, load_scene, simulate
from sst_ros.errors import AssemblyError, SstError
from sst_ros.figures import BLUE, VERMILION, styled
from sst_ros.mechanism.geometry import angle_between
from sst_ros.report.results import data_frame, publish, render
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import INTEGRATORS
from studies import DOCS, PAGES, run, run_jobs
from studies.sixty_digits import Motion, angle

if TYPE_CHECKING:
    from pandas import DataFrame

TIGHTER = 1e-3
FINEST, ROUNDING = 1e-13, 2e-14
"""Least tolerance of a reference, and error below which rounding decides [rad]."""
QUANTILES = (0.0, 0.01, 0.05, 0.5, 0.95, 0.99, 1.0)


class Case(NamedTuple):
    """A motion to be simulated."""

    scene: Scene
    torque: Any
    period: float | None
    duration: float
    memoryless: bool = False  # said of a function whose torques are held


def _torques(
    rng: np.random.Generator, size: float, fastest: float = 20.0
) -> SineTorque:
    rates = rng.uniform(0.1 * fastest, fastest, 3)
    rows = (rng.uniform(-size, size, 3), rates, rng.uniform(0.0, 6.28, 3))
    amplitude, frequency, phase = (tuple(row.tolist()) for row in rows)
    return SineTorque(amplitude=amplitude, frequency=frequency, phase=phase)


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(10.0 ** rng.uniform(math.log10(low), math.log10(high)))


def _scene(rng: np.random.Generator, **values: Any) -> Scene:
    """Return a random scene without limits, and with the values given."""
    name = rng.choice(["example2_heavy", "general", "gravity_payload"])
    gamma = tuple(rng.uniform(0.65, 0.95, 3).tolist())
    rates = tuple(rng.uniform(-1.0, 1.0, 3).tolist())
    free = {"stroke.at_end": "ignore", "workspace.at_edge": "ignore"}
    start = {
        "initial.gamma": gamma,
        "initial.gamma_dot": rates,
        "initial.orientation": None,
    }
    return load_scene(str(name)).with_values({**free, **start, **values})


def smooth(rng: np.random.Generator) -> Case:
    """Draw sines on a scene without kinks."""
    return Case(_scene(rng), _torques(rng, 2.0), None, 0.4)


def sharp_friction(rng: np.random.Generator) -> Case:
    """Draw Coulomb friction that changes sign within 1e-3 of the usual rates."""
    joint = {"coulomb": _log(rng, 0.01, 0.3), "smoothing": _log(rng, 1e-3, 1e-1)}
    return Case(_scene(rng, friction={"gamma": joint}), _torques(rng, 2.0), None, 0.3)


def elastic_stops(rng: np.random.Generator) -> Case:
    """Draw contact at stops that give way."""
    stroke = {"at_end": "elastic", "stiffness": _log(rng, 1e2, 1e5)}
    stroke["restitution"], stroke["impact_rate"] = float(rng.uniform(0.3, 0.95)), 1.0
    gamma = [*rng.uniform(0.7, 0.85, 2).tolist(), float(rng.uniform(0.15, 0.25))]
    start = {"initial.gamma": tuple(gamma), "initial.gamma_dot": (0.0, 0.0, -2.0)}
    return Case(_scene(rng, stroke=stroke, **start), (0.0, 0.0, -0.5), None, 0.3)


def torque_clamp(rng: np.random.Generator) -> Case:
    """Draw a sine that the limit of the actuators cuts."""
    limit = {"actuators": {"torque_limit": float(rng.uniform(0.2, 1.5))}}
    return Case(_scene(rng, **limit), _torques(rng, 2.0), None, 0.4)


def jump(rng: np.random.Generator) -> Case:
    """Draw a function of time that jumps, which nobody says beforehand."""
    at, before, after = (
        rng.uniform(0.1, 0.3),
        rng.uniform(-1, 1, 3),
        rng.uniform(-1, 1, 3),
    )
    first, second = tuple(before.tolist()), tuple(after.tolist())
    return Case(_scene(rng), lambda t: first if t < at else second, None, 0.4)


def kinks(rng: np.random.Generator) -> Case:
    """Draw a function of time that cuts sines, of which nobody says where."""
    sines, limit = _torques(rng, 2.0), float(rng.uniform(0.2, 1.5))
    return Case(_scene(rng), lambda t: _cut(sines.at(t), limit), None, 0.4)


def _cut(torques: Sequence[float], limit: float) -> list[float]:
    return [min(max(torque, -limit), limit) for torque in torques]


def held(rng: np.random.Generator) -> Case:
    """Draw a controller that holds torques so long that steps within have errors."""
    gain, period = float(rng.uniform(1.0, 10.0)), round(_log(rng, 0.03, 0.3), 3)
    return Case(_scene(rng), partial(_feedback, gain), period, 0.9, memoryless=True)


def held_with_memory(rng: np.random.Generator) -> Case:
    """Draw a controller with an integral, whose torques are held."""
    gain, period = float(rng.uniform(1.0, 10.0)), round(_log(rng, 0.03, 0.3), 3)
    return Case(_scene(rng), _Integral(gain, period), period, 0.9)


class _Integral:
    """The feedback of the other classes, and half of the integral of the angles."""

    def __init__(self, gain: float, period: float) -> None:
        self.gain, self.period, self.sum = gain, period, np.zeros(3)

    def __call__(self, t: float, state: Any) -> list[float]:
        self.sum = self.sum + self.period * (np.array(state.joints.gamma) - 0.8)
        rows = zip(_feedback(self.gain, t, state), self.sum.tolist(), strict=True)
        return [torque - 0.5 * self.gain * part for torque, part in rows]


def feedback(rng: np.random.Generator) -> Case:
    """Draw a function of the state inside of the differential equation."""
    return Case(_scene(rng), partial(_feedback, _log(rng, 1.0, 100.0)), None, 0.3)


def _feedback(gain: float, t: float, state: Any) -> list[float]:
    rows = zip(state.joints.gamma, state.joints.gamma_dot, strict=True)
    return [-gain * (angle - 0.8) - 0.2 * gain * rate for angle, rate in rows]


def saturated_feedback(rng: np.random.Generator) -> Case:
    """Draw a function of the state that cuts its torques."""
    gain, limit = _log(rng, 1.0, 100.0), _log(rng, 0.1, 2.0)

    def torque(t: float, state: Any) -> list[float]:
        return _cut(_feedback(gain, t, state), limit)

    return Case(_scene(rng), torque, None, 0.3)


def lag(rng: np.random.Generator) -> Case:
    """Draw actuators with a time constant, and fast sines.

    The sines are so fast that stable steps have errors.
    """
    constant, rate = _log(rng, 2e-4, 1e-1), _log(rng, 0.1, 1.0)
    scene = _scene(rng, actuators={"time_constant": constant})
    return Case(scene, _torques(rng, 5.0, max(rate / constant, 50.0)), None, 0.08)


def rotor(rng: np.random.Generator) -> Case:
    """Draw rotors behind gears, and a stiff spring.

    The spring holds no more than 1 J at the start. With more the motion ends at a
    serial singularity, where there is no end to compare.
    """
    joint, leg = str(rng.choice(["gamma", "mu", "beta"])), int(rng.integers(3))
    stiffness, energy = _log(rng, 10.0, 1e4), _log(rng, 0.01, 1.0)
    gears = {"rotor_inertia": _log(rng, 1e-5, 1e-3), "gear_ratio": 10.0}
    scene = _scene(rng, actuators=gears)
    angle = getattr(Simulation(scene).state.joints, joint)[leg]
    rest = float(angle + rng.choice([-1.0, 1.0]) * math.sqrt(2.0 * energy / stiffness))
    spring = {"joint": f"{joint}_{leg + 1}", "stiffness": stiffness, "rest": rest}
    return Case(scene.with_values({"springs": [spring]}), _torques(rng, 1.0), None, 0.2)


CLASSES: dict[str, Callable[[np.random.Generator], Case]] = {
    function.__name__: function
    for function in (
        smooth,
        sharp_friction,
        elastic_stops,
        torque_clamp,
        jump,
        kinks,
        held,
        held_with_memory,
        feedback,
        saturated_feedback,
        lag,
        rotor,
    )
}


def measure(job: tuple[str, int, int]) -> dict[str, Any]:
    """Run one case.

    The row has its estimate and, where it can be resolved, its true error.
    """
    name, seed, number = job
    rng = np.random.default_rng([seed, number, *name.encode()])
    method, tolerance = str(rng.choice(INTEGRATORS)), _log(rng, 1e-11, 1e-4)
    row = {
        "class": name,
        "seed": seed,
        "number": number,
        "method": method,
        "tolerance": tolerance,
    }
    try:
        case = CLASSES[name](rng)

        def solve(method: str, tolerance: float) -> Trajectory:
            return simulate(
                case.scene,
                copy.deepcopy(case.torque),
                case.duration,
                t_eval=[case.duration],
                control_period=case.period,
                memoryless=case.memoryless,
                method=method,
                tolerance=tolerance,
            )

        found = solve(method, tolerance)
        tighter = max(TIGHTER * tolerance, FINEST)
        one, other = (solve(m, tighter) for m in ("dop853", "dopri5"))
    except AssemblyError:
        return row | {"state": "no assembly"}
    except SstError as refused:
        return row | {"state": f"error: {refused}"}
    row |= {"status": found.status, "estimate": found.error_estimate}
    if {found.status, one.status, other.status} - {0, 2}:
        return row | {"state": "stopped"}
    error, apart = (
        float(angle_between(a.quaternion[-1], b.quaternion[-1]))
        for a, b in ((found, one), (one, other))
    )
    row |= {"error": error, "agreement": apart, "evaluations": found.evaluations}
    resolved = apart <= 0.1 * error and error > ROUNDING
    return row | {"state": "resolved" if resolved else "not resolved"}


def compare_bounds(job: tuple[int, int]) -> dict[str, Any]:
    """Run a smooth case: its true error, estimate and proven bound [rad].

    The truth has 60 digits.
    """
    seed, number = job
    rng = np.random.default_rng([seed, number, *b"proof"])
    method, tolerance, case = (
        str(rng.choice(INTEGRATORS)),
        _log(rng, 1e-11, 1e-4),
        smooth(rng),
    )
    given: dict[str, Any] = {"method": method, "tolerance": tolerance}
    at_end = [case.duration]
    proven = certify(case.scene, case.torque, case.duration, t_eval=at_end, **given)
    found = {"seed": seed, "number": number, **given}
    if proven.reason:
        return found | {"reason": proven.reason}
    state, reached = (
        Motion(case.scene, case.torque).at(case.duration),
        proven.trajectory,
    )
    found["error"] = float(angle(state[:4], reached.quaternion[-1]))
    return found | {
        "estimate": reached.error_estimate,
        "bound": proven.error,
        "reason": "",
    }


def summarise_bounds(rows: DataFrame) -> DataFrame:
    """Return the table of estimates and proven bounds over true errors."""
    found = []
    for words, column in (("estimate", "estimate"), ("proven bound", "bound")):
        ratios = (rows[column] / rows.error).dropna()
        quantiles = map("{:.3g}".format, ratios.quantile((0.0, 0.05, 0.5, 0.95, 1.0)))
        heads = ("least", "5 %", "50 %", "95 %", "largest")
        found.append({
            "over the true error": words, "runs": len(rows), "proven": len(ratios),
            **dict(zip(heads, quantiles, strict=True)), "below 1": (ratios < 1.0).sum(),
        })  # fmt: skip
    return data_frame(found)


def summarise(rows: DataFrame) -> DataFrame:
    """Return the table of the page: quantiles of estimate over true error, by class."""
    found = []
    heads = ("least", *(f"{100 * q:g} %" for q in QUANTILES[1:-1]), "largest")
    for name in (*CLASSES, "all"):
        runs = rows if name == "all" else rows[rows["class"] == name]
        resolved = runs[runs.state == "resolved"]
        compared = runs.state.isin(["resolved", "not resolved"])
        ratios = resolved.estimate / resolved.error
        beyond = (resolved.status == 0) & (resolved.error > 3 * resolved.tolerance)
        quantiles = map("{:.2g}".format, ratios.quantile(QUANTILES))
        found.append(
            {
                "class": name.replace("_", " "),
                "runs": len(runs),
                "stopped": (~compared).sum(),
                "resolved": len(resolved),
                **dict(zip(heads, quantiles, strict=True)),
                "below 1": (ratios < 1).sum(),
                "below 1/3": (ratios < 1 / 3).sum(),
                "below 1/10": (ratios < 1 / 10).sum(),
                "beyond 3 tolerances": beyond.sum(),
            }
        )
    return data_frame(found)


@styled
def draw(rows: DataFrame, seeds: Sequence[int]) -> Figure:
    """Draw the share of runs over estimate / error: a panel a class, a curve a seed."""
    figure = Figure(figsize=(9.0, 8.0))
    panels = figure.subplots(3, 4, sharex=True, sharey=True)
    for axes, name in zip(panels.flat, CLASSES, strict=True):
        axes.axvspan(1.0, 30.0, color="0.93")
        for seed, colour, line in zip(
            seeds, (BLUE, VERMILION), ("-", "--"), strict=True
        ):
            chosen = (
                (rows["class"] == name)
                & (rows.seed == seed)
                & (rows.state == "resolved")
            )
            ratios = np.sort(rows[chosen].estimate / rows[chosen].error)
            share = np.linspace(0.0, 1.0, len(ratios))
            axes.plot(ratios, share, line, color=colour, label=f"seed {seed}")
        axes.set(xscale="log", xlim=(0.1, 1e4), title=name.replace("_", " "))
    for axes in panels[-1]:
        axes.set_xlabel("estimate / true error")
    for axes in panels[:, 0]:
        axes.set_ylabel("share of the runs")
    drawn = panels[0, 0].get_legend_handles_labels()
    figure.legend(*drawn, loc="outside upper center", ncols=2)
    return figure


def write_page(
    rows: DataFrame, bounds: DataFrame, seeds: Sequence[int], **given: Any
) -> str:
    """Return the page in Markdown."""
    tables = [summarise(rows[rows.seed == seed]) for seed in seeds]
    given |= {
        "tables": tables,
        "bounds": summarise_bounds(bounds),
        "methods": INTEGRATORS,
    }
    return render(PAGES / "estimate.md", **given)


def report(options: argparse.Namespace) -> bool:
    """Run the cases; write docs/estimate.md, its table and its picture."""
    seeds = (options.seed, options.fresh)
    jobs = [
        (name, seed, k)
        for k in range(options.count)
        for name in CLASSES
        for seed in seeds
    ]
    rows = data_frame(run_jobs(measure, jobs, "estimate        "))
    smooth_cases = [(options.fresh, k) for k in range(options.proofs)]
    bounds = data_frame(run_jobs(compare_bounds, smooth_cases, "proven bounds   "))
    page = write_page(rows, bounds, seeds, **vars(options))
    files = {".csv": rows, ".json": {}, ".md": page, ".png": draw(rows, seeds)}
    files["estimate_bounds.csv"] = bounds
    publish(options.out, "estimate", files)
    return True


def main(words: Sequence[str] | None = None) -> int:
    """Calibrate from the command line."""
    return run(
        report,
        "estimate",
        DOCS,
        words,
        count={"type": int, "default": 200, "help": "scenes of each class"},
        seed={"type": int, "default": 1, "help": "of the random numbers"},
        proofs={
            "type": int,
            "default": 40,
            "help": "smooth scenes whose error is proven",
        },
        fresh={
            "type": int,
            "default": 77,
            "help": "of those that were not used while building",
        },
    )


if __name__ == "__main__":
    raise SystemExit(main())
