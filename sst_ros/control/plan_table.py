# SPDX-License-Identifier: Apache-2.0
"""A checked motion as a table, as JSON, and as torques to play."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.control.plan import ActuatorDemand, LimitDistance, MotionPlan, limits
from sst_ros.control.time_scaling import TimeScaling

UNITS = {"torque": "N m", "power": "W", "velocity": "rad/s", "acceleration": "rad/s^2"}


def table(plan: MotionPlan, fastest: TimeScaling) -> str:
    """Write a plan for people."""
    lines = [
        f"{plan.scene.name}: {plan.motion.duration:g} s, {len(plan.times)} samples and the "
        "extremes between them",
        "",
        _row("", ["actuator 1", "actuator 2", "actuator 3"], "limit"),
        *_demands(plan),
        "",
        _row("distance to an end", ["least", "at t [s]"]),
        *map(_distance, plan.distances),
        "",
        *_verdict(plan, fastest),
    ]
    return "\n".join(lines) + "\n"


def _demands(plan: MotionPlan) -> Iterator[str]:
    known = {name: limit for name, limit, _ in limits(plan.scene.actuators)}
    for name, unit in UNITS.items():
        peaks, limit = [getattr(demand, name) for demand in plan.demands], known.get(name)
        end = "" if limit is None else f"{limit:g}"
        yield _row(f"peak {name} [{unit}]", [f"{peak.value:.6g}" for peak in peaks], end)
        yield _row("  at t [s]", [f"{peak.time:.6g}" for peak in peaks])
        if limit is not None:
            yield _row("  margin", [f"{1.0 - abs(peak.value) / limit:.1%}" for peak in peaks])
        if name == "torque":
            yield _row("RMS torque [N m]", [f"{demand.torque_rms:.6g}" for demand in plan.demands])


def _row(name: str, cells: Sequence[str], end: str = "") -> str:
    return f"{name:<28}{''.join(f'{cell:>14}' for cell in cells)}{end:>14}".rstrip()


def _distance(distance: LimitDistance) -> str:
    side = "above" if distance.sign > 0.0 else "below"
    unit = f" [{distance.unit}]" if distance.unit != "1" else ""
    name = f"{distance.key} {side} {distance.end:.6g}{unit}"
    note = "" if distance.refused else "   ignored"
    return _row(name, [f"{distance.least:.6g}", f"{distance.reached.time:.6g}"]) + note


def _verdict(plan: MotionPlan, fastest: TimeScaling) -> Iterator[str]:
    for problem in plan.problems:
        yield f"refused: {problem}"
    if plan.scene.moment is not None and plan.scene.moment.topic:
        yield "The external moment comes from a topic; it counts as zero here."
    if plan.scene.actuators is not None and plan.scene.actuators.time_constant is not None:
        yield "The actuators lag; commands that make up for it may exceed the torques."
    yield "feasible" if not plan.problems else "not feasible"
    if any(distance.refused and distance.least < 0.0 for distance in plan.distances):
        yield "At no speed: the path itself leaves what is allowed."
    elif fastest.highest is None:
        yield "At no speed: the torque limit is too small for this path."
    elif math.isinf(fastest.highest):
        yield "At any speed: the scene has no limit that it could meet."
    else:
        duration = plan.motion.duration / fastest.highest
        yield (
            f"Highest speed {fastest.highest:.9g} times as planned, in {duration:.9g} s;"
            f" then the {fastest.binding} limit is met."
        )
    if fastest.highest is not None and fastest.lowest > 0.0:
        yield (
            f"Slower than {fastest.lowest:.9g} times as planned it is not feasible either: the"
            " torque limit is too small to rest everywhere on this path."
        )


def as_json(plan: MotionPlan, fastest: TimeScaling) -> str:
    """Write a plan for machines: SI units, null for what does not exist."""
    highest = fastest.highest
    return json.dumps(
        {
            "scene": plan.scene.name,
            "duration": plan.motion.duration,
            "feasible": not plan.problems,
            "problems": [str(problem) for problem in plan.problems],
            "limits": {name: limit for name, limit, _ in limits(plan.scene.actuators)},
            "actuators": [_plain(demand) for demand in plan.demands],
            "distances": [
                {**_plain(distance), "least": distance.least} for distance in plan.distances
            ],
            "highest_speed": None if highest is None or math.isinf(highest) else highest,
            "any_speed": highest is not None and math.isinf(highest),
            "lowest_speed": fastest.lowest,
            "binding": fastest.binding,
        },
        indent=2,
    )


def _plain(part: ActuatorDemand | LimitDistance) -> dict[str, object]:
    """Turn a part into a mapping; extremes become mappings, too."""
    values = ((field.name, getattr(part, field.name)) for field in dataclasses.fields(part))
    return {name: value._asdict() if hasattr(value, "_asdict") else value for name, value in values}


def write_torques(plan: MotionPlan, path: Path, period: float) -> None:
    """Write the torques for `torque_player`: each row, held for a period [s], is its middle's.

    The last row holds the manipulator where the motion ends.
    """
    inverse = InverseDynamics(plan.scene)
    count = math.ceil(plan.motion.duration / period - 1e-9)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["time", "tau_1", "tau_2", "tau_3"])
        for k in range(count + 1):
            at = plan.motion.at((k + 0.5) * period if k < count else math.inf)
            torque = inverse.reference_torque(at)
            writer.writerow([repr(k * period), *map(repr, torque)])
