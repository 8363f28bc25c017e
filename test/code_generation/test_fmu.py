# SPDX-License-Identifier: Apache-2.0
"""Functional mock-up units: valid for FMPy, and their motions those of `simulate`."""

from __future__ import annotations

import shutil
import zipfile
from contextlib import contextmanager

import numpy as np
import pytest
from loaded_scenes import loaded
from scipy.integrate import solve_ivp
from slow_cases import slow_except

from sst_ros import TorqueTable, load_scene, simulate
from sst_ros.code_generation.equations import equations
from sst_ros.scene.scene import names

fmpy = pytest.importorskip("fmpy", reason="needs fmpy: pip install .[test]")
pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")

GAMMA = ("gamma_1", "gamma_2", "gamma_3")
QUICK = ("elastic_stops",)
PERIOD = 0.01  # of torques that are held [s]
COUNT = 10
EXACT = 1e-12  # of angles [rad]


def write(scene, folder, **options):
    (path,) = equations(scene, "fmu", **options).write(folder)
    return path


@contextmanager
def instance(path, folder, kind="slave", values=None):
    """An instance after initialization, with other start values by name.

    Its references.
    """
    description = fmpy.read_model_description(str(path))
    references = {one.name: one.valueReference for one in description.modelVariables}
    unpacked = fmpy.extract(str(path), str(folder))
    classes = {"slave": fmpy.fmi3.FMU3Slave, "model": fmpy.fmi3.FMU3Model}
    unit = classes[kind](
        guid=description.guid,
        unzipDirectory=unpacked,
        modelIdentifier=path.stem,
        instanceName="one",
    )
    unit.instantiate()
    unit.enterInitializationMode(tolerance=1e-14)
    for name, value in (values or {}).items():
        unit.setFloat64([references[name]], [value])
    unit.exitInitializationMode()
    yield unit, references
    unit.terminate()
    unit.freeInstance()


def held_torques(seed):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (COUNT, 3))


def follow(unit, references, torques):
    """Angles of the actuators at the end of each period."""
    inputs = [references[f"torque_{leg}"] for leg in (1, 2, 3)]
    outputs = [references[name] for name in GAMMA]
    angles = []
    for k, torque in enumerate(torques):
        unit.setFloat64(inputs, torque.tolist())
        unit.doStep(currentCommunicationPoint=k * PERIOD, communicationStepSize=PERIOD)
        angles.append(unit.getFloat64(outputs))
    return np.array(angles)


def expected(scene, torques):
    times = np.arange(len(torques) + 1) * PERIOD
    table = TorqueTable(times[:-1], torques)
    motion = simulate(scene, table, times[-1], t_eval=times[1:], tolerance=3e-13)
    assert motion.success
    return motion.gamma


@pytest.mark.parametrize("name", slow_except(QUICK, names()))
def test_co_simulation_is_the_motion_of_simulate(name, tmp_path):
    scene, torques = load_scene(name), held_torques(1)
    path = write(scene, tmp_path)
    with instance(path, tmp_path / "unit") as (unit, references):
        found = follow(unit, references, torques)
    assert np.abs(found - expected(scene, torques)).max() < EXACT


@pytest.mark.slow
def test_contacts_with_elastic_stops_are_resolved(tmp_path):
    scene, torques = load_scene("elastic_stops"), np.tile([1.0, 0.0, 0.0], (80, 1))
    path = write(scene, tmp_path)
    with instance(path, tmp_path / "unit") as (unit, references):
        found = follow(unit, references, torques)
    assert found.max() > np.pi / 2 + 0.01
    assert np.abs(found - expected(scene, torques)).max() < EXACT


@pytest.mark.slow
def test_fixed_steps_converge_with_order_eight(tmp_path):
    scene, torques = load_scene("fast_spin"), np.zeros((COUNT, 3))
    path, errors = write(scene, tmp_path), []
    reference = expected(scene, torques)
    for step in (2e-3, 1e-3):
        with instance(path, tmp_path / f"unit{step}", values={"step": step}) as (
            unit,
            known,
        ):
            errors.append(np.abs(follow(unit, known, torques) - reference).max())
    assert 6.5 < np.log2(errors[0] / errors[1]) < 9.5, errors


@pytest.mark.parametrize("name", slow_except(QUICK, names()))
def test_short_fixed_steps_are_the_motion_of_simulate(name, tmp_path):
    scene, torques = load_scene(name), held_torques(5)[:3]
    path = write(scene, tmp_path)
    with instance(path, tmp_path / "unit", values={"step": 1e-4}) as (unit, known):
        found = follow(unit, known, torques)
    assert np.abs(found - expected(scene, torques)).max() < EXACT


