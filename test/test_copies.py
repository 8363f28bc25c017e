# SPDX-License-Identifier: Apache-2.0
"""What is given cannot change later, and what is returned can be copied and pickled."""

import copy
import pickle
import threading

import bags as recorded
import numpy as np
import pytest
from slow_cases import slow_after

import sst_ros
from sst_ros import (
    Batch,
    Controller,
    ControllerSettings,
    Geometry,
    InputError,
    InverseDynamics,
    PolynomialTorque,
    Simulation,
    TorqueTable,
    load_scene,
    reference_motion,
    simulate,
)
from sst_ros.control.actuator_space import slow_down
from sst_ros.control.controller import Measurement

REST, TICK = (0.0, 0.0, 0.0), 1_000_000
SWEEP = {"amplitude": [0.05] * 3, "frequency": [3.0] * 3, "duration": 2.0, "fade": 0.4}
COPIES = {"deepcopy": copy.deepcopy, "pickle": lambda x: pickle.loads(pickle.dumps(x))}
copied = pytest.mark.parametrize("make_copy", COPIES.values(), ids=COPIES)


def push(t):
    return (0.2 * t, 0.1, -0.1)


@copied
@pytest.mark.parametrize(
    ("scene", "torque", "options"),
    [
        ("friction", (0.3, -0.2, 0.1), {}),
        ("elastic_stops", (1.0, 0.0, 0.0), {}),
        ("stiff", (0.1, 0.0, 0.0), {}),
        ("example2", push, {"integrator": "dop853", "tolerance": 1e-8}),
        ("example2", (0.1, 0.0, 0.0), {"equations": "virtual_work"}),
    ],
)
def test_a_copied_simulation_goes_on_to_the_bit(make_copy, scene, torque, options):
    simulation = Simulation(scene, **options)
    simulation.steps(torque, TICK, 20)
    other = make_copy(simulation)
    assert (
        other.state == simulation.state and other.evaluations == simulation.evaluations
    )
    assert other.within(19_500_000) == simulation.within(19_500_000)
    for each in (simulation, other):
        each.steps(torque, TICK, 20)
    assert other.state == simulation.state
    assert other.error_estimate == simulation.error_estimate
    assert other.energy_residual == simulation.energy_residual
    simulation.step(torque, TICK)
    assert other.time_ns == 40 * TICK
    assert other.reset() == Simulation(scene, **options).state


@copied
def test_a_copied_batch_and_its_results_have_the_same_bits(make_copy):
    pytest.importorskip("llvmlite", reason="needs llvmlite: pip install .[fast]")
    batch = Batch(
        "example2",
        parameters={"star.mass": [1.0, 1.1], "star.inertia.zz": [0.26, 0.27]},
    )
    start = {
        "gamma": (0.785, 0.785, 0.785),
        "gamma_dot": REST,
        "step": 1e-3,
        "count": 8,
    }
    result = batch.run(**start, keep_every=4)
    again, other = make_copy(batch).run(**start, keep_every=4), make_copy(result)
    for each in (again, other):
        for name in ("quaternion", "gamma", "energy", "torque", "status"):
            assert np.array_equal(getattr(each, name), getattr(result, name))
            assert np.array_equal(getattr(each.kept, name), getattr(result.kept, name))
        assert each.message == result.message


@copied
@pytest.mark.parametrize("scene", ["spiral", "reach", "point_to_point", "sweep"])
def test_a_copied_reference_motion_and_controller_act_alike(make_copy, scene):
    model = load_scene("spiral" if scene == "sweep" else scene)
    if scene == "sweep":
        model = model.with_values({"motion": {"sweep": SWEEP}})
    motion = reference_motion(model)
    times = [0.0, 0.1, 0.5, motion.duration]
    for each in (motion, slow_down(motion, 0.2, 0.3)):
        assert [make_copy(each).at(t) for t in times] == [each.at(t) for t in times]
    inverse = InverseDynamics(model)
    at = motion.at(0.3)
    assert make_copy(inverse).reference_torque(at) == inverse.reference_torque(at)
    controller = Controller(model, motion, ControllerSettings(integral_rate=0.5), 1e-3)
    measured = Measurement(model.initial.gamma, REST)
    for k in range(5):
        controller.command(1e-3 * k, measured)
    other = make_copy(controller)
    assert other.command(5e-3, measured) == controller.command(5e-3, measured)


@copied
def test_a_copied_recording_has_the_same_numbers(make_copy, tmp_path):
    entries = recorded.simulated(load_scene("example2"), 0.02)
    recorded.write(tmp_path / "bag", entries)
    run = sst_ros.read_bag(tmp_path / "bag")
    other = make_copy(run)
    recorded.same(run, other)
    assert np.array_equal(other.trajectory.gamma, run.trajectory.gamma)


@copied
def test_a_copied_proof_has_the_same_bounds(make_copy):
    pytest.importorskip("flint")
    proof = sst_ros.certify("example2", duration=0.01)
    other = make_copy(proof)
    assert repr(other) == repr(proof) and other.largest == proof.largest
    zone = sst_ros.certify_zone("general", tilt=0.4, max_boxes=1_000)
    assert repr(make_copy(zone)) == repr(zone)


