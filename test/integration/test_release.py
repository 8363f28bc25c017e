# SPDX-License-Identifier: Apache-2.0
"""What rests against a rigid end is let go when the end would have to pull, not later.

Truth: the paper's equations with the actuator held as a constraint, under SciPy; and rest, where
nothing moves and the end pushes against just the torque of its actuator.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from integration.paper_form import PaperForm
from loaded_scenes import apart

from sst_ros.integration import propagator
from sst_ros.integration.propagator import Journey
from sst_ros.scene.scene import Friction, Initial, JointFriction, Stroke, Workspace, load
from sst_ros.simulation import Simulation

MILLISECOND = 1_000_000
PRESSED = replace(
    load("impacts"),
    initial=Initial(gamma=(1.55, 0.66, 0.93), gamma_dot=(0.3, 0.2, -0.1)),
    stroke=Stroke(at_end="impact", restitution=0.0),
    workspace=Workspace(at_edge="ignore"),
    torque=None,
)
RUBBED = replace(
    PRESSED, friction=JointFriction(gamma=Friction(viscous=0.5, coulomb=0.4, smoothing=0.05))
)
ARC = math.pi / 2
STILL = replace(PRESSED, initial=Initial(gamma=(ARC, 0.9, 1.2)))


def ramp(t):
    return (3.0 - 20.0 * t, 2.0 * math.cos(9.0 * t), -1.5 * math.sin(7.0 * t))


def wave(t):
    return (2.0 + 3.0 * math.cos(60.0 * t), 0.5 * math.cos(9.0 * t), -0.5 * math.sin(7.0 * t))


CASES = {
    "ramp": (PRESSED, ramp, 240),
    "rubbed": (RUBBED, ramp, 240),
    "wave": (PRESSED, wave, 240),
    "constant": (PRESSED, (0.13, -1.7, 1.9), 420),
}
"""Scene, torque as a function or as numbers, milliseconds."""


@functools.cache
def truth_of(name):
    scene, torque, milliseconds = CASES[name]
    paper = PaperForm(scene, torque if callable(torque) else lambda t: torque)
    return paper, *paper.run(0, True, milliseconds / 1e3)


@pytest.fixture
def met(monkeypatch):
    """Times of all that is met on the way."""
    times, until_met = [], Journey._until_met

    def recorded(self, at, x, h, drive):
        found = until_met(self, at, x, h, drive)
        if found[2] is not None:
            times.append(self._walk.origin + found[1])
        return found

    monkeypatch.setattr(Journey, "_until_met", recorded)
    return times


def travelled(name, period, method, tolerance):
    scene, torque, milliseconds = CASES[name]
    simulation = Simulation(scene, method, tolerance=tolerance)
    for begin in range(0, milliseconds, period):
        simulation.step(torque, min(period, milliseconds - begin) * MILLISECOND)
    return simulation


@pytest.mark.parametrize("period", [10, 1000])
@pytest.mark.parametrize("name", CASES)
def test_releases_come_when_the_papers_equations_have_them(name, period, met):
    paper, times, y = truth_of(name)
    assert len(times) > 1
    state = travelled(name, period, "dop853", 1e-13).state
    # An impact after which the end would have to pull at once is a release at the same time.
    np.testing.assert_allclose(met, sorted(set(times)), rtol=0.0, atol=1e-12)
    assert max(paper.apart(y, state)) < 1e-10


@pytest.mark.parametrize("tolerance", [1e-6, 1e-8])
@pytest.mark.parametrize("name", CASES)
def test_the_estimate_is_within_ten_times_of_the_true_error(name, tolerance):
    """The truth is good to 1e-13."""
    paper, _, y = truth_of(name)
    simulation = travelled(name, 50, "auto", tolerance)
    estimates = simulation.error_estimate, simulation.rate_error_estimate
    for estimate, error in zip(estimates, paper.distances(y, simulation.state), strict=True):
        assert 0.1 * error - 1e-12 < estimate < 10.0 * error + 1e-12


@pytest.mark.parametrize("name", ["ramp", "wave"])
def test_releases_lose_no_order(name):
    scene, torque, milliseconds = CASES[name]
    paper, _, y = truth_of(name)
    counts, errors = (16, 96), []
    for count in counts:
        simulation = Simulation(scene, "rk4")
        for _ in range(count):
            simulation.step(torque, milliseconds * MILLISECOND // count)
        errors.append(sum(paper.distances(y, simulation.state)))
    order = math.log(errors[0] / errors[1]) / math.log(counts[1] / counts[0])
    assert order == pytest.approx(4.0, abs=0.1)


def test_a_torque_that_turns_around_between_periods_frees_the_actuator_at_once():
    push, pull = (2.0, 0.3, -0.2), (-2.0, 0.3, -0.2)
    paper = PaperForm(PRESSED, lambda t: push if t < 0.1 else pull)
    _, y = paper.run(0, True, 0.1)
    y = paper.travelled(0.1, 0.2, y)[1][:, -1]
    simulation = Simulation(PRESSED, "dop853", tolerance=1e-13)
    for torque in (push, pull):
        for _ in range(2):
            simulation.step(torque, 50 * MILLISECOND)
    assert max(paper.apart(y, simulation.state)) < 1e-10


def test_a_state_within_the_step_of_a_release_is_that_of_a_shorter_step():
    simulation, other = (travelled("ramp", 10, "dop853", 1e-12) for _ in range(2))
    for one in (simulation, other):
        one.reset()
        one.step(ramp, 50 * MILLISECOND)
    simulation.step(ramp, 100 * MILLISECOND)
    for moment in (80, 120):
        other.reset()
        other.step(ramp, 50 * MILLISECOND)
        other.step(ramp, (moment - 50) * MILLISECOND)
        found = simulation.within(moment * MILLISECOND)
        assert max(*apart_of(found, other.state)) < 1e-11
    assert simulation.state.joints.gamma[0] < ARC


def apart_of(one, other):
    return math.dist(one.quaternion, other.quaternion), math.dist(one.body_rate, other.body_rate)


DIPS = {
    "touches zero": 0.0,
    "pulls by its rounding": -1e-16,
    "pulls by 1e-12": -1e-12,
    "pulls by 1e-6": -1e-6,
    "pulls": -0.05,
}


@pytest.mark.parametrize("least", DIPS.values(), ids=DIPS)
def test_a_push_that_dips_is_left_where_it_becomes_negative(least, met):
    """Nothing moves, so the end's push is the torque: 80 (t - 0.05)^2 + least."""
    when, curve = 0.05, 80.0
    simulation = Simulation(STILL, "dop853", tolerance=1e-13)
    for _ in range(2):
        simulation.step(lambda t: (curve * (t - when) ** 2 + least, 0.0, 0.0), 60 * MILLISECOND)
    started, *others = met
    assert started == 0.0 and len(others) <= 2
    if least < -1e-9:
        assert abs(others[0] - (when - math.sqrt(-least / curve))) < 1e-12
    if least < -1e-3:
        paper = PaperForm(STILL, lambda t: (curve * (t - when) ** 2 + least, 0.0, 0.0))
        y = paper.travelled(others[0], 0.12, paper.start)[1][:, -1]
        assert paper.posture(y).gamma[0] < ARC - 1e-5
        assert max(paper.apart(y, simulation.state)) < 1e-10
    else:
        # It is back before long, slower than a bounce is worth the name.
        assert simulation.state.joints.gamma[0] == pytest.approx(ARC, abs=1e-9)
        assert abs(simulation.state.joints.gamma_dot[0]) < 1e-4