@pytest.mark.parametrize("name", slow_except(QUICK, names()))
def test_model_exchange_gives_the_derivative(name, tmp_path):
    scene, duration = load_scene(name), 0.05
    path, torque = write(scene, tmp_path), [0.4, -0.2, 0.3]
    with instance(path, tmp_path / "unit", "model") as (unit, references):
        unit.setFloat64([references[f"torque_{leg}"] for leg in (1, 2, 3)], torque)
        start, rates = np.zeros(7), np.zeros(7)
        unit.enterContinuousTimeMode()
        pointer = np.ctypeslib.as_ctypes

        def derivative(t, state):
            unit.setTime(t)
            unit.setContinuousStates(pointer(state), 7)
            unit.getContinuousStateDerivatives(pointer(rates), 7)
            return rates.copy()

        unit.getContinuousStates(pointer(start), 7)
        run = solve_ivp(
            derivative, (0, duration), start.copy(), "DOP853", rtol=1e-13, atol=1e-14
        )
        unit.setContinuousStates(pointer(run.y[:, -1].copy()), 7)
        found = unit.getFloat64([references[name] for name in GAMMA])
    motion = simulate(scene, torque, duration, tolerance=1e-13)
    assert np.abs(found - motion.gamma[-1]).max() < EXACT


def test_parameters_are_numbers_of_the_unit(tmp_path):
    key, value = "star.inertia.zz", 0.4
    scene = load_scene("example2").with_values({"star.inertia.xx": 0.45})
    other, torques = scene.with_values({key: value}), held_torques(2)
    path = write(scene, tmp_path, parameters=[key])
    with instance(path, tmp_path / "unit", values={key: value}) as (unit, references):
        found = follow(unit, references, torques)
    assert np.abs(found - expected(other, torques)).max() < EXACT
    assert np.abs(found - expected(scene, torques)).max() > 1e-4


def test_torques_are_clamped_and_lag(tmp_path):
    scene = loaded().with_values({"moment": {"value": [0.1, 0.2, -0.1]}})
    scene = scene.with_values({"stroke": {"at_end": "ignore"}})
    torques = 8.0 * held_torques(3)
    assert np.abs(torques).max() > scene.torque_limit
    path = write(scene, tmp_path)
    with instance(path, tmp_path / "unit") as (unit, references):
        found = follow(unit, references, torques)
        energy = unit.getFloat64([references["kinetic_energy"]])
    assert np.abs(found - expected(scene, torques)).max() < EXACT
    assert energy[0] > 0.0


def test_a_state_can_be_kept_and_restored(tmp_path):
    path, torques = write("swing", tmp_path), held_torques(4)
    with instance(path, tmp_path / "unit") as (unit, references):
        kept = unit.getFMUState()
        first = follow(unit, references, torques)
        unit.setFMUState(kept)
        assert (follow(unit, references, torques) == first).all()
        unit.freeFMUState(kept)


def test_what_is_not_finite_is_refused(tmp_path):
    path = write("swing", tmp_path)
    with instance(path, tmp_path / "unit") as (unit, references):
        with pytest.raises(fmpy.fmi1.FMICallException):
            unit.setFloat64([references["torque_1"]], [np.nan])
        with pytest.raises(fmpy.fmi1.FMICallException):
            unit.setFloat64([references["step"]], [-1.0])
        unit.setFloat64([references["torque_1"]], [1e300])  # clamped
        unit.doStep(currentCommunicationPoint=0.0, communicationStepSize=PERIOD)


@pytest.mark.parametrize("scene", slow_except(["loaded"], [*names(), "loaded"]))
def test_fmpy_finds_the_unit_valid(scene, tmp_path):
    from fmpy.validation import validate_fmu

    given = loaded() if scene == "loaded" else scene
    path = write(
        given, tmp_path, parameters=["star.inertia.xx", "actuated_links.inertia.zz"]
    )
    assert validate_fmu(str(path)) == []


@pytest.mark.slow
def test_equal_scenes_give_equal_bytes_and_others_another_token(tmp_path):
    first, again = (equations("example2", "fmu").files for _ in range(2))
    assert first == again
    tokens = set()
    for i, name in enumerate(("example2", "friction")):
        path = write(name, tmp_path / str(i))
        tokens.add(fmpy.read_model_description(str(path)).guid)
    assert len(tokens) == 2


def test_without_a_compiler_the_unit_has_its_sources(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.warns(RuntimeWarning, match="cc is not installed"):
        path = write("example2", tmp_path)
    with zipfile.ZipFile(path) as unit:
        listed = set(unit.namelist())
    sources = {"buildDescription.xml", "example2.c", "example2.h", "fmi3.c"}
    assert listed == {"modelDescription.xml", *(f"sources/{name}" for name in sources)}