def results(folder):
    """What public names return, or hold, with arrays."""
    run = simulate(
        "example2", (0.1, 0.0, 0.0), 0.3, samples=60, sensitivities=["star.mass"]
    )
    recorded.write(folder / "bag", recorded.simulated(load_scene("example2"), 0.02))
    geometry = Geometry.of(load_scene("example2"))
    batch = Batch("example2", parameters={"star.mass": [1.0, 1.1]})
    result = batch.run((0.785, 0.785, 0.785), REST, step=1e-3, count=8, keep_every=4)
    table, polynomial = (
        TorqueTable([0, 1], [REST, REST]),
        PolynomialTorque(np.ones((2, 1, 3)), [0, 1]),
    )
    recording = sst_ros.read_bag(folder / "bag")
    return {
        "trajectory": run,
        "samples": run.at([0.01]),
        "sensitivity": run.sensitivities["star.mass"]._asdict(),
        "table": table,
        "polynomial": polynomial,
        "batch": result,
        "kept": result.kept,
        "geometry": geometry,
        "assembly": sst_ros.direct_kinematics(geometry, [0.8, 0.8, 0.8])[0],
        "workspace": sst_ros.workspace(geometry, 3, 4),
        "nearest": sst_ros.distance_to_singularity("example2", [0.8, 0.8, 0.8]),
        "linear": sst_ros.linearize("example2", None, REST),
        "identified": sst_ros.identify(run, "example2", "star"),
        "recording": recording,
    }


def held_arrays(result):
    """Arrays that an object keeps: those it computes anew at each call are the
    caller's.
    """
    names = [name for name in dir(result) if not name.startswith("_")]
    values = result if isinstance(result, dict) else {}
    if not values:
        values = {name: getattr(result, name) for name in names if name != "plot"}
    for name, value in values.items():
        again = value if isinstance(result, dict) else getattr(result, name)
        if isinstance(value, np.ndarray) and np.shares_memory(value, again):
            yield name, value


@pytest.mark.parametrize(
    "make_copy", slow_after(1, [lambda x: x, *COPIES.values()]), ids=["itself", *COPIES]
)
def test_no_array_of_a_result_can_be_written_to(tmp_path, make_copy):
    pytest.importorskip("llvmlite", reason="needs llvmlite: pip install .[fast]")
    frozen = (
        "trajectory",
        "samples",
        "table",
        "polynomial",
        "batch",
        "kept",
        "linear",
        "recording",
    )
    writable = []
    for key, result in results(tmp_path).items():
        if make_copy in COPIES.values() and key not in frozen:
            continue  # a copy of plain data belongs to who made it
        arrays = held_arrays(make_copy(result))
        writable += [f"{key}.{name}" for name, array in arrays if array.flags.writeable]
    assert writable == []


def test_what_was_given_cannot_change_a_motion():
    times, torques = np.array([0.0, 0.01]), np.array([[0.1, 0, 0], [0, 0.1, 0]])
    table = TorqueTable(times, torques)
    run = simulate("example2", table, 0.02)
    before = run.at(0.0151).quaternion
    torques[:] = 5.0
    for array in (table.torques, table.times):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 5.0
    with pytest.raises(
        AttributeError, match="torques is read-only: make another TorqueTable"
    ):
        table.torques = torques
    polynomial = PolynomialTorque(np.ones((2, 1, 3)), [0, 1])
    with pytest.raises(ValueError, match="read-only"):
        polynomial.c[:] = 0.0
    with pytest.raises(AttributeError, match="c is read-only"):
        polynomial.c = np.ones((2, 1, 3))
    assert np.array_equal(run.at(0.0151).quaternion, before)
    assert np.array_equal(simulate("example2", table, 0.02).quaternion, run.quaternion)


def test_a_second_thread_is_refused_by_name_and_loses_no_step():
    simulation = Simulation("example2")
    inside, leave = threading.Event(), threading.Event()

    def wait(t):
        inside.set()
        assert leave.wait(30.0)
        return REST

    other = threading.Thread(target=simulation.step, args=(wait, TICK), name="holder")
    other.start()
    assert inside.wait(30.0)
    for call in (lambda: simulation.step(REST, TICK), simulation.reset):
        with pytest.raises(
            InputError, match=r"MainThread.*holder advances the simulation"
        ):
            call()
    leave.set()
    other.join(30.0)
    simulation.step(REST, TICK)
    assert simulation.time_ns == 2 * TICK


def test_threads_lose_no_step_without_a_word():
    simulation, refused = Simulation("example2"), []

    def advance():
        for _ in range(100):
            try:
                simulation.step(REST, TICK)
            except InputError:
                refused.append(1)

    threads = [threading.Thread(target=advance) for _ in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join(60.0)
    assert simulation.time_ns == (400 - len(refused)) * TICK


def test_a_function_that_steps_its_own_simulation_is_refused():
    simulation = Simulation("example2")

    def acting(t):
        simulation.step(REST, TICK)
        return REST

    with pytest.raises(InputError, match="advances the simulation"):
        simulation.step(acting, TICK)
