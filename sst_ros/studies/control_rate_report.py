# SPDX-License-Identifier: Apache-2.0
"""The study of control rates on the terminal, in files, and as one page."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sst_ros.mechanism.geometry import Geometry
from sst_ros.plot.work_precision import draw_control_rates
from sst_ros.recording import recording
from sst_ros.report.states import recorded as recorded_states
from sst_ros.scene import scene as scenes
from sst_ros.studies.control_rate import (
    MIDDLE,
    NODES,
    START,
    ControlRun,
    ControlStudy,
    advice,
    control_study,
)
from sst_ros.studies.results import markdown, provenance, records, table, write
from sst_ros.studies.sampled_data import ORDERS

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

WRONG_ORDER = 0.2
"""Difference from the order of theory that is reported as a fault."""

SCENES = ("example2", "friction")
"""Scenes of the page."""

INTRODUCTION = """\
# Control rate and accuracy

Written by `python -m sst_ros report accuracy --control`, `--nodes` for the rows of the nodes; all
figures are from the machine and the date below.

A simulator in a control loop holds each torque over a control period. What the motion then differs
from that under the continuous torques is the error of the hold, not that of the integrator. Each
point is a real run of the run loop of the simulator node, without ROS and as fast as possible, with
a sample at every tick, by one method at the node's default tolerance; the torque of a tick is that
of the start of its hold, that of its middle, or the profile itself, for which nothing is held. It
is compared with the reference solution of the accuracy page. Theory: the error falls with the
period to the power 1 for the start, 2 for the middle (`sst_ros/studies/sampled_data.py`).

Processor time is that of the thread of the run per tick, its median, with the making of the sample,
without publishing it; a share of a core is that time the rate. The rows "nodes" are recorded runs
of simulator, player and recorder in lockstep; their time is the mean wall time of a step.
"""


def report(
    names: Sequence[str],
    out: Path,
    *,
    record: Callable[[str, Path, int, str], object] | None = None,
) -> list[ControlStudy]:
    """Study scenes; print each, and write control_rate.csv, .json, .md and figures into `out`.

    Args:
        names: scenes with torques.
        out: folder of the files.
        record: records a run of the nodes: scene, bag, rate [Hz], hold; None for no nodes.

    Raises:
        SstError: a scene is refused or a run failed, or `out` cannot be written.

    """
    studies = []
    for name in names:
        nodes = None
        if record is not None:

            def nodes(rate: int, hold: str, name: str = name) -> ControlRun:
                bag = out / "bags" / f"{name}_{rate}_{hold}"
                record(name, bag, rate, hold)
                return recorded_run(bag, rate, hold)

        studies.append(control_study(scenes.load(name), recorded=nodes, shown=True))
        print("\n".join(lines(studies[-1])), flush=True)
        whole = table(row for study in studies for row in records(study.rows))
        write(
            out, "control_rate", csv=whole,
            document={"rows": records(whole), "advice": {s.scene: advice(s) for s in studies}},
            page=page(studies), figures={f"control_rate_{s.scene}": figure(s) for s in studies},
        )  # fmt: skip
    return studies


def recorded_run(bag: Path, rate: int, hold: str) -> ControlRun:
    """Read a run of the nodes."""
    run = recording.read(bag)
    reported = run.diagnostics
    return ControlRun(
        rate, reported.get("integrator", "auto"), hold, run.time_ns,
        recorded_states(Geometry.of(run.scene), run, slice(None))[:, :7],
        float(reported.get("error_estimate", "nan")), 1e-6 * float(reported["step_mean_us"]),
    )  # fmt: skip


def title(study: ControlStudy) -> str:
    """Return scene, time span and advice in two or three lines."""
    found, _, why = advice(study).partition(": ")
    return f"{study.scene} over {study.seconds:g} s: {found}\n{textwrap.fill(why, 125)}"


def grid(study: ControlStudy) -> DataFrame:
    """Return errors and times as texts by rate and hold: of the methods, and of the nodes."""
    rows = []
    for (rate, hold, by), group in study.rows.groupby(["rate_Hz", "hold", "by"], sort=False):
        low, high = group.largest_rad.min(), group.largest_rad.max()
        error = f"{high:.3e}" if high < 1.001 * low else f"{low:.0e} to {high:.0e}"
        fast, slow = group.tick_us.min(), group.tick_us.max()
        rows.append({
            "rate [Hz]": f"{rate:g}",
            "torque": hold,
            "by": by if by == NODES else f"{by}, {len(group)} methods",
            "largest error [rad]": error,
            "at the end [rad]": f"{group.final_rad.max():.1e}",
            "per tick [us]": f"{fast:.0f} to {slow:.0f}" if slow > 1.1 * fast else f"{slow:.0f}",
            "share of a core [%]": f"{100 * group.core_share.min():.2g} to "
                                   f"{100 * group.core_share.max():.2g}",
        })  # fmt: skip
    return table(rows)


def lines(study: ControlStudy) -> Iterator[str]:
    """Yield the study for the terminal line by line."""
    yield grid(study).to_string(index=False)
    yield ""
    yield from findings(study)
    yield ""


def findings(study: ControlStudy) -> Iterator[str]:
    """Yield orders and advice, a sentence each."""
    for hold, power in ORDERS.items():
        found = study.order(hold)
        doubt = "" if abs(found - power) < WRONG_ORDER else "WARNING, not as in theory: "
        yield f"{doubt}torque at the {hold} of the hold: order {found:.3f}, theory {power}."
    yield f"Advice: {advice(study)}."
    own = study.reference.own.orientation
    yield f"Reference: {study.reference.how}; its own error: {own:.0e} rad."


def figure(study: ControlStudy) -> Figure:
    """Draw the study."""
    orders = {hold: study.order(hold) for hold in (START, MIDDLE)}
    return draw_control_rates(study.rows, orders, title(study), provenance())


def page(studies: Sequence[ControlStudy]) -> str:
    """Write studies as one Markdown page."""
    parts = [INTRODUCTION]
    for study in studies:
        parts += [f"## {study.scene}", "",
                  f"![error against control period](control_rate_{study.scene}.png)", "",
                  *(f"- {line}" for line in findings(study)), "", markdown(grid(study)),
                  ""]  # fmt: skip
    return "\n".join([*parts, provenance(), ""])
