# SPDX-License-Identifier: Apache-2.0
"""Batches: every scenario is a run of its own, on any threads.

What they keep, tell and refuse.
"""

import copy
import signal
import subprocess
import sys
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from loaded_scenes import REST
from models import seeded_samples
from scipy.spatial.transform import Rotation
from slow_cases import slow_after

from sst_ros import Simulation, load_scene, simulate
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.errors import AssemblyError, InputError, RunStopped
from sst_ros.integration.batch import Batch
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE
from sst_ros.integration.point import Drive
from sst_ros.programs.expression import compile_program
from sst_ros.programs.llvm import LANES
from sst_ros.scene.loads import Initial, Moment
from sst_ros.state import QUANTITIES

EXAMPLE2 = load_scene("example2_heavy")
N = 100
MANY = 4 * LANES
FEW = MANY + 5
TENSOR = ("xx", "yy", "zz", "xy", "xz", "yz")


class Rows(NamedTuple):
    """A batch, where its scenarios start, and what becomes of them.

    None drives by the profile.
    """

    batch: Batch
    gamma: np.ndarray
    gamma_dot: np.ndarray
    torque: np.ndarray | None
    step: float
    result: Any

    def run(self, **options):
        more = () if self.torque is None else (self.torque,)
        return self.batch.run(
            self.gamma, self.gamma_dot, *more, step=self.step, count=100, **options
        )


@pytest.fixture(scope="module")
def swarm():
    """Example 2 from many starts under its torques."""
    gamma = np.random.default_rng(5).uniform(0.6, 1.0, (N, 3))
    gamma[7] = (0.05, 0.05, 1.5)  # no admissible assembly
    rows = Rows(
        Batch(EXAMPLE2, profile=True), gamma, np.zeros((N, 3)), None, 0.01, None
    )
    return rows._replace(result=rows.run(keep_every=25, threads=3))


@pytest.fixture(scope="module")
def samples():
    inside = [
        one
        for one in seeded_samples(7, 2 * FEW)
        if np.all((one.gamma > 0.0) & (one.gamma < one.geometry.arc))
    ]
    assert len(inside) > FEW
    return inside[:FEW]


@pytest.fixture(scope="module")
def manipulators(samples):
    """Random base triangles, stars and inertias: all numbers differ."""
    scenes = [one.scene for one in samples]
    parameters = {
        "base.v": [scene.base.v for scene in scenes],
        "star.alpha_deg": [scene.star.alpha_deg for scene in scenes],
    }
    bodies = {"star": [scene.star for scene in scenes]}
    for links in ("actuated_links", "intermediate_links"):
        for k in range(3):
            bodies[f"{links}[{k}]"] = [getattr(scene, links)[k] for scene in scenes]
    for name, rows in bodies.items():
        for key in TENSOR:
            parameters[f"{name}.inertia.{key}"] = [
                getattr(one.inertia, key) for one in rows
            ]
    gamma, gamma_dot, torque = (
        np.array([getattr(one, name) for one in samples])
        for name in ("gamma", "gamma_dot", "torque")
    )
    batch = Batch(scenes[0], DORMAND_PRINCE, parameters=parameters)
    rows = Rows(batch, gamma, 0.5 * gamma_dot, 0.1 * torque, 2e-3, None)
    return rows._replace(result=rows.run(threads=3))


@pytest.fixture(params=["swarm", pytest.param("manipulators", marks=pytest.mark.slow)])
def rows(request):
    return request.getfixturevalue(request.param)


@pytest.mark.slow
def test_a_row_is_the_scene_with_these_numbers(manipulators, samples):
    found = [manipulators.batch.scenario(n) for n in range(FEW)]
    assert found == [one.scene for one in samples]


def alone(scene, gamma, gamma_dot, torque, tick_ns, count):
    """A run by variable steps of a simulation of its own, and what ended it."""
    initial = Initial(gamma=tuple(gamma), gamma_dot=tuple(gamma_dot))
    try:
        simulation = Simulation(replace(scene, initial=initial), "dop853")
        simulation.steps(torque, tick_ns, count)
    except AssemblyError:
        return None, "no unique admissible assembly", 0.0
    except RunStopped as stopped:
        return simulation.state, stopped.reason, stopped.time
    return simulation.state, "reached the end", None


