# SPDX-License-Identifier: Apache-2.0
"""Commands on motions: plan one, sweep many, identify a scene from a recorded one."""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Sequence
from typing import Any

from sst_ros.cli.commands import free_out, function
from sst_ros.control.plan import (
    DEMAND_UNITS,
    MotionPlan,
    TimeScaling,
    examine_motion,
    examine_reactions,
    plan_json,
    time_scaling,
    write_torques,
)
from sst_ros.control.reference_motions import reference_motion
from sst_ros.dynamics.reactions import SIZES
from sst_ros.errors import Check, refuse_unless
from sst_ros.files import require_free, write_into
from sst_ros.identification.excitation import ExcitingMotion, design
from sst_ros.identification.identify import identify
from sst_ros.identification.parameters import Identification
from sst_ros.report.results import Finding, Severity, render
from sst_ros.scene.scene import load
from sst_ros.scene.yaml_document import dump
from sst_ros.sweeps.cluster import connect
from sst_ros.sweeps.sweep import read_sweep, run_study, summarize
from sst_ros.sweeps.sweep_study import SweepStudy

PLOT = "plot"  # a word in place of a study
DESIGN = "design"  # a word in place of a bag
RECORDED_OPTIONS = ("cutoff", "delay", "scene", "method", "namespace")
DESIGN_OPTIONS = ("duration", "harmonics", "seed")


def check_plan(options: argparse.Namespace) -> int:
    """Print what a reference motion requires; write the torques that follow it."""
    is_period = 1e-9 <= options.period < math.inf
    requirement = "must be a finite number >= 1e-9 [s]"
    refuse_unless("plan check", ("--period", options.period, is_period, requirement))
    if options.csv is not None:
        require_free(options.csv, "plan check", force=options.force, option="--csv")
    scene = load(options.scene)
    motion = reference_motion(scene, _read_run_motion)
    plan = examine_motion(motion, scene)
    speeds = time_scaling(plan)
    if options.json:
        print(plan_json(plan, speeds))
    else:
        print(plan_text(plan, speeds), end="")
    if options.csv is not None:
        write_torques(plan, options.csv, options.period)
    return 1 if plan.problems else 0


def _read_run_motion(bag: str, namespace: str | None) -> Any:
    """Read the motion of a recorded run; the module needs rosbags."""
    return function("recording.recording:read_run_motion")(bag, namespace)


def plan_text(plan: MotionPlan, speeds: TimeScaling) -> str:
    """Write what a plan requires, what was found, and the speeds that are feasible."""
    return render(
        "plan.txt",
        plan=plan,
        units=DEMAND_UNITS,
        reactions=examine_reactions(plan),
        sizes=SIZES,
        findings=find_plan_findings(plan),
        verdict="not feasible" if plan.problems else "feasible",
        speed_statements=describe_speeds(plan, speeds),
    )


def find_plan_findings(plan: MotionPlan) -> list[Finding]:
    """Return why a plan is refused, then how its numbers are to be read."""
    findings = []
    for problem in plan.problems:
        findings.append(Finding(Severity.WARNING, f"refused: {problem}"))
    scene = plan.trajectory.scene
    if scene.moment and scene.moment.topic:
        text = "The external moment comes from a topic; it counts as zero here."
        findings.append(Finding(Severity.NOTE, text))
    if scene.lags:
        text = "The actuators lag; commands that make up for it may exceed the torques."
        findings.append(Finding(Severity.NOTE, text))
    return findings


def describe_speeds(plan: MotionPlan, speeds: TimeScaling) -> list[str]:
    """Say at which speeds a plan is feasible, and which limit ends them."""
    statements = []
    leaves_limits = any(
        distance.refused and distance.least < 0.0 for distance in plan.distances
    )
    if leaves_limits:
        statements.append("At no speed: the path itself leaves what is allowed.")
    elif speeds.highest is None:
        statements.append("At no speed: the torque limit is too small for this path.")
    elif not speeds.binding:
        statements.append("At any speed: the scene has no limit that it could meet.")
    else:
        duration = plan.motion.duration / speeds.highest
        statements.append(
            f"Highest speed {speeds.highest:.9g} times as planned, in {duration:.9g} s;"
            f" then the {speeds.binding} limit is met."
        )
    if speeds.highest is not None and speeds.lowest > 0.0:
        statements.append(
            f"Slower than {speeds.lowest:.9g} times as planned it is not feasible"
            " either: the torque limit is too small to rest everywhere on this path."
        )
    return statements


def run_sweep(options: argparse.Namespace) -> None:
    """Run a study of many runs, or draw the results of one."""
    if str(options.study) == PLOT:
        _plot_sweep(options)
        return
    if options.folder is not None:
        options.parser.error("DIR is an argument of `sweep plot`; give --out DIR")
    if options.scheduler and options.workers:
        options.parser.error(
            "--workers is for this machine; a scheduler has workers of its own"
        )
    folder = options.out or options.study.with_name(f"{options.study.stem}_sweep")
    if not options.resume:
        free_out(options, folder)
    study = SweepStudy.read(options.study)
    with contextlib.ExitStack() as end:
        client = connect(options.scheduler) if options.scheduler else None
        if client is not None:
            end.callback(client.close, timeout=5)
        results = run_study(
            study,
            folder,
            client=client,
            workers=options.workers or 0,
            resume=options.resume,
        )
    print(summarize(results), end="")
    print(f"Results in {folder}; `sst-ros sweep plot {folder}` draws them.")


def _plot_sweep(options: argparse.Namespace) -> None:
    """Draw the results of a study."""
    if options.folder is None or options.scheduler or options.workers or options.resume:
        options.parser.error("usage: sst-ros sweep plot DIR [--out DIR]")
    draw = function("sweeps.sweep_pictures:draw_pictures")  # needs Matplotlib
    for path in draw(read_sweep(options.folder), options.out or options.folder):
        print(path)


def run_identification(options: argparse.Namespace) -> None:
    """Identify a scene from a recorded run, or design a motion for that.

    The designed motion determines the parameters of the scene.
    """
    designing = options.bag == DESIGN
    if designing:
        chosen = _set_options(options, DESIGN_OPTIONS)
        foreign = _set_options(options, RECORDED_OPTIONS)
        requirement = f"is no option of identify {DESIGN}"
    else:
        chosen = _set_options(options, RECORDED_OPTIONS)
        foreign = _set_options(options, DESIGN_OPTIONS)
        requirement = "is no option of identify BAG"
    checks: list[Check] = []
    for name, value in foreign.items():
        checks.append((f"--{name}", value, False, requirement))
    is_placed = designing == (options.designed is not None)
    after_design = "must be given after design, and only there"
    checks.append(("SCENE", options.designed, is_placed, after_design))
    refuse_unless("identify", *checks)
    if options.out is not None:
        free_out(options, options.out)
    result: ExcitingMotion | Identification
    if designing:
        result = design(load(options.designed), options.parameters, **chosen)
    else:
        namespace = chosen.pop("namespace", None)
        run = function("recording.recording:read")(options.bag, namespace=namespace)
        result = identify(run, parameters=options.parameters, **chosen)
    print(result.table(), end="")
    if options.out is not None:
        with write_into(options.out.parent, "identify"):
            options.out.write_text(dump(result.scene), encoding="utf-8")
        print(f"wrote {options.out}")


def _set_options(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """Return those of some options that the command line sets, by their names."""
    values = {name: getattr(options, name) for name in names}
    return {name: value for name, value in values.items() if value is not None}
