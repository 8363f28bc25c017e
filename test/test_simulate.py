# SPDX-License-Identifier: Apache-2.0
"""simulate(): what it takes and returns, and that it is the run of Simulation."""

import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp

from benchmark.plain_python import without_llvmlite
from sst_ros import TorqueTable
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import InputError
from sst_ros.mechanism.geometry import angle_between
from sst_ros.scene.scene import load
from sst_ros.scene.yaml_document import dump, plain
from sst_ros.simulation.simulate import simulate
from sst_ros.simulation.simulation import Simulation

EXAMPLE2 = load("example2_heavy")
SHARP = load("friction").with_values({"friction.gamma.smoothing": 1e-4})


def jerk(t):
    return t, t, t


def spring(t, state):
    rows = zip(state.joints.gamma, state.joints.gamma_dot, strict=True)
    return [-4.0 * (angle - 0.8) - 0.1 * rate - t for angle, rate in rows]


def test_a_name_a_path_a_dict_and_a_scene_are_the_same(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text(dump(EXAMPLE2))
    document = yaml.safe_load(dump(EXAMPLE2))
    document["star"]["alpha_deg"] = np.array(document["star"]["alpha_deg"])
    ends = [
        simulate(scene, duration=0.01).gamma[-1].tolist()
        for scene in ("example2_heavy", path, str(path), document, EXAMPLE2)
    ]
    assert ends == [ends[0]] * 5
    assert plain({"a": np.float64(1.0)}) == {"a": 1.0}


def test_simulate_with_a_control_period_is_a_run_of_simulation():
    def controller(t, state):
        return spring(0.0, state)

    found = simulate(EXAMPLE2, controller, 0.1, control_period=0.001, tolerance=1e-10)
    simulation = Simulation(EXAMPLE2, tolerance=1e-10)
    assert len(found) == 101
    for k in range(101):
        state = simulation.state
        assert found.t[k] == state.time_ns / 1e9
        assert tuple(found.quaternion[k]) == state.quaternion
        assert tuple(found.body_rate[k]) == state.body_rate
        assert tuple(found.gamma[k]) == state.joints.gamma
        assert tuple(found.torque[k]) == state.torque
        simulation.step(tuple(controller(0.0, state)), 1_000_000)
    between = simulate(
        EXAMPLE2,
        controller,
        0.1,
        control_period=0.001,
        tolerance=1e-10,
        t_eval=[0.02, 0.0305],
    )
    assert between.quaternion[0].tolist() == found.quaternion[20].tolist()
    np.testing.assert_allclose(found.at(0.0305).gamma, between.gamma[1:], atol=1e-12)


def test_auto_takes_order_eight_if_smooth_and_meets_its_estimate():
    truth = simulate(EXAMPLE2, method="dop853", tolerance=1e-13)
    found = simulate(EXAMPLE2, tolerance=1e-9)
    assert found.method == "dop853"
    steps = simulate(EXAMPLE2, tolerance=1e-9, t_eval=[1.0])
    assert steps.evaluations < 2000
    ratio = found.error_estimate / angle_between(
        found.quaternion[-1], truth.quaternion[-1]
    )
    assert 1.5 < ratio < 3.0 and found.error_estimate <= 1e-9
    assert abs(found.energy_residual) < 3e-9
    times = np.linspace(0.0, 1.0, 201)
    np.testing.assert_allclose(found.at(times).gamma, truth.gamma, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.at(times).torque, truth.torque, rtol=0, atol=1e-13)
    sampled = simulate(EXAMPLE2, tolerance=1e-9, t_eval=times)
    np.testing.assert_allclose(sampled.gamma, found.at(times).gamma, rtol=0, atol=1e-14)


def test_a_motion_that_does_not_meet_its_tolerance_says_so():
    found = simulate(EXAMPLE2, (1.0, 0.0, 0.0), 0.1, tolerance=1e-15)
    assert found.status == 2 and "exceeds the tolerance 1e-15 rad" in found.message


ARRAYS = ("t", "quaternion", "body_rate", "torque", "gamma")
RUNS = {
    "sine": {"scene": "example2_heavy"},
    "constant": {"scene": "general", "torque": (0.1, 0.2, 0.0), "duration": 0.3},
    "steps": {"scene": "swing", "duration": 0.2},
    "function": {"scene": "example2", "torque": lambda t: (t, -t, t), "duration": 0.2},
    "table": {
        "scene": "example2",
        "torque": TorqueTable([0.0, 0.1], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        "duration": 0.2,
    },
}


@pytest.mark.parametrize("arguments", RUNS.values(), ids=RUNS)
def test_equal_calls_give_equal_bits_in_arrays_of_their_own(arguments):
    expected = simulate(**arguments)
    for _ in range(3):
        found = simulate(**arguments)
        for name in ARRAYS:
            assert getattr(found, name).tobytes() == getattr(expected, name).tobytes()
            assert not np.shares_memory(getattr(found, name), getattr(expected, name))
        assert found.error_estimate == expected.error_estimate


@pytest.mark.parametrize("arguments", RUNS.values(), ids=RUNS)
def test_samples_are_even_and_accurate_and_change_no_motion(
    arguments,
):
    run = simulate(**arguments)
    np.testing.assert_allclose(
        run.t, np.linspace(0.0, run.t[-1], 201), rtol=0, atol=1e-9
    )
    few, end = simulate(**arguments, samples=4), simulate(**arguments, t_eval=run.t[-1])
    assert few.t.tolist() == run.t[::50].tolist()
    for name in ARRAYS:
        assert getattr(few, name)[-1].tobytes() == getattr(run, name)[-1].tobytes()
        assert getattr(end, name)[-1].tobytes() == getattr(run, name)[-1].tobytes()
    assert (
        few.error_estimate == run.error_estimate and few.evaluations <= run.evaluations
    )
    truth = simulate(**arguments, method="dop853", tolerance=1e-13)
    apart = angle_between(run.quaternion, truth.quaternion)
    assert apart.max() < 1e-9  # rad, the tolerance
    np.testing.assert_allclose(few.gamma, truth.gamma[::50], rtol=0, atol=1e-9)


def test_samples_are_even_or_the_periods_of_a_control():
    stopped = simulate(EXAMPLE2, (5.0, 0.0, 0.0), 0.4)
    assert (
        stopped.t[:-1].tolist()
        == (np.arange(len(stopped) - 1) * 0.4 / 200).round(9).tolist()
    )
    assert 0.0 < stopped.t[-1] - stopped.t[-2] <= 0.002
    control = {"torque": spring, "duration": 0.1, "control_period": 0.03}
    assert simulate(EXAMPLE2, **control).t.tolist() == [0.0, 0.03, 0.06, 0.09, 0.1]
    assert simulate(EXAMPLE2, **control, samples=2).t.tolist() == [0.0, 0.05, 0.1]
    assert simulate(EXAMPLE2, duration=1e-9).t.tolist() == [0.0, 1e-9]


@pytest.mark.parametrize(
    "arguments",
    [pytest.param(given, id=name) for name, given in RUNS.items()],
)
def test_threads_get_their_own_motions(arguments):
    one = simulate(**arguments)
    times = [
        np.sort(np.random.default_rng(k).uniform(0.0, one.t[-1], 20)) for k in range(8)
    ]
    expected = [one.at(t).quaternion for t in times]
    with ThreadPoolExecutor(8) as pool:
        for _ in range(3):
            at = list(pool.map(lambda t: one.at(t).quaternion, times))
            again = list(pool.map(lambda _: simulate(**arguments).quaternion, times))
            for found, wanted in zip(at, expected, strict=True):
                assert found.tobytes() == wanted.tobytes()
            for found in again:
                assert found.tobytes() == one.quaternion.tobytes()


@pytest.mark.parametrize(
    ("scene", "torque", "first"),
    [
        ("elastic_stops", None, "dop853"),
        ("stiff", None, "dop853, then rodas5p"),
        ("example2_heavy", jerk, "dop853"),
    ],
)
def test_auto_begins_with_order_eight_and_changes_where_stiff(scene, torque, first):
    found = simulate(scene, torque, 0.1)
    assert found.success and found.method.startswith(first)
    rough = simulate(scene, torque, 0.1, tolerance=1e-5)
    assert rough.success and rough.method.startswith("dopri5")


@pytest.mark.parametrize(
    ("duration", "method", "letters", "within"),
    [(0.4, "dop853", 27, 1e-8), (3.0, "dop853", 25, 1e-7)],
)
def test_a_limit_ends_the_motion_and_keeps_what_is_valid(
    duration, method, letters, within
):
    found = simulate(EXAMPLE2, (5.0, 0.0, 0.0), duration)
    truth = simulate(
        EXAMPLE2, (5.0, 0.0, 0.0), duration, method="dop853", tolerance=1e-12
    )
    assert method in found.method
    assert (found.status, truth.status, found.success) == (1, 1, False)
    assert "gamma_1 > 1.570796" in found.message
    # with the digits of the time that the tolerance gives
    assert found.message[:letters] == truth.message[:letters]
    assert found.t[-1] == pytest.approx(truth.t[-1], abs=2e-9)
    assert found.gamma[-1, 0] == pytest.approx(np.pi / 2, abs=within)
    assert np.all(found.gamma <= np.pi / 2)
    few = simulate(EXAMPLE2, (5.0, 0.0, 0.0), duration, t_eval=[0.1, 0.2, duration])
    assert few.t == pytest.approx([0.1, 0.2, found.t[-1]], abs=1e-9)


def test_another_start():
    gamma = [0.5, 0.6, 0.7]
    for initial in (
        (gamma, np.zeros(3)),
        {"gamma": gamma},
        {"gamma": gamma, "orientation": None},
    ):
        found = simulate(EXAMPLE2, duration=0.01, initial=initial)
        np.testing.assert_allclose(found.gamma[0], gamma, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"scene": "swin"}, "one of [^(]*did you mean 'swing'"),
        (
            {"scene": "nowhere/swing.yaml"},
            "(?s)swing.yaml': .*[(]No such file or directory[)]",
        ),
        ({"scene": 3}, "must be a Scene"),
        ({"torque": 1.0}, "three finite numbers"),
        ({"torque": (1.0, float("nan"), 0.0)}, "three finite numbers"),
        ({"torque": ("1", "2", "3")}, "three finite numbers"),
        ({"torque": lambda: None}, r"f\(t\) or f\(t, state\)"),
        ({"torque": lambda t: (t, t)}, "three finite numbers"),
        ({"duration": -1.0}, "duration(.|\n)*from 1e-9"),
        ({"duration": float("inf")}, "duration(.|\n)*from 1e-9"),
        ({"t_eval": [0.2, 0.1]}, "ascending"),
        ({"t_eval": [0.1, 3.0]}, "ascending"),
        ({"samples": 0}, "samples = 0: must be a whole number from 1 to 10000000"),
        (
            {"samples": 10**5000},
            "samples(.|\n)*an integer of 5001 digits: must be a whole number",
        ),
        ({"samples": True}, "samples = True: must be a whole number"),
        ({"samples": 3, "t_eval": [0.1]}, "samples = 3: must be None where t_eval"),
        ({"method": "euler"}, "must be one of auto, rk4, dopri5, dop853, rodas5p"),
        ({"method": "gauss"}, "has left: auto and dop853 are as accurate"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"control_period": 0.001}, "control_period(.|\n)*is for a function"),
        (
            {"initial": {"gama": 1}},
            r"gama = 1: unknown key(.|\n)*gamma = None: is missing",
        ),
        (
            {"torque": lambda t, state: None, "duration": 0.1},
            r"torque\(0\) = None: must be three",
        ),
        ({"duration": None}, r"duration(.|\n)*must be given"),
        (
            {"torque": jerk, "control_period": 1e-9},
            "period = 1e-09: must be at least .* s",
        ),
        ({"breaks": [0.2, 0.1]}, "breaks(.|\n)*ascending"),
        (
            {"initial": {"gamma": [0.8] * 3, "orientation": [0, 0, 0, 0]}},
            "not all zero",
        ),
        (
            {"initial": {"orientation": [0, 0, 0, 0]}},
            "gamma(.|\n)*is missing(.|\n)*not all zero",
        ),
        (
            {"initial": {"gamma": [0.8] * 3, "orientation": [1e-200] * 4}},
            "not all zero",
        ),
        ({"torque": lambda state, t: (0.0, 0.0, 0.0)}, "f.t, state., in this order"),
        ({"breaks": "x"}, "breaks = 'x': must be numbers"),
        ({"max_step": 0.0}, "max_step(.|\n)*> 0"),
        ({"max_step": float("nan")}, "max_step(.|\n)*> 0"),
        ({"max_step": "1"}, "max_step = '1': must be a number"),
    ],
)
def test_bad_input_is_refused(arguments, said):
    with pytest.raises(InputError, match=said):
        simulate(
            **{"scene": replace(EXAMPLE2, duration=None), "duration": 0.01, **arguments}
        )


