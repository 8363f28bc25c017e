# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sst_ros import Simulation, load_scene, simulate
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics, compile_program
from sst_ros.errors import InputError, RunStopped
from sst_ros.integration.batch import Batch
from sst_ros.integration.batch_source import SIMD_WIDTH
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE
from sst_ros.scene.scene import Actuators, Initial, Moment
from sst_ros.state import QUANTITIES

pytest.importorskip("numba", reason="a batch needs numba")

EXAMPLE2 = load_scene("example2_heavy")
N = 100


@pytest.fixture(scope="module")
def batch():
    return Batch(EXAMPLE2, profile=True)


@pytest.fixture(scope="module")
def gamma():
    starts = np.random.default_rng(5).uniform(0.6, 1.0, (N, 3))
    starts[7] = (0.05, 0.05, 1.5)  # no admissible assembly
    return starts


@pytest.fixture(scope="module")
def result(batch, gamma):
    return batch.run(gamma, (0.0, 0.0, 0.0), step=0.01, count=100, keep_every=25, threads=3)


def single(gamma):
    simulation = Simulation(replace(EXAMPLE2, initial=Initial(gamma=tuple(gamma))), "dop853")
    torque = EXAMPLE2.torque.at
    try:
        for _ in range(100):
            simulation.step(torque, 10_000_000)
    except RunStopped as stopped:
        return simulation.state, stopped
    return simulation.state, None


@pytest.mark.parametrize("n", [0, 1, 2, 3, 4, 5])
def test_a_scenario_equals_a_run_of_its_own(result, gamma, n):
    state, stopped = single(gamma[n])
    sign = np.sign(result.quaternion[n] @ state.quaternion)
    np.testing.assert_allclose(sign * result.quaternion[n], state.quaternion, atol=1e-10)
    np.testing.assert_allclose(result.body_rate[n], state.body_rate, atol=1e-9)
    assert result.message[n] == ("reached the end" if stopped is None else stopped.reason)
    if stopped is not None:
        assert abs(result.fault_time[n] - stopped.time) < 1e-9


def test_faults_stay_with_their_scenario(result):
    assert result.message[7] == "no unique admissible assembly"
    assert 0 < np.count_nonzero(result.status) < N
    assert np.all(np.isfinite(result.quaternion))
    assert np.all(np.isfinite(result.body_rate))
    assert result.status[7] == -1
    assert np.array_equal(np.isfinite(result.fault_time), result.status != 0)


def test_threads_change_no_bit(batch, gamma, result):
    again = batch.run(gamma, (0.0, 0.0, 0.0), step=0.01, count=100, threads=1)
    assert np.array_equal(again.quaternion, result.quaternion)
    assert np.array_equal(again.body_rate, result.body_rate)
    assert again.message == result.message


@pytest.mark.parametrize("method", [pytest.param(DORMAND_PRINCE, marks=pytest.mark.slow), DOP853])
def test_a_scenario_has_the_bits_of_steps_of_its_own(batch, gamma, method):
    """SIMD, blocks and slices of time change none: the same operations in the same order."""
    if method is not DOP853:
        batch = Batch(EXAMPLE2, method, profile=True)
    inside = gamma[8 : 8 + SIMD_WIDTH + 5]
    found = batch.run(inside, (0.0, 0.0, 0.0), step=2e-3, count=60)
    free = ~np.isfinite(found.fault_time)
    assert free.sum() > SIMD_WIDTH
    start, _ = batch.start(inside, (0.0, 0.0, 0.0))
    machine = CompiledMethod(ODE(Dynamics.of(EXAMPLE2), EXAMPLE2.torque), method, compiled=False)
    for n in np.flatnonzero(free):
        alone = machine.step_fixed(0.0, 2e-3, 60, start[:, n].tolist(), [])
        assert alone == [*found.quaternion[n], *found.body_rate[n]]


@pytest.mark.slow
def test_rest_at_an_end_of_the_stroke_is_no_fault():
    """Rounding puts gamma_3 below 0 by 5e-16 rad; `Simulation` stays at rest there."""
    found = Batch(EXAMPLE2).run([(0.0,) * 3, (0.7, 0.7, 0.0)], (0.0,) * 3, step=1e-3, count=10)
    assert found.success.all(), found.message
    pushed = Batch(EXAMPLE2).run(
        [(0.0, 0.5, 0.5)], (0.0,) * 3, (-1.0, 0.0, 0.0), step=1e-3, count=1
    )
    assert pushed.message == ("gamma_1 < 0",)


