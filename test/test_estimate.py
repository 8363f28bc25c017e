# SPDX-License-Identifier: Apache-2.0
"""The error estimate of simulate() where a motion is not smooth, against far finer
solutions.
"""

import functools

import numpy as np
import pytest

from sst_ros import TorqueTable, load_scene, simulate
from sst_ros.integration.method_steps import JACOBIAN_COST
from sst_ros.integration.methods import METHODS
from sst_ros.mechanism.geometry import angle_between
from sst_ros.scene.torque_profile import PolynomialTorque, SineTorque

EXAMPLE2 = load_scene("example2_heavy")
SINE = SineTorque(
    amplitude=(4.0, 5.0, 3.0), frequency=(9.0, 7.0, 8.0), phase=(0.1, 0.7, 2.0)
)
STEPPED = ("rk4", "dopri5", "dop853", "rodas5p")
HALVES = np.arange(100) / 2000


def jumping(t):
    return (0.3, -0.2, 0.1) if t < 0.3217 else (-0.3, 0.4, 0.2)


def square(t):
    sign = 1.0 if (1000.0 * t) % 1.0 < 0.5 else -1.0
    return sign, -0.5 * sign, 0.7 * sign


PIECES = PolynomialTorque([[[30.0, 9.0, -20.0]], [[-4.0, 2.0, 3.0]]], [0.0, 0.2])
SATURATED = EXAMPLE2.with_values(
    {"actuators.torque_limit": 2.5, "stroke.at_end": "ignore"}
)
FREE = EXAMPLE2.with_values({"stroke.at_end": "ignore", "workspace.at_edge": "ignore"})
WEAK = EXAMPLE2.with_values({"actuators.torque_limit": 0.5})
RUNS = {
    "clamped sine": {"scene": SATURATED, "torque": SINE, "duration": 0.4},
    "clamped polynomial": {"scene": WEAK, "torque": PIECES, "duration": 0.2},
    "jump": {"scene": EXAMPLE2, "torque": jumping, "duration": 0.6},
    "square wave": {"scene": EXAMPLE2, "torque": square, "duration": 0.05},
    "friction": {"scene": "friction", "duration": 0.5},
    "ten seconds": {"scene": "swing", "torque": lambda t: (0.0,) * 3, "duration": 10.0},
}
# The truth: the same torque, where it jumps as a table, in far finer steps.
TRUTHS = {
    "clamped polynomial": {"tolerance": 1e-13},
    "jump": {
        "tolerance": 1e-13,
        "torque": TorqueTable([0.0, 0.3217], [jumping(0.0), jumping(1.0)]),
    },
    "square wave": {
        "tolerance": 1e-13,
        "torque": TorqueTable(HALVES, [square(t + 1e-4) for t in HALVES]),
    },
}


def run_case(name, **options):
    return simulate(**RUNS[name] | {"t_eval": [RUNS[name]["duration"]]} | options)


@functools.cache
def truth_of(name):
    return run_case(
        name, **{"method": "dop853", "tolerance": 1e-12} | TRUTHS.get(name, {})
    )


@pytest.mark.parametrize(
    ("name", "method", "options"),
    [
        *(("clamped sine", method, {"tolerance": 1e-5}) for method in STEPPED),
        *(("clamped sine", method, {"tolerance": 1e-9}) for method in STEPPED),
        ("clamped polynomial", "dop853", {"tolerance": 1e-8}),
        *(("jump", method, {"tolerance": 1e-8}) for method in STEPPED),
        ("square wave", "dop853", {"tolerance": 1e-7}),
        ("square wave", "dop853", {"tolerance": 1e-7, "breaks": HALVES}),
        ("friction", "dop853", {"tolerance": 1e-4}),
        ("friction", "auto", {"tolerance": 1e-6}),
        # A tolerance of the local errors alone leaves 3.3e-9 rad, three times as much.
        ("ten seconds", "dopri5", {"tolerance": 1e-9}),
    ],
)
def test_a_run_meets_its_tolerance_and_its_estimate_is_close(name, method, options):
    found, truth = run_case(name, method=method, **options), truth_of(name)
    error = angle_between(found.quaternion[-1], truth.quaternion[-1])
    assert found.success, found.message
    assert error <= (1e-12 if name == "square wave" else options["tolerance"])
    assert found.error_estimate <= options["tolerance"]
    assert error <= 3.0 * found.error_estimate + truth.error_estimate
    assert name != "clamped polynomial" or found.evaluations < 3000


def test_breakpoints_of_a_table_are_not_rounded_to_nanoseconds():
    """A torque of 1 N m that acts for 1e-10 s longer turns the star by 1e-10 of a
    radian.
    """
    times = np.array([0.0, 0.1 + 3.3e-10, 0.2 + 4.4e-10])
    torques = [[5.0, 0.0, 0.0], [-5.0, 4.0, 0.0], [0.0, -4.0, 5.0]]
    arguments = {
        "scene": EXAMPLE2,
        "duration": 0.4,
        "t_eval": [0.4],
        "tolerance": 1e-12,
    }
    found = simulate(torque=TorqueTable(times, torques), method="dop853", **arguments)

    def same(t):
        return torques[int(np.searchsorted(times, t, side="right")) - 1]

    other = simulate(torque=same, breaks=times[1:], method="dopri5", **arguments)
    rounded = simulate(
        torque=TorqueTable(times.round(9), torques), method="dop853", **arguments
    )
    assert angle_between(found.quaternion[-1], other.quaternion[-1]) < 1e-12
    assert angle_between(found.quaternion[-1], rounded.quaternion[-1]) > 1e-10