@pytest.mark.parametrize("method", ["auto", "dopri5", "dop853", "rodas5p"])
def test_a_state_feedback_is_part_of_the_differential_equation(method):
    """The reference is SciPy's DOP853 at 1e-13 on the derivative of the scene."""
    dynamics = Dynamics.of(EXAMPLE2)
    start = Simulation(EXAMPLE2).state

    def slope(t, y):
        j = dynamics.joints(*y)
        torque = [-4.0 * (j[k] - 0.8) - 0.1 * j[9 + k] - t for k in range(3)]
        return dynamics.derivative(*y, *torque)

    y = [*start.quaternion, *start.body_rate]
    expected = solve_ivp(slope, (0.0, 0.3), y, "DOP853", rtol=1e-13, atol=1e-14).y[
        :, -1
    ]
    found = simulate(
        EXAMPLE2, spring, 0.3, method=method, t_eval=[0.0, 0.3], tolerance=1e-10
    )
    assert found.success, found.message
    assert np.abs(found.quaternion[-1] - expected[:4]).max() < 1e-10
    assert np.abs(found.body_rate[-1] - expected[4:]).max() < 1e-9
    assert found.error_estimate <= 1e-10
    assert abs(found.energy_residual) < 1e-9
    assert found.evaluations > 10
    for k in range(2):
        seen = SimpleNamespace(gamma=found.gamma[k], gamma_dot=found.gamma_dot[k])
        assert found.torque[k].tolist() == spring(
            found.t[k], SimpleNamespace(joints=seen)
        )
    np.testing.assert_allclose(
        found.at(0.15).gamma[0],
        simulate(EXAMPLE2, spring, 0.15, tolerance=1e-11).gamma[-1],
        atol=1e-10,
    )


