# SPDX-License-Identifier: Apache-2.0
"""The seven links as rigid bodies: a tree with two loops to close, for engines that need one.

base -> actuated k -> intermediate k for each leg, the star hangs on leg 1. All axes pass through
O. Legs 2 and 3 are closed by tying the point t_k of the intermediate link to that of the star.
At the start all joint angles are 0 and all body frames are {B}.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmark.peers.task import Task
from sst_ros.mechanism.geometry import Array

BASE = "base"


class Body(NamedTuple):
    """A body with the hinge that it hangs on; depth first, parents before children.

    Attributes:
        name, parent, joint: names.
        axis: of the hinge in {B}, through O.
        about_o: inertia about O in {B} [kg m^2].
        mass: [kg].
        centre: of mass in {B} [m].
        about_centre: inertia about the centre of mass in {B} [kg m^2].

    """

    name: str
    parent: str
    joint: str
    axis: Array
    about_o: Array
    mass: float
    centre: Array
    about_centre: Array


def bodies(task: Task) -> list[Body]:
    """All seven."""
    found = []
    for k in range(3):
        found.append(_body(task, f"a{k}", BASE, f"g{k}", task.w[k]))
        found.append(_body(task, f"i{k}", f"a{k}", f"m{k}", -task.r[k]))
        if k == 0:
            found.append(_body(task, "s", "i0", "b0", -task.t[0]))
    return found


def ties(task: Task) -> list[tuple[str, Array]]:
    """Bodies that are tied to the star, and the point in {B} at the start."""
    return [(f"i{k}", task.t[k]) for k in (1, 2)]


def _body(task: Task, name: str, parent: str, joint: str, axis: Array) -> Body:
    """Put the centre of mass off O: engines scale the softness of a tie by where it is.

    Without gravity only the inertia about O matters, so mass and centre are free: a point mass on
    the axis of the largest moment takes from the two smaller ones only.
    """
    tensor = task.tensor(name)
    moments, axes = np.linalg.eigh(tensor)
    least, middle, most = moments
    mass = 1.0
    centre = axes[:, 2] * np.sqrt(max(0.0, 0.2 * (least + middle - most)) / mass)
    central = tensor - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return Body(name, parent, joint, axis, tensor, mass, centre, central)
