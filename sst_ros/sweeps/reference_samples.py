# SPDX-License-Identifier: Apache-2.0
"""References of a compiled control loop, sampled once for all scenarios; numbers by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.control.reference import REST
from sst_ros.mechanism.geometry import Array
from sst_ros.sweeps.controlled import ControlledRun

REFERENCES = (
    ("first", 1), ("gamma", 3), ("gamma_dot", 3), ("gamma_ddot", 3), ("feedforward", 3),
    ("held_feedforward", 3), ("quaternion", 4), ("body_rate", 3), ("body_acceleration", 3),
)  # fmt: skip
Group = dict[str, Any]
"""Tuples of numbers by name."""


def reference_table(loop: ControlledRun, samples: int) -> Array:
    """Return the references of samples 0 to `samples`, shape (samples + 1, n)."""
    inverse, period = InverseDynamics(loop.model), loop.channel.period
    feeding = loop.settings.mode not in ("pd", "gravity_pd")
    middle = loop.settings.feedforward_at == "middle"
    rows = []
    for k in range(samples + 1):
        time = k * round(period * 1e9) / 1e9
        at = loop.motion.at(time)
        torque = inverse.reference_torque(at) if feeding else REST
        held = torque
        if feeding and middle:
            held = inverse.reference_torque(loop.motion.at(time + 0.5 * period))
        rows.append(
            (float(k == 0), *at.gamma, *at.gamma_dot, *at.gamma_ddot, *torque, *held,
             *at.quaternion, *at.body_rate, *at.body_acceleration)
        )  # fmt: skip
    return np.array(rows)


def grouped(names: Sequence[tuple[str, int]], numbers: Sequence[Any]) -> Group:
    """Divide numbers into groups of the sizes given."""
    found, at = {}, 0
    for name, size in names:
        found[name] = tuple(numbers[at : at + size])
        at += size
    return found