def test_held_feedback_tends_to_continuous_one_with_the_period():
    continuous = simulate(EXAMPLE2, spring, 0.2).gamma[-1]
    apart = [
        np.abs(
            simulate(EXAMPLE2, spring, 0.2, control_period=h).gamma[-1] - continuous
        ).max()
        for h in (4e-3, 2e-3, 1e-3)
    ]
    assert apart[2] > 1e-6
    assert 1.9 < apart[0] / apart[1] < 2.1
    assert 1.9 < apart[1] / apart[2] < 2.1


def test_a_feedback_has_the_limit_and_the_lag_of_the_actuators():
    limited = EXAMPLE2.with_values({"actuators.torque_limit": 0.125})
    assert np.abs(simulate(limited, spring, 0.2).torque).max() == 0.125
    lagging = EXAMPLE2.with_values({"actuators.time_constant": 0.01})
    seen = []
    found = simulate(
        lagging, lambda t, state: seen.append(state.torque) or (1.0, 0.0, 0.0), 0.1
    )
    assert found.torque[0].tolist() == [0.0] * 3
    np.testing.assert_allclose(
        found.torque[-1], [1.0 - np.exp(-10.0), 0.0, 0.0], atol=1e-9
    )
    assert max(torque[0] for torque in seen) > 0.9