def test_a_push_that_stays_positive_never_ends(met):
    simulation = Simulation(STILL, "dop853", tolerance=1e-13)
    simulation.step(lambda t: (80.0 * (t - 0.05) ** 2 + 1e-9, 0.0, 0.0), 120 * MILLISECOND)
    assert met == [0.0]
    assert simulation.state.joints.gamma[0] == pytest.approx(ARC, abs=1e-15)


def test_a_release_at_the_very_end_of_a_period_is_one_whichever_period_has_it():
    """The push is 1 - 10 t, zero at 0.1 s."""

    def torque(t):
        return (1.0 - 10.0 * t, 0.0, 0.0)

    paper = PaperForm(STILL, torque)
    y = paper.travelled(0.1, 0.15, paper.start)[1][:, -1]
    for period in (10, 50, 75):
        simulation = Simulation(STILL, "dop853", tolerance=1e-13)
        for _ in range(150 // period):
            simulation.step(torque, period * MILLISECOND)
        assert max(paper.apart(y, simulation.state)) < 1e-10


def both(t):
    return (1.0 - 10.0 * t, 0.0, 2.0 - 15.0 * t)


def test_of_two_ends_each_is_left_at_its_own_time(met):
    """Until the first lets go nothing moves; then the paper says when the other does."""
    scene = replace(PRESSED, initial=Initial(gamma=(ARC, 0.66, ARC)))
    paper = PaperForm(scene, both)
    then, y = paper.first_zero(paper.push(2, True, (2,)), 0.1, paper.start, 0.2, (2,))
    y = paper.travelled(then, 0.2, y)[1][:, -1]
    simulation = Simulation(scene, "dop853", tolerance=1e-13)
    simulation.step(both, 200 * MILLISECOND)
    np.testing.assert_allclose(met, [0.0, 0.0, 0.1, then], rtol=0.0, atol=1e-12)
    assert max(paper.apart(y, simulation.state)) < 1e-10


def test_torques_that_jump_free_those_ends_that_would_pull_and_no_others():
    """Whatever jumps to whatever: what stays is pushed on, what leaves moves inwards."""
    scene = replace(PRESSED, initial=Initial(gamma=(ARC, 0.66, ARC)))
    outcomes = set()
    for first, third in ((3.0, 2.0), (3.0, -0.2), (-0.2, 3.0), (-2.0, -1.0), (1.0, 0.05)):
        simulation = Simulation(scene, "dop853", tolerance=1e-12)
        simulation.step((3.0, 0.0, 2.0), 10 * MILLISECOND)
        torque = (first, 1.5, third)
        simulation.step(torque, MILLISECOND)
        gamma, rate = np.array(simulation.state.joints.gamma), simulation.state.joints.gamma_dot
        away = ARC - gamma > 1e-9
        outcomes.add((bool(away[0]), bool(away[2])))
        paper = PaperForm(scene, lambda t, torque=torque: torque)
        held = tuple(k for k in (0, 2) if not away[k])
        answer, push = paper.accelerations(0.0, paper.start, held)
        for k in (0, 2):
            assert (answer[k] < 0.0) if away[k] else (push[k] < 0.0)
            assert rate[k] == pytest.approx(1e-3 * answer[k], rel=1e-2, abs=1e-15)
    assert len(outcomes) > 2


def test_an_impact_tears_off_what_rests_where_it_makes_it_move_inwards(met):
    push = (4.0, 0.0, 0.0)
    scene = replace(PRESSED, initial=Initial(gamma=(ARC, 0.66, 1.55), gamma_dot=(0.0, 0.0, 2.0)))
    paper = PaperForm(scene, lambda t: push)
    then, y = paper.first_zero(paper.end(2, True), 0.0, paper.start, 0.05, (0,))
    y = paper.struck(y, 2, 0.0)
    assert y[4] < -0.1 and paper.push(2, True, (2,))(then, y) > 0.1
    y = paper.travelled(then, 0.03, y, (2,))[1][:, -1]
    simulation = Simulation(scene, "dop853", tolerance=1e-13)
    for _ in range(3):
        simulation.step(push, 10 * MILLISECOND)
    np.testing.assert_allclose(met, [0.0, then], rtol=0.0, atol=1e-12)
    assert max(paper.apart(y, simulation.state)) < 1e-10


def test_release_and_impact_without_end_are_refused(monkeypatch):
    monkeypatch.setattr(propagator, "_ENDS_PER_PERIOD", 3)
    simulation = Simulation(PRESSED)
    before = simulation.state
    with pytest.raises(Exception, match="ends are met or left 3 times in one period"):
        simulation.step(wave, 250 * MILLISECOND)
    assert simulation.state is before
    monkeypatch.undo()
    other = Simulation(PRESSED)
    assert simulation.step(wave, 250 * MILLISECOND) == other.step(wave, 250 * MILLISECOND)
    assert apart(simulation, other) == (0.0, 0.0)
