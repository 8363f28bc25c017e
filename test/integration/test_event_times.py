# SPDX-License-Identifier: Apache-2.0
"""When events happen, against times that our integrators did not make.

A star without inertia of its legs, and alike about all axes, turns at a constant rate
about a fixed axis: then every event is a root of A cos(rate t) + B sin(rate t) + C.
Motions through elastic contacts are held against SciPy in
`test/mechanism/test_symmetric_motion.py`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from loaded_scenes import IGNORE, REST, apart
from models import inertia_of

from sst_ros.dynamics.model import SINGULAR_MU
from sst_ros.errors import SingularityReached, StrokeExceeded, WorkspaceLeft
from sst_ros.integration.events import first_crossing
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.geometry import Geometry, rotation_matrix
from sst_ros.scene.bodies import Link, Stroke, Workspace
from sst_ros.scene.loads import Friction, Initial, JointFriction
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation

EXAMPLE2 = load("example2_heavy")
NOTHING = Link(inertia=inertia_of(1e-18 * np.eye(3)))
FREE_STAR = replace(
    EXAMPLE2,
    star=replace(EXAMPLE2.star, inertia=inertia_of(0.3 * np.eye(3))),
    actuated_links=(NOTHING,) * 3,
    intermediate_links=(NOTHING,) * 3,
    torque=None,
    **IGNORE,
)
GAMMA = (0.7, 0.8, 0.75)
RATE = 3.0
MILLISECOND = 1_000_000


START = Simulation(replace(EXAMPLE2, initial=Initial(gamma=GAMMA))).state
AT = virtual_work.posture(
    Geometry.of(EXAMPLE2),
    np.array(START.joints.gamma),
    rotation_matrix(START.quaternion),
)


def turning(scene, axis, method="dop853"):
    """Simulation whose star turns about a fixed axis in {B} at RATE."""
    moving = Initial(gamma=GAMMA, gamma_dot=tuple(np.linalg.solve(AT.j, RATE * axis)))
    return Simulation(replace(scene, initial=moving), method, tolerance=1e-13)


def first_root(axis, moving, fixed):
    """When a vector that turns about `axis` at RATE is first at right angles to a fixed
    one.
    """
    along = (axis @ moving) * (axis @ fixed)
    a, b = moving @ fixed - along, np.cross(axis, moving) @ fixed
    base, spread = math.atan2(b, a), math.acos(-along / math.hypot(a, b))
    turns = [(base + sign * spread) % (2.0 * math.pi) for sign in (1.0, -1.0)]
    return min(turns) / RATE


def met(simulation, error):
    with pytest.raises(error) as caught:
        for _ in range(3000):
            simulation.step(REST, MILLISECOND)
    return caught.value


@pytest.mark.parametrize("leg", [0, 1, 2])
def test_a_serial_singularity_is_met_where_a_legs_axes_coincide(leg):
    """The star turns t_k straight into w_k, at a constant rate."""
    axis = np.cross(AT.t[leg], AT.w[leg])
    size = np.linalg.norm(axis)
    mu = math.atan2(size, AT.t[leg] @ AT.w[leg])
    simulation = turning(FREE_STAR, axis / size)
    stop = met(simulation, SingularityReached)
    assert stop.reason == f"serial singularity, mu_{leg + 1} = 0"
    assert abs(stop.time - (mu - SINGULAR_MU) / RATE) < 1e-12


@pytest.mark.parametrize("leg", [0, 1, 2])
def test_the_workspace_ends_where_e_lies_in_the_plane_of_an_arc(leg):
    s = AT.rotation[:, 2]
    axis = np.cross(s, -AT.w[leg])
    axis /= np.linalg.norm(axis)
    simulation = turning(replace(FREE_STAR, workspace=EXAMPLE2.workspace), axis)
    stop = met(simulation, WorkspaceLeft)
    assert stop.reason.startswith(f"beta_{leg + 1}")
    assert abs(stop.time - first_root(axis, s, AT.w[leg])) < 1e-12


@pytest.mark.parametrize(
    ("upper", "method"), [(False, "dop853"), (True, "dop853"), (True, "auto")]
)
def test_the_end_of_a_stroke_is_met_when_an_arc_stands_across_it(upper, method):
    """gamma_k has a value where t_k is at right angles to r_k there."""
    geometry = Geometry.of(EXAMPLE2)
    axis = AT.rotation[:, 2] * (1.0 if upper else -1.0)
    simulation = turning(replace(FREE_STAR, stroke=Stroke()), axis, method)
    stop = met(simulation, StrokeExceeded)
    k = int(stop.reason.removeprefix("gamma_")[0]) - 1
    ends = kinematics.carriage_directions(
        geometry, geometry.arc if upper else np.zeros(3)
    )
    times = [first_root(axis, AT.t[j], ends[j]) for j in range(3)]
    assert abs(stop.time - times[k]) < 1e-12
    assert times[k] == min(times)


@pytest.mark.slow
def test_auto_follows_a_run_that_is_stiff_then_not_then_stiff():
    """A soft end with much damping: pressed against it, torn off, pressed against it
    again.
    """
    scene = replace(
        EXAMPLE2,
        torque=None,
        stroke=Stroke(at_end="elastic", stiffness=1e5, damping=1e4),
        workspace=Workspace(at_edge="ignore"),
        friction=JointFriction(gamma=Friction(viscous=0.5)),
        initial=Initial(gamma=(0.05, 0.5, 0.5)),
    )
    simulation, truth = (
        Simulation(scene, tolerance=1e-9),
        Simulation(scene, "rodas5p", step_budget=10**6),
    )
    pushes = [(-2.0, 0.0, 0.0)] * 60 + [(2.0, 0.0, 0.0)] * 40 + [(-4.0, 0.0, 0.0)] * 60
    for push in pushes:
        simulation.step(push, 10 * MILLISECOND)
        truth.step(push, 10 * MILLISECOND)
    told = [change for change in simulation.changes if change.method != "dop853"]
    assert [change.method for change in told] == ["rodas5p", "dopri5", "rodas5p"]
    stiff = "stiff: step times fastest decay is "
    reasons = (stiff, "no longer stiff: step times rate is ", stiff)
    for change, reason in zip(told, reasons, strict=True):
        assert change.reason.startswith(reason)
    first, back, again = (change.time for change in told)
    assert 0.0 < first < 0.6 < back < 0.65 < 1.0 < again < 1.6
    assert apart(simulation, truth)[0] < 1e-6


FOUND = {
    "a crossing, to the rounding of its time": (
        math.cos,
        lambda t: -math.sin(t),
        2.0,
        math.pi / 2,
    ),
    "a dip inside": (
        lambda t: (t - 0.4) * (t - 0.6),
        lambda t: 2.0 * t - 1.0,
        1.0,
        0.4,
    ),
    "leaving an end and back": (
        lambda t: t * (0.5 - t),
        lambda t: 0.5 - 2.0 * t,
        1.0,
        0.5,
    ),
    "through an end at once": (lambda t: -t, lambda t: -1.0, 1.0, 0.0),
    "from beyond it by rounding": (lambda t: -1e-15 - t, lambda t: -1.0, 1.0, 0.0),
    "pushed from rest through an end": (lambda t: -t * t, lambda t: -2.0 * t, 1.0, 0.0),
}
NONE = {
    "a minimum above zero": (
        lambda t: (t - 0.5) ** 2 + 1e-9,
        lambda t: 2.0 * (t - 0.5),
        1.0,
    ),
    "leaving an end": (lambda t: t, lambda t: 1.0, 1.0),
    "inside, away": (lambda t: 1.0 + t, lambda t: 1.0, 1.0),
    "inside, towards an end": (lambda t: 2.0 - t, lambda t: -1.0, 1.0),
    "rest at an end": (lambda t: -1e-16, lambda t: 0.0, 1.0),
    # What has just left an end at almost no rate is off it by less than an angle's
    # rounding.
    "rounding on the way inwards": (lambda t: 1e-14 * t - 1e-16, lambda t: 1e-14, 1e-3),
}


@pytest.mark.parametrize(("margin", "slope", "h", "at"), FOUND.values(), ids=FOUND)
def test_a_crossing_is_found(margin, slope, h, at):
    found = first_crossing(margin, slope, h)
    assert found == (pytest.approx(at, abs=4e-16) if at else 0.0)


@pytest.mark.parametrize(("margin", "slope", "h"), NONE.values(), ids=NONE)
def test_what_stays_inside_is_no_crossing(margin, slope, h):
    assert first_crossing(margin, slope, h) is None