def test_programs_are_shared_where_all_that_is_fixed_is_equal():
    zz = EXAMPLE2.star.inertia.zz
    varied = {"star.inertia.zz": [zz, 1.1 * zz]}
    batch = Batch(EXAMPLE2, parameters=varied)
    again = load_scene("example2_heavy")
    more = {"star.inertia.zz": [1.2 * zz, 0.9 * zz, zz]}
    assert Batch(again, parameters=more).programs is batch.programs
    assert copy.deepcopy(batch).programs is batch.programs
    others = [
        Batch(EXAMPLE2, DORMAND_PRINCE, parameters=varied),
        Batch(EXAMPLE2, profile=True, parameters=varied),
        Batch(EXAMPLE2, parameters={**varied, "star.inertia.yy": [zz, 1.1 * zz]}),
        Batch(EXAMPLE2.with_values({"star.inertia.xx": 1.1 * zz}), parameters=varied),
        Batch(EXAMPLE2.with_values({"stroke.at_end": "ignore"}), parameters=varied),
        Batch(load_scene("gravity_payload"), parameters=varied),
    ]
    assert batch.programs not in [other.programs for other in others]


@pytest.mark.parametrize("n", [*range(0, FEW, 2), 7])
def test_a_scenario_equals_a_run_of_its_own(rows, n):
    torque = EXAMPLE2.torque.at if rows.torque is None else tuple(rows.torque[n])
    tick_ns, scene = round(rows.step * 1e9), rows.batch.scenario(n)
    state, reason, time = alone(
        scene, rows.gamma[n], rows.gamma_dot[n], torque, tick_ns, 100
    )
    result, bound = rows.result, 1e-10 if rows.torque is None else 1e-9
    assert result.message[n] == reason
    if state is not None:
        sign = np.sign(result.quaternion[n] @ state.quaternion)
        np.testing.assert_allclose(
            sign * result.quaternion[n], state.quaternion, atol=bound
        )
        np.testing.assert_allclose(
            result.body_rate[n], state.body_rate, atol=10.0 * bound
        )
    if time is not None:
        assert abs(result.fault_time[n] - time) < 10.0 * bound


def test_faults_stay_with_their_scenario(rows):
    """What is told is what a run of its own says, see above.

    here: of different ends.
    """
    result = rows.result
    told = {result.message[n] for n in np.flatnonzero(~result.success)}
    assert 0 < np.count_nonzero(result.status) < len(result.status)
    assert len({text for text in told if ">" in text or "<" in text}) > 1
    assert np.all(np.isfinite(result.quaternion))
    assert np.all(np.isfinite(result.body_rate))
    assert np.array_equal(np.isfinite(result.fault_time), result.status != 0)


def test_threads_change_no_bit(rows):
    again = rows.run(threads=1)
    assert np.array_equal(again.quaternion, rows.result.quaternion)
    assert np.array_equal(again.body_rate, rows.result.body_rate)
    assert again.message == rows.result.message


def test_a_scenario_has_the_bits_of_steps_of_its_own(rows):
    """Lanes, blocks and slices of time change none: the same operations in the same
    order.
    """
    batch, result = rows.batch, rows.result
    y, _ = batch.initial(rows.gamma, rows.gamma_dot)
    done = np.flatnonzero(result.success)[: MANY + 1].tolist()
    assert len(done) > (MANY if rows.torque is None else 4)
    for n in done:
        scene, torque, method, drive = batch.scenario(n), EXAMPLE2.torque, DOP853, []
        if rows.torque is not None:
            torque, method, drive = None, DORMAND_PRINCE, rows.torque[n].tolist()
        machine = MethodSteps(ODE(Dynamics.of(scene), torque), method)
        ended = machine.fixed(
            0.0, rows.step, 100, y[:, n].tolist(), Drive(tuple(drive))
        )
        assert ended == [*result.quaternion[n], *result.body_rate[n]]


def test_numpy_has_the_bits_of_machine_code(rows, without_machine_code):
    without_machine_code()
    plain = rows._replace(batch=copy.copy(rows.batch))
    plain.batch.__dict__.pop("programs", None)
    found = plain.run(threads=1)
    assert np.array_equal(found.quaternion, rows.result.quaternion)
    assert np.array_equal(found.body_rate, rows.result.body_rate)
    assert np.array_equal(found.code, rows.result.code)
    assert np.array_equal(found.fault_time, rows.result.fault_time, equal_nan=True)


LONG_RUN = """
import signal, sys, threading
from sst_ros import Batch, load_scene
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
batch = Batch(load_scene("swing"))
batch.programs
begun = threading.Timer(0.5, lambda: print("runs", flush=True))
begun.start()
rest = 0.0, 0.0, 0.0
many = [(0.8, 0.8, 0.8)] * 20_000
batch.run(many, rest, step=1e-6, count=10**8, threads={threads})
"""