def test_trajectories_are_kept_when_asked_for(result, gamma):
    assert result.kept.quaternion.shape == (5, N, 4)
    assert np.array_equal(result.kept.quaternion[-1], result.quaternion)
    assert np.array_equal(result.kept.gamma[-1], result.gamma, equal_nan=True)
    assert np.all(np.isfinite(result.kept.body_rate))


def test_its_local_error_is_told_and_small(result):
    started = result.status >= 0
    assert np.all(result.local_error[started] < 1e-9)
    assert np.all(result.local_error[started] > 0.0)


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ({"step": 0.0, "count": 1}, "step = 0.0: must be finite and > 0"),
        ({"step": np.nan, "count": 1}, "step = nan: must be finite and > 0"),
        ({"step": 0.01, "count": -1}, "count = -1: must be >= 0"),
        ({"step": 0.01, "count": 1, "threads": -1}, "threads = -1: must be >= 0"),
    ],
)
def test_bad_steps_are_refused_by_name(batch, gamma, argument, said):
    with pytest.raises(InputError, match=said):
        batch.run(gamma, (0, 0, 0), **argument)


def test_torques_are_no_moments_where_a_profile_takes_their_place():
    scene = replace(EXAMPLE2, moment=Moment(topic=True))
    assert not Batch(scene, profile=True).drives((1.0, 2.0, 3.0), 2).any()


def test_a_profile_that_actuators_would_clamp_is_refused():
    scene = replace(EXAMPLE2, actuators=Actuators(torque_limit=4.5))
    with pytest.raises(InputError, match=r"actuators.torque_limit = 4.5: must not be less than"):
        Batch(scene, profile=True)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (((np.zeros((2, 2))), (0, 0, 0)), r"gamma = \(2, 2\): must have the shape"),
        ((np.full((2, 3), np.nan), (0, 0, 0)), "(?s)gamma = .*must be finite"),
        ((np.full((2, 3), 0.8), np.zeros((3, 3))), r"gamma_dot = \(3, 3\): must have the shape"),
    ],
)
def test_bad_arguments_are_refused_by_name(batch, arguments, said):
    with pytest.raises(InputError, match=said):
        batch.run(*arguments, step=0.01, count=1)


def test_scenes_that_a_batch_cannot_run_are_refused():
    with pytest.raises(InputError, match="torque = None: must be given"):
        Batch(load_scene("stiff"), profile=True)


def test_a_start_outside_the_stroke_is_a_fault_of_its_scenario(interpreted):
    """Where a simulation refuses it: between gamma_1 = -0.01 and 0 there is an assembly."""
    outside = np.array([[0.8, 0.8, 0.8], [-0.01, 0.5, 0.6], [0.8, 0.8, 1.6]])
    for gamma in outside[1:]:
        with pytest.raises(InputError, match="must lie in the stroke"):
            Simulation(replace(EXAMPLE2, initial=Initial(gamma=tuple(gamma))))
    batch = Batch(EXAMPLE2, profile=True)
    found = batch.run(outside, (0.0, 0.0, 0.0), step=0.01, count=1)
    assert found.message == ("reached the end", *("initial gamma outside the stroke",) * 2)
    assert found.fault_time[1:].tolist() == [0.0, 0.0]
    free = replace(EXAMPLE2, stroke=replace(EXAMPLE2.stroke, at_end="ignore"))
    assert "stroke" not in "".join(
        Batch(free, profile=True).run(outside, (0.0, 0.0, 0.0), step=1e-3, count=1).message
    )


LAGGING = {
    **{f"actuators.{key}": value for key, value in {"time_constant": 0.02}.items()},
    "payload.mass": 0.3,
    "payload.centre": [0.0, 0.0, 0.2],
    "gravity.acceleration": [0.0, 0.0, -9.81],
}


ELASTIC = {"stroke.at_end": "elastic", "stroke.stiffness": 100.0}


