# SPDX-License-Identifier: Apache-2.0
"""prepare(): runs again and again, by threads at once, with arrays that nobody can change."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from sst_ros import InputError, TorqueTable, Trajectory, load_scene, prepare, simulate

ARRAYS = ("t", "quaternion", "body_rate", "torque", "gamma")
RUNS = {
    "collocation": {"scene": "example2_heavy"},
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
def test_a_prepared_run_is_simulate_each_time(arguments):
    run, expected = prepare(**arguments), simulate(**arguments)
    for _ in range(3):
        found = run.run()
        for name in ARRAYS:
            assert getattr(found, name).tobytes() == getattr(expected, name).tobytes()
        assert found.error_estimate == expected.error_estimate


@pytest.mark.parametrize("arguments", RUNS.values(), ids=RUNS)
def test_threads_get_their_own_motions(arguments):
    run = prepare(**arguments)
    one = run.run()
    times = [np.sort(np.random.default_rng(k).uniform(0.0, one.t[-1], 20)) for k in range(8)]
    expected = [one.at(t).quaternion for t in times]
    with ThreadPoolExecutor(8) as pool:
        for _ in range(3):
            at = list(pool.map(lambda t: one.at(t).quaternion, times))
            again = list(pool.map(lambda _: run.run().quaternion, times))
            for found, wanted in zip(at, expected, strict=True):
                assert found.tobytes() == wanted.tobytes()
            for found in again:
                assert found.tobytes() == one.quaternion.tobytes()


@pytest.mark.parametrize("name", ARRAYS[:4])
def test_arrays_are_read_only(name):
    found = simulate("example2_heavy")
    with pytest.raises(ValueError, match="read-only"):
        getattr(found, name)[0] *= 1000.0
    with pytest.raises(ValueError, match="read-only"):
        getattr(found.at([0.1, 0.2]), name)[0] *= 1000.0


def test_what_is_given_to_a_trajectory_can_change_without_it():
    t, q = np.array([0.0, 1.0]), np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
    found = Trajectory(load_scene("example2"), t, q, np.zeros((2, 3)), np.zeros((2, 3)))
    t *= 5.0
    q[:] = 7.0
    assert found.t.tolist() == [0.0, 1.0]
    assert found.quaternion.max() == 1.0


@pytest.mark.parametrize("times", [[0.0, 1.0, 0.5], [0.0, 0.0], [1.0, 0.0]])
def test_times_that_do_not_ascend_are_refused(times):
    n = len(times)
    q = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    with pytest.raises(InputError, match=r"t = (.|\n)*ascending"):
        Trajectory(load_scene("example2"), times, q, np.zeros((n, 3)), np.zeros((n, 3)))


@pytest.mark.parametrize("torque", [lambda t: (t, 0.0, 0.1), lambda t, state: (t, 0.0, 0.1)])
def test_a_loaded_run_under_a_function_has_no_motion_between_its_samples(torque, tmp_path):
    pytest.importorskip("pyarrow", reason="files need pyarrow")
    run = simulate("example2", torque, 0.2, t_eval=[0.0, 0.1, 0.2])
    run.save(tmp_path / "run.parquet")
    again = Trajectory.load(tmp_path / "run.parquet")
    assert again.at([0.1]).quaternion.tobytes() == run.quaternion[1:2].tobytes()
    with pytest.raises(InputError, match=r"not in the file"):
        again.at(0.05)
    assert "<table>" in again._repr_html_()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"breaks": [0.2, 0.1]}, "breaks(.|\n)*ascending"),
        ({"breaks": "x"}, "breaks(.|\n)*ascending"),
        ({"max_step": 0.0}, "max_step(.|\n)*> 0"),
        ({"max_step": float("nan")}, "max_step(.|\n)*> 0"),
        ({"max_step": "1"}, "max_step(.|\n)*> 0"),
        ({"method": "gauss", "max_step": 0.1}, "no max_step"),
    ],
)
def test_bad_options_are_refused(arguments, said):
    with pytest.raises(InputError, match=said):
        prepare("example2_heavy", **arguments)


@pytest.mark.parametrize("dt", [0.001, float("nan"), True, "1", None, 0, -5])
def test_a_step_takes_whole_nanoseconds(dt):
    from sst_ros import Simulation

    with pytest.raises(InputError, match=r"dt_ns = (.|\n)*whole nanoseconds"):
        Simulation("example2").step((0.0, 0.0, 0.0), dt)


@pytest.mark.parametrize("count", [-1, 0, float("nan"), 1.5, True])
def test_a_number_of_steps_is_a_whole_number(count):
    from sst_ros import Simulation

    with pytest.raises(InputError, match=r"count = (.|\n)*whole number"):
        Simulation("example2").steps((0.0, 0.0, 0.0), 1000, count)


def test_numpy_integers_do_not_overflow():
    from sst_ros import Simulation

    one, other = Simulation("example2"), Simulation("example2")
    one.steps((0.0, 0.0, 0.0), np.int32(2_000_000), np.int8(100))
    other.steps((0.0, 0.0, 0.0), 2_000_000, 100)
    assert one.time_ns == other.time_ns == 200_000_000
    assert one.state == other.state