@pytest.mark.parametrize("threads", slow_after(1, [1, 2]))
def test_an_interrupt_ends_a_batch_at_once(threads):
    program = [sys.executable, "-c", LONG_RUN.format(threads=threads)]
    with subprocess.Popen(
        program, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as run:
        try:
            assert run.stdout.readline() == b"runs\n"
            run.send_signal(signal.SIGINT)
            # Without the signal the run would take hours.
            _, said = run.communicate(timeout=20)
        finally:
            run.kill()
    assert b"KeyboardInterrupt" in said


@pytest.mark.slow
def test_a_batch_needs_no_numba():
    program = """
import sys
sys.modules["numba"] = None
from sst_ros import Batch
batch = Batch("example2_heavy")
batch.run((0.8, 0.8, 0.8), (0.0, 0.0, 0.0), step=1e-3, count=3)
"""
    program = program.replace("(0.8, 0.8, 0.8), (0.0", "[(0.8, 0.8, 0.8)], (0.0")
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_rest_at_an_end_of_the_stroke_is_no_fault():
    """Rounding puts gamma_3 below 0 by 5e-16 rad; `Simulation` stays at rest there."""
    batch = Batch(EXAMPLE2)
    found = batch.run([(0.0,) * 3, (0.7, 0.7, 0.0)], REST, step=1e-3, count=10)
    assert found.success.all(), found.message
    pushed = batch.run([(0.0, 0.5, 0.5)], REST, (-1.0, 0.0, 0.0), step=1e-3, count=1)
    assert pushed.message == ("gamma_1 < 0",)


def test_its_local_error_is_told_and_small(swarm):
    result = swarm.result
    started = result.status >= 0
    assert np.flatnonzero(~started).tolist() == [7]
    assert np.all(result.local_error[started] < 1e-9)
    assert np.all(result.local_error[started] > 0.0)


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ({"step": 0.0}, "step = 0.0: must be finite and > 0"),
        ({"step": np.nan}, "step = nan: must be finite and > 0"),
        ({"count": -1}, "count = -1: must be >= 0"),
        ({"threads": -1}, "threads = -1: must be >= 0"),
        ({"gamma": np.zeros((2, 2))}, r"gamma = \(2, 2\): must have the shape"),
        ({"gamma": np.full((2, 3), np.nan)}, "(?s)gamma = .*must be finite"),
        ({"gamma_dot": np.zeros((3, 3))}, r"gamma_dot = \(3, 3\): must have the shape"),
    ],
)
def test_bad_arguments_are_refused_by_name(swarm, argument, said):
    right = {"gamma": np.full((2, 3), 0.8), "gamma_dot": REST, "step": 0.01, "count": 1}
    with pytest.raises(InputError, match=said):
        swarm.batch.run(**right | argument)


def test_torques_in_the_place_of_a_profile_are_no_moments():
    scene = replace(EXAMPLE2, moment=Moment(topic=True))
    assert not Batch(scene, profile=True).drives((1.0, 2.0, 3.0), 2).any()


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        (
            EXAMPLE2.with_values({"actuators.torque_limit": 4.5}),
            "limit = 4.5: must not be less",
        ),
        (load_scene("stiff"), "torque = None: must be given"),
    ],
)
def test_profiles_that_a_batch_cannot_follow_are_refused(scene, said):
    with pytest.raises(InputError, match=said):
        Batch(scene, profile=True)


def test_a_start_outside_the_stroke_is_a_fault_of_its_scenario():
    """Where a simulation refuses it: between gamma_1 = -0.01 and 0 there is an
    assembly.
    """
    outside = np.array([[0.8, 0.8, 0.8], [-0.01, 0.5, 0.6], [0.8, 0.8, 1.6]])
    for gamma in outside[1:]:
        with pytest.raises(InputError, match="must lie in the stroke"):
            Simulation(replace(EXAMPLE2, initial=Initial(gamma=tuple(gamma))))
    batch = Batch(EXAMPLE2, profile=True)
    found = batch.run(outside, REST, step=0.01, count=1)
    assert found.message == (
        "reached the end",
        *("initial gamma outside the stroke",) * 2,
    )
    assert found.fault_time[1:].tolist() == [0.0, 0.0]
    free = replace(EXAMPLE2, stroke=replace(EXAMPLE2.stroke, at_end="ignore"))
    assert "stroke" not in "".join(
        Batch(free, profile=True).run(outside, REST, step=1e-3, count=1).message
    )