@pytest.mark.parametrize("changes", [{}, LAGGING, ELASTIC])
def test_the_result_has_the_quantities_of_simulate(changes, interpreted):
    """Scenario by scenario, with another inertia and amplitude in each."""
    scene = EXAMPLE2.with_values({"duration": 0.1, **changes})
    parameters = {"star.inertia.zz": [0.25, 0.3], "torque.amplitude": [[1, 2, 3], [2, 0.1, 1]]}
    batch = Batch(scene, profile=True, parameters=parameters)
    found = batch.run(scene.initial.gamma, (0, 0, 0), step=1e-3, count=100, keep_every=50)
    assert found.success.all()
    assert set(found.message) == {"reached the end"}
    for row in range(2):
        motion = simulate(batch.scenario(row), t_eval=[0.0, 0.05, 0.1], tolerance=1e-10)
        for name in (*QUANTITIES, "energy"):
            expected, kept = getattr(motion, name), getattr(found.kept, name)[:, row]
            np.testing.assert_allclose(kept, expected, atol=2e-8, err_msg=name)
            assert np.array_equal(getattr(found, name)[row], kept[-1])
    np.testing.assert_allclose(found.kept.t, [[0.0] * 2, [0.05] * 2, [0.1] * 2], rtol=1e-15)


def test_a_limit_passed_inside_a_step_ends_a_run_as_in_a_simulation():
    """The actuator turns near its end in the first of two steps, which end inside again."""
    scene = replace(EXAMPLE2, torque=None)
    depth = np.random.default_rng(5).uniform(3.2e-3, 4.8e-3, N)
    depth[depth > 4e-3] += 1.2e-3  # the turning point is 5e-3 rad on
    gamma = np.array([np.pi / 2, 1.0, 1.0]) - np.multiply.outer(depth, [1.0, 0.0, 0.0])
    rate, torque = np.tile([0.3, 0.0, 0.0], (N, 1)), np.tile([-3.0, 0.0, 0.0], (N, 1))
    found = Batch(scene).run(gamma, rate, torque, step=0.06, count=2)
    ended = 0
    for n in range(0, N, 4):
        initial = Initial(gamma=tuple(gamma[n]), gamma_dot=tuple(rate[n]))
        simulation = Simulation(replace(scene, initial=initial), "dop853")
        try:
            simulation.step(tuple(torque[n]), 120_000_000)
        except RunStopped as stopped:
            ended += 1
            assert found.message[n] == stopped.reason
            assert found.fault_time[n] == pytest.approx(stopped.time, abs=1e-6)
        else:
            assert found.message[n] == "reached the end"
    assert 0.2 * N < 4 * ended < 0.8 * N


def test_rates_of_distances_are_their_slopes_over_time(batch):
    program, state = compile_program(batch.limit_distances), [0.1, -0.2, 0.3, 0.9, 0.5, -0.4, 0.7]
    x, y, z, w, *rate = np.divide(state, [*[np.linalg.norm(state[:4])] * 4, 1.0, 1.0, 1.0])
    turned = Rotation.from_quat([x, y, z, w])
    ends = [
        program(*(turned * Rotation.from_rotvec(np.multiply(h, rate))).as_quat(), *rate)
        for h in (-1e-5, 1e-5)
    ]
    count = len(ends[0]) // 2
    slopes = np.subtract(ends[1], ends[0])[:count] / 2e-5
    np.testing.assert_allclose(program(x, y, z, w, *rate)[count:], slopes, atol=1e-9)


def test_a_scenario_that_ends_early_has_the_time_of_its_last_state(result, gamma):
    row = int(np.flatnonzero(result.status == 1)[0])
    scene = replace(EXAMPLE2, initial=Initial(gamma=tuple(gamma[row])))
    assert 0.0 < result.fault_time[row] - result.t[row] <= 0.01
    alone = simulate(scene, t_eval=[result.t[row]], duration=1.0)
    np.testing.assert_allclose(result.gamma[row], alone.gamma[0], atol=1e-9)
    np.testing.assert_allclose(result.torque[row], alone.torque[0], atol=1e-12)
    assert np.all(np.isnan(result.gamma[7]))


def test_tables_have_units_and_a_row_a_scenario(result):
    pytest.importorskip("pandas", reason="tables need pandas")
    pytest.importorskip("xarray", reason="datasets need xarray")
    table, data = result.to_pandas(), result.to_xarray()
    assert len(table) == N
    assert table.attrs["units"]["gamma_1"] == "rad"
    assert np.array_equal(table["gamma_2"], result.gamma[:, 1], equal_nan=True)
    assert data["gamma"].dims == ("scenario", "leg")
    assert data["gamma"].attrs["units"] == "rad"
    assert data["message"].values.tolist() == list(result.message)
    assert float((data["status"] == 1).mean()) == np.mean(result.status == 1)
    kept = result.kept.to_xarray()
    assert kept["beta"].dims == ("time", "scenario", "leg")
    assert np.array_equal(kept["beta"].sel(leg=3), result.kept.beta[..., 2], equal_nan=True)