@pytest.mark.parametrize(
    ("scene", "method", "torque"),
    [
        ("swing", "auto", None),
        ("example2_heavy", "rk4", None),
        pytest.param(
            *("gravity_payload", "auto", lambda t: (0.3 * t, -0.1, 0.2)),
            marks=pytest.mark.slow,
        ),
        (
            "example2_heavy",
            "dopri5",
            lambda t, state: [2.0 - rate for rate in state.joints.gamma_dot],
        ),
    ],
)
def test_machine_code_gives_the_bits_of_plain_python(scene, method, torque):
    pytest.importorskip("llvmlite", reason="needs llvmlite: pip install .[fast]")
    how = {"duration": 0.6, "method": method, "tolerance": 1e-9}
    found = simulate(scene, torque, **how)
    with without_llvmlite():
        plain = simulate(scene, torque, **how)
    assert found.quaternion.tobytes() == plain.quaternion.tobytes()
    assert found.gamma_dot.tobytes() == plain.gamma_dot.tobytes()
    told = ("error_estimate", "evaluations", "method", "energy_residual", "step")
    assert [getattr(found, name) for name in told] == [
        getattr(plain, name) for name in told
    ]


def test_a_motion_that_its_budget_will_not_finish_is_said_early():
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        with pytest.raises(
            RuntimeWarning, match=r"swing: 100,.* % of the motion; it stops at 50,0"
        ):
            simulate("swing", duration=1e6, t_eval=[1e6])