LAGGING = {
    "actuators.time_constant": 0.02,
    "payload.mass": 0.3,
    "payload.centre": [0.0, 0.0, 0.2],
    "gravity.acceleration": [0.0, 0.0, -9.81],
}
ELASTIC = {"stroke.at_end": "elastic", "stroke.stiffness": 100.0}


@pytest.mark.parametrize("changes", slow_after(1, [{}, LAGGING, ELASTIC]))
def test_the_result_has_the_quantities_of_simulate(changes):
    """Scenario by scenario, with another inertia and amplitude in each."""
    scene = EXAMPLE2.with_values({"duration": 0.1, **changes})
    parameters = {
        "star.inertia.zz": [0.25, 0.3],
        "torque.amplitude": [[1, 2, 3], [2, 0.1, 1]],
    }
    batch = Batch(scene, profile=True, parameters=parameters)
    found = batch.run(
        scene.initial.gamma, (0, 0, 0), step=1e-3, count=100, keep_every=50
    )
    assert found.success.all()
    assert set(found.message) == {"reached the end"}
    for row in range(2):
        motion = simulate(batch.scenario(row), t_eval=[0.0, 0.05, 0.1], tolerance=1e-10)
        for name in (*QUANTITIES, "energy"):
            expected, kept = getattr(motion, name), getattr(found.kept, name)[:, row]
            np.testing.assert_allclose(kept, expected, atol=2e-8, err_msg=name)
            assert np.array_equal(getattr(found, name)[row], kept[-1])
    np.testing.assert_allclose(
        found.kept.t, [[0.0] * 2, [0.05] * 2, [0.1] * 2], rtol=1e-15
    )


def test_a_limit_passed_in_a_step_ends_a_run_as_in_a_simulation():
    """The actuator turns near its end in the first of two steps, which end inside
    again.
    """
    scene = replace(EXAMPLE2, torque=None)
    depth = np.random.default_rng(5).uniform(3.2e-3, 4.8e-3, N)
    depth[depth > 4e-3] += 1.2e-3  # the turning point is 5e-3 rad on
    gamma = np.array([np.pi / 2, 1.0, 1.0]) - np.multiply.outer(depth, [1.0, 0.0, 0.0])
    rate, torque = np.tile([0.3, 0.0, 0.0], (N, 1)), np.tile([-3.0, 0.0, 0.0], (N, 1))
    found = Batch(scene).run(gamma, rate, torque, step=0.06, count=2)
    ended = 0
    for n in range(0, N, 4):
        _, reason, time = alone(
            scene, gamma[n], rate[n], tuple(torque[n]), 120_000_000, 1
        )
        assert found.message[n] == reason
        if time is not None:
            ended += 1
            assert found.fault_time[n] == pytest.approx(time, abs=1e-6)
    assert 0.2 * N < 4 * ended < 0.8 * N


def test_rates_of_distances_are_their_slopes_over_time(swarm):
    program, state = (
        compile_program(swarm.batch.model.limit_distances),
        [0.1, -0.2, 0.3, 0.9, 0.5, -0.4, 0.7],
    )
    x, y, z, w, *rate = np.divide(
        state, [*[np.linalg.norm(state[:4])] * 4, 1.0, 1.0, 1.0]
    )
    turned = Rotation.from_quat([x, y, z, w])
    ends = [
        program(*(turned * Rotation.from_rotvec(np.multiply(h, rate))).as_quat(), *rate)
        for h in (-1e-5, 1e-5)
    ]
    count = len(ends[0]) // 2
    slopes = np.subtract(ends[1], ends[0])[:count] / 2e-5
    np.testing.assert_allclose(program(x, y, z, w, *rate)[count:], slopes, atol=1e-9)


def test_a_scenario_that_ends_early_has_its_last_states_time(swarm):
    result = swarm.result
    row = int(np.flatnonzero(result.status == 1)[0])
    scene = replace(EXAMPLE2, initial=Initial(gamma=tuple(swarm.gamma[row])))
    assert 0.0 < result.fault_time[row] - result.t[row] <= 0.01
    alone = simulate(scene, t_eval=[result.t[row]], duration=1.0)
    np.testing.assert_allclose(result.gamma[row], alone.gamma[0], atol=1e-9)
    np.testing.assert_allclose(result.torque[row], alone.torque[0], atol=1e-12)
    assert np.all(np.isnan(result.gamma[7]))


@pytest.mark.slow
def test_tables_have_units_and_a_row_a_scenario(swarm):
    result = swarm.result
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
    assert np.array_equal(
        kept["beta"].sel(leg=3), result.kept.beta[..., 2], equal_nan=True
    )
