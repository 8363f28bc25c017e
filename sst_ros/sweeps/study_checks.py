# SPDX-License-Identifier: Apache-2.0
"""What the values of a study must be, each for itself."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from sst_ros.errors import Problem
from sst_ros.scene.scene import SineTorque
from sst_ros.state import QUANTITIES
from sst_ros.sweeps.sampling import SAMPLINGS

OUTPUTS = (*QUANTITIES, "energy", "extremes")
"""What `outputs` may name: quantities of the final state, and extremes of joints."""

MOST_ROWS = 2**53


def problems(given: Mapping[str, Any]) -> Iterator[Problem]:
    """Yield what is wrong with the values of a study by key."""
    checks = {
        "n": (given["n"], 1, MOST_ROWS), "seed": (given["seed"], 0, 2**64 - 1),
        "steps": (given["steps"], 1, 10_000_000), "chunk": (given["chunk"], 1, 10_000_000),
    }  # fmt: skip
    for name, (value, least, most) in checks.items():
        if value is None and name in ("n", "steps"):
            continue
        if type(value) is not int or not least <= value <= most:
            yield Problem(name, value, f"must be a whole number from {least} to {most}")
    for name, number in (("duration", given["duration"]), ("tolerance", given["tolerance"])):
        real = isinstance(number, (int, float)) and math.isfinite(number) and number > 0.0
        if number is not None and not real:
            yield Problem(name, number, "must be a finite number > 0")
    if given["sampling"] not in SAMPLINGS:
        yield Problem("sampling", given["sampling"], f"must be one of {', '.join(SAMPLINGS)}")
    for name in given["outputs"]:
        if name not in OUTPUTS:
            yield Problem("outputs", name, f"must be of {', '.join(OUTPUTS)}")
    if given["torque"] is not None and given["control"] is not None:
        yield Problem("torque", "given", "has no effect: the controller gives the torques")
    constant = not isinstance(given["torque"], (Mapping, SineTorque, type(None)))
    if constant and (np.shape(given["torque"]) != (3,) or not np.all(np.isfinite(given["torque"]))):
        yield Problem("torque", given["torque"], "must be three finite numbers [N m] or a mapping")
    if given["trajectory"] is not None:
        good = isinstance(given["trajectory"], Mapping) and given["trajectory"].keys() == {
            "rows",
            "samples",
        }
        if not good or not all(
            type(x) is int and 1 <= x <= 100_000 for x in given["trajectory"].values()
        ):
            allowed = "must be {rows: m, samples: k}, whole numbers from 1 to 100000"
            yield Problem("trajectory", given["trajectory"], allowed)