def law(t, state):
    rows = zip(state.joints.gamma, state.joints.gamma_dot, strict=True)
    return [-4.0 * (angle - 0.8) - 0.8 * rate for angle, rate in rows]


@pytest.mark.parametrize("seed", range(4))
def test_a_held_controllers_answer_to_the_error_is_estimated_too(seed):
    """Held for so long that the loop is unstable: the error grows, and the torques with
    it.
    """
    rng = np.random.default_rng(seed)
    period, tolerance = (
        round(float(rng.uniform(0.1, 0.25)), 3),
        10.0 ** rng.uniform(-9.0, -5.0),
    )
    arguments = {
        "torque": law,
        "duration": 0.9,
        "control_period": period,
        "t_eval": [0.9],
    }
    truth = simulate(
        FREE, method="dop853", tolerance=1e-13, memoryless=True, **arguments
    )
    for method in STEPPED:
        run = functools.partial(
            simulate, FREE, method=method, tolerance=tolerance, **arguments
        )
        found, other = run(memoryless=True), run()
        error, unseen = (
            angle_between(x.quaternion[-1], truth.quaternion[-1])
            for x in (found, other)
        )
        assert found.success and error <= found.error_estimate <= 4.0 * error + 1e-13
        assert unseen <= other.error_estimate


def test_a_tolerance_that_is_not_met_is_said():
    found = simulate(EXAMPLE2, jumping, 0.1, control_period=0.01, tolerance=1e-15)
    assert (found.status, found.success) == (2, False)
    assert "exceeds the tolerance 1e-15 rad" in found.message


@pytest.mark.parametrize("method", STEPPED)
def test_samples_do_not_change_the_motion(method):
    ends = [
        simulate(EXAMPLE2, jumping, 0.4, method=method, t_eval=times, tolerance=1e-7)
        for times in (None, [0.4], np.linspace(0.0, 0.4, 9), [1e-9, 0.1234, 0.4])
    ]
    for one in ends:
        assert one.quaternion[-1].tobytes() == ends[0].quaternion[-1].tobytes()
        assert one.error_estimate == ends[0].error_estimate
    few, finer = (
        ends[3],
        simulate(EXAMPLE2, jumping, 0.4, t_eval=ends[3].t, tolerance=1e-11),
    )
    assert max(map(angle_between, few.quaternion, finer.quaternion)) < 1e-7


def test_nine_samples_cost_little_more_than_none():
    counts = [
        simulate(
            "example2_heavy", method="dop853", t_eval=times, tolerance=1e-8
        ).evaluations
        for times in ([1.0], np.linspace(0.0, 1.0, 9))
    ]
    assert counts[1] <= counts[0] + 9 * 12  # a step for each, which is counted


@pytest.mark.parametrize("method", STEPPED)
def test_samples_are_as_good_as_the_end_and_cost_a_step_each(method):
    many, finer = (
        simulate(
            EXAMPLE2,
            method=how,
            t_eval=np.linspace(0.0, 1.0, 4001),
            tolerance=tolerance,
        )
        for how, tolerance in ((method, 1e-7), ("dop853", 1e-12))
    )
    assert max(map(angle_between, many.quaternion, finer.quaternion)) < 1e-7
    few = simulate(EXAMPLE2, method=method, t_eval=[1.0], tolerance=1e-7)
    step = len(METHODS[method].a) + (JACOBIAN_COST if method == "rodas5p" else 0)
    assert many.evaluations - few.evaluations <= step * 4001


def test_the_longest_step_is_obeyed():
    seen = []

    def torque(t):
        seen.append(t)
        return (0.0, 0.0, 0.0)

    simulate(
        EXAMPLE2,
        torque,
        1.0,
        max_step=0.01,
        tolerance=1e-3,
        method="dopri5",
        t_eval=[1.0],
    )
    assert np.diff(np.unique(seen)).max() <= 0.01


def test_trial_states_that_are_not_finite_reach_no_feedback():
    def feedback(t, state):
        assert np.all(np.isfinite([*state.quaternion, *state.body_rate]))
        return [-1e4 * rate for rate in state.joints.gamma_dot]

    found = simulate("example1", feedback, 0.2, tolerance=1e-6, t_eval=[0.2])
    assert found.success, found.message


def damped(t, state):
    return [-2e3 * rate for rate in state.joints.gamma_dot]


def test_auto_is_implicit_under_a_stiff_feedback():
    scene = load_scene("example1")
    found = simulate(scene, damped, 0.5, tolerance=1e-6, t_eval=[0.5])
    assert "rodas5p" in found.method
    explicit = simulate(
        scene, damped, 0.5, tolerance=1e-6, t_eval=[0.5], method="dopri5"
    )
    assert found.evaluations < 0.5 * explicit.evaluations
    assert angle_between(found.quaternion[-1], explicit.quaternion[-1]) < 2e-6


@pytest.mark.parametrize(
    "torque",
    [None, jumping, lambda t, state: jumping(t)],
    ids=["sine", "f(t)", "f(t, x)"],
)
def test_rodas5p_is_what_runs_when_it_is_asked_for(torque):
    found, other = (
        simulate(EXAMPLE2, torque, 0.1, method=method, tolerance=1e-8, t_eval=[0.1])
        for method in ("rodas5p", "dopri5")
    )
    assert found.method == "rodas5p"
    assert found.evaluations != other.evaluations
    np.testing.assert_allclose(found.gamma, other.gamma, atol=2e-8)
